"""What a collector is, in the words of its own source, without importing it: that would load torch, or run a stranger's code."""

from __future__ import annotations

import ast
import inspect
import re
from dataclasses import dataclass
from functools import cache

from cudc_bench import plugins
from cudc_bench.errors import CudcBenchError
from cudc_bench.settings.described import category_of
from cudc_bench.settings.sources import ancestry

_ADDRESS = re.compile(r"https://[a-zA-Z0-9./_~%?=&+:-]{1,300}")


@dataclass(frozen=True)
class Method:
    """A collector as its class describes itself.

    Attributes:
        name: as on the command line.
        family, citation: how it explores and the paper; empty where the class does not say.
        paper: where that can be read; empty where the class that names the citation does not say, or says no such address.
        text: paragraphs of its docstring, without the sections on arguments and attributes.
        package: the distribution that registers it, with its version; empty if none does here.
        category: one of :data:`~cudc_bench.settings.described.CATEGORIES`.
    """

    name: str
    family: str = ""
    citation: str = ""
    paper: str = ""
    text: tuple[str, ...] = ()
    package: str = ""
    category: str = "other"

    @property
    def known(self) -> bool:
        """Whether it is registered here."""
        return bool(self.package)


@cache
def describe(name: str) -> Method:
    """What is registered as a collector of that name; for others only the name. Whatever is wrong with a source, there is an answer."""
    try:
        module, attribute = plugins.target("collectors", name)
        package = " ".join(f"{one} {version}" for one, version in plugins.package("collectors", name).items())
    except CudcBenchError:
        return Method(name)
    texts: list[str] = []
    values: dict[str, str] = {}
    for kind in (one.node for one in ancestry(module, attribute)):
        texts += filter(None, [ast.get_docstring(kind)])
        own = _texts(kind)
        if "citation" in own and "citation" in values:
            own.pop("paper", None)  # of another paper
        values = own | values
        if "citation" in values:
            values.setdefault("paper", "")
    paragraphs = _paragraphs(texts[0]) if texts else ()
    paper = values.get("paper", "")
    return Method(
        name, values.get("family", ""), values.get("citation", ""), paper if _ADDRESS.fullmatch(paper) else "", paragraphs,
        package or module, category_of(values.get("category")),
    )  # fmt: skip


def _texts(kind: ast.ClassDef) -> dict[str, str]:
    """The class attributes that are texts."""
    found: dict[str, str] = {}
    for node in kind.body:
        match node:
            case ast.Assign(targets=[ast.Name(id=one)], value=ast.Constant(value=str(text))):
                found.setdefault(one, text)
            case ast.AnnAssign(target=ast.Name(id=one), value=ast.Constant(value=str(text))):
                found.setdefault(one, text)
    return found


def _paragraphs(docstring: str) -> tuple[str, ...]:
    found = []
    for block in inspect.cleandoc(docstring).split("\n\n"):
        if block.split("\n")[0].strip() in {"Args:", "Attributes:", "Class attributes:", "Raises:", "Returns:", "Yields:"}:
            break
        found.append(block.strip("\n"))
    return tuple(filter(None, found))
