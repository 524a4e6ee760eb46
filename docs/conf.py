"""How Sphinx builds the documentation: ``make docs``. Nothing is asked of the network, and pages ask nothing of it."""

from __future__ import annotations

import re
import sys
from importlib.metadata import version as installed
from pathlib import Path
from typing import ClassVar

from pygments.lexer import RegexLexer
from pygments.token import Token
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError

sys.path.insert(0, str(Path(__file__).parent))

from generate import fill

project = "cudc-bench"
author = "The cudc-bench developers"
copyright = f"2026 {author}"
version = release = installed("cudc-bench")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
exclude_patterns = ["*.py"]
myst_enable_extensions = ["deflist"]
myst_heading_anchors = 4
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_member_order = "bysource"
napoleon_numpy_docstring = False
napoleon_attr_annotations = False
# A command's prompt and comments are not copied with it.
copybutton_prompt_text = "$ "
# Tables of commands are no languages.
highlight_language = "words"

html_theme = "furo"
html_title = "cudc-bench"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False

# What a page would load by itself; links that a reader may follow are no such things.
_LOADED = re.compile(r"""<(?:script|img|iframe|source)[^>]*\ssrc=["'](?:https?:)?//[^"']+|<link[^>]*\shref=["'](?:https?:)?//[^"']+""")


class Words(RegexLexer):
    """Words are pieces of their own, so that a narrow page breaks a command between them and not at an option's hyphens."""

    tokens: ClassVar = {"root": [(r"\S+", Token.Text.Word), (r"\s+", Token.Text.Whitespace)]}


def setup(app: Sphinx) -> None:
    """Fill the generated parts in, and refuse pages that load anything from elsewhere."""
    app.add_lexer("words", Words)
    app.connect("source-read", lambda app, name, source: source.__setitem__(0, fill(source[0])))
    app.connect("build-finished", _check_offline)


def _check_offline(app: Sphinx, exception: Exception | None) -> None:
    if exception is None and app.builder.format == "html":
        found = [
            f"{page.relative_to(app.outdir)}: {what}"
            for page in sorted(Path(app.outdir).rglob("*.html"))
            for what in _LOADED.findall(page.read_text(encoding="utf-8"))
        ]
        styles = [
            str(path)
            for path in Path(app.outdir).rglob("*.css")
            if re.search(r"(?:url\(|@import)\s*[\"']?(?:https?:)?//", path.read_text())
        ]
        if found or styles:
            raise ExtensionError(f"pages load something from elsewhere: {'; '.join(found + styles)}")
