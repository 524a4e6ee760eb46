"""What methods are is read from their sources, which are never run."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from cudc_bench import plugins
from cudc_bench.leaderboard.site.methods import describe
from cudc_bench.settings import sources

Install = Callable[[str, str], None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Puts a distribution there that registers ``theirs``."""

    def put(target: str, source: str) -> None:
        info = tmp_path / "their_package-1.2.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: their-package\nVersion: 1.2\n")
        (info / "entry_points.txt").write_text(f"[cudc_bench.collectors]\ntheirs = {target}\n")
        package = tmp_path / "their_package"
        package.mkdir()
        (package / "__init__.py").write_text("raise SystemExit('it was imported')")
        (package / "method.py").write_text(source)
        monkeypatch.syspath_prepend(str(tmp_path))
        importlib.invalidate_caches()
        forget()

    yield put
    forget()


def forget() -> None:
    for cached in (plugins._points, describe, sources.tree):
        cached.cache_clear()


@pytest.mark.parametrize("name", plugins.names("collectors"))
def test_every_collector_is_described_as_its_class_is(name: str) -> None:
    kind = plugins.load("collectors", name)
    found = describe(name)
    assert (found.family, found.citation) == (kind.family, kind.citation)
    assert found.package.startswith("cudc-bench ")
    assert " ".join(found.text[0].split()) in " ".join(kind.__doc__.split())


SOURCE = '''
raise SystemExit("it was imported")
from cudc_bench.collectors.apt import APT

class Theirs(APT):
    """Explores <b>elsewhere</b>.

    More of it.

    Attributes:
        x: nothing that a reader wants.
    """

    citation: str = "Somebody 2030"
'''


def test_a_third_partys_is_read_and_not_imported(install: Install) -> None:
    install("their_package.method:Theirs", SOURCE)
    found = describe("theirs")
    assert found.text == ("Explores <b>elsewhere</b>.", "More of it.")
    assert (found.family, found.citation, found.package) == ("entropy", "Somebody 2030", "their-package 1.2")
    assert "their_package" not in sys.modules


@pytest.mark.parametrize(
    ("target", "source"),
    [
        ("their_package.method:Theirs", "class Theirs(Theirs): pass"),
        ("their_package.method:Theirs", "from .method import Theirs"),
        ("their_package.method:Theirs", "Theirs = Theirs"),
        ("their_package.method:Theirs", "from ...... import Theirs"),
        ("their_package.method:Theirs", "class Theirs(:"),
        ("their_package.method:Theirs", "x = " + "(" * 5000),
        ("their_package.method:Theirs", "\0"),
        ("their_package.nothing:Theirs", ""),
        ("sys:Theirs", ""),
        ("nobody.here:Theirs", ""),
        ("their_package.method:Theirs", "class Theirs:\n    family = 1\n    citation = f'{1}'"),
    ],
)
def test_a_source_that_tells_nothing_is_no_failure(install: Install, target: str, source: str) -> None:
    install(target, source)
    found = describe("theirs")
    assert (found.family, found.citation, found.text) == ("", "", ())
    assert found.package == "their-package 1.2"


def test_nothing_is_known_of_a_method_that_is_not_installed() -> None:
    assert not describe("nobody").known
