"""What methods are is read from their sources, which are never run."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from cudc_bench import plugins
from cudc_bench.artefacts.manifest import Collected, PartOrigin
from cudc_bench.artefacts.records import Record
from cudc_bench.leaderboard.methods import METHOD_ORDER, canonical
from cudc_bench.leaderboard.numbers.table import build_tables
from cudc_bench.leaderboard.site.catalogue import Catalogue
from cudc_bench.leaderboard.site.methods import describe
from cudc_bench.leaderboard.site.parts import Site
from cudc_bench.settings import sources
from cudc_bench.settings.described import CATEGORIES
from cudc_bench.suites.definition import load_suite

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
    assert (found.family, found.citation, found.category) == (kind.family, kind.citation, kind.category)
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


def headings(records: list[Record]) -> dict[str, list[str]]:
    """The methods under each heading of their page."""
    page = Catalogue(Site(build_tables(records)[0], [])).methods_page()
    return {one.title: [line.head.text for grid in one.grids for line in grid.lines] for one in page.sections}


def test_methods_stand_under_their_categories(make_record: Callable[..., Record]) -> None:
    names = ("smm", "apt", "cudc", "be", "rnd", "random", "icm", "aps", "nobody")
    part = PartOrigin(
        id="walker/rnd-v0", fingerprint="b" * 64, method="rnd", seed=1, profile="cpu", overrides={}, hyperparameters={}, citation="",
        collected=Collected(versions={}, machine={}),
    )  # fmt: skip
    records = [make_record(name) for name in names] + [
        make_record("proto", dataset_source="ExORL", dataset_profile="imported"),
        make_record("mixture", dataset_parts=[part, part.model_copy(update={"method": "cudc"})]),
        make_record("medium-replay"),
    ]
    assert headings(records) == {
        "Knowledge-based": ["icm", "cudc", "rnd"],
        "Data-based": ["apt", "be"],
        "Competence-based": ["aps", "smm"],
        "Other collectors": ["random", "nobody"],
        "Mixtures, tiers and imported data": ["medium-replay", "mixture (cudc, rnd)", "proto (ExORL, 400K)"],
    }
    assert list(headings([make_record("apt")])) == ["Data-based"]
    pages = Catalogue(Site(build_tables(records)[0], []))
    about = {name: pages.method(name).sections[0] for name in ("smm", "nobody", "medium-replay")}
    groups = {name: dict(section.facts)["group"].text for name, section in about.items()}
    assert groups == {"smm": "Competence-based", "nobody": "Other collectors", "medium-replay": "Mixtures, tiers and imported data"}
    assert about["medium-replay"].prose == ("No collector made it.",)
    assert about["nobody"].prose[0].startswith("Nothing more is known of it here")


@pytest.mark.parametrize(
    ("base", "says", "heading"),
    [
        ("ddpg import DDPG", "", "Other collectors"),
        ("ddpg import DDPG", "category = 'competence'", "Competence-based"),
        ("ddpg import DDPG", "category = 'secret'", "Other collectors"),
        ("apt import APT", "", "Data-based"),
        ("apt import APT", "category: str = 'other'", "Other collectors"),
    ],
)
def test_a_third_partys_category_is_what_its_class_says(
    base: str, says: str, heading: str, install: Install, make_record: Callable[..., Record]
) -> None:
    name = base.split()[-1]
    install("their_package.method:Theirs", f"from cudc_bench.collectors.{base}\nclass Theirs({name}):\n    family = 'x'\n    {says}\n")
    assert headings([make_record("theirs")]) == {heading: ["theirs"]}


def test_methods_are_ordered_by_category_behind_the_papers() -> None:
    papers = load_suite("main").studies[0].methods
    assert METHOD_ORDER[: len(papers)] == papers
    own = [name for name in plugins.names("collectors") if not plugins.target("collectors", name)[0].endswith(".variants")]
    assert set(METHOD_ORDER) == {name for name in own if canonical(name) == name}
    later = METHOD_ORDER[len(papers) :]
    assert list(later) == sorted(later, key=lambda name: (list(CATEGORIES).index(describe(name).category), name))


def test_nothing_is_known_of_a_method_that_is_not_installed() -> None:
    assert not describe("nobody").known
