"""What lies beside records comes onto pages: a link to each that is near, and a video of the best policy, or the command that makes it.

So does what ``compare`` left in the output.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import pytest
from PIL import Image

from cudc_bench.artefacts.records import Record
from cudc_bench.leaderboard.api import make_leaderboard
from cudc_bench.leaderboard.datasets.pair import PairSummary, SideSummary
from cudc_bench.leaderboard.intake.load import load_records
from cudc_bench.leaderboard.numbers.table import build_tables
from cudc_bench.leaderboard.output.media import find_clips, find_pairs, links_to_records
from cudc_bench.leaderboard.site.pages import site_files
from cudc_bench.leaderboard.site.parts import Site, run_of


@pytest.fixture
def results(make_record: Callable[..., Record], save: Callable[..., Path]) -> Path:
    """Records of two methods, of which the best is of cudc's second seed."""
    return save(make_record(final=[500.0]), make_record(seed=2, final=[700.0]), make_record("icm", final=[600.0]))


def page_of(results: Path, **more: object) -> tuple[str, dict[str, str | bytes]]:
    """The task's page, and all files of the site."""
    loaded = load_records([results])
    tables, _ = build_tables(loaded.records)
    places = {run_of(one): file.relative_to(results).as_posix() for one, file in zip(loaded.records, loaded.paths, strict=True)}
    files = site_files(Site(tables, [], places=places, clips=find_clips(loaded, tables), **more))  # type: ignore[arg-type]
    page = files["cpu.td3.walker/task-walk.html"]
    assert isinstance(page, str)
    return page, files


def record(results: Path, name: str) -> Path:
    return results / "cpu" / "walker" / "walk" / name


def test_without_a_policy_there_is_nothing_to_make_a_video_of(results: Path) -> None:
    page, files = page_of(results)
    assert "cudc, collector seed 2, training seed 1" in page
    assert "700.0, the mean of 1 episode" in page
    assert "its policy is not beside its record" in page
    assert "cudc-bench render" not in page
    assert 'srcset="../site/walker.webp"><img src="../site/walker-moving.webp"' in page
    for name in ("walker", "walker-moving"):
        with Image.open(BytesIO(files[f"site/{name}.webp"])) as picture:
            assert (picture.format, picture.n_frames > 1) == ("WEBP", name != "walker")
    assert not any("best-" in name for name in files)


def test_a_policy_can_be_rendered_and_the_video_is_shown(results: Path) -> None:
    best = record(results, "cudc-seed2-v0/td3-seed1.json")
    best.with_suffix(".policy.pt").write_bytes(b"weights")
    page, _ = page_of(results)
    assert f"cudc-bench render {best.relative_to(results)}" in page
    other = record(results, "icm-seed1-v0/td3-seed1.gif")
    other.write_bytes(b"of icm")
    page, files = page_of(results)
    assert files["cpu.td3.walker/best-walk.gif"] == b"of icm"
    assert 'src="best-walk.gif" alt="Video of a policy of icm on walker walk."' in page
    assert "Of that run there is no video; this one lies beside the record of icm, collector seed 1, whose final score is 600.0" in page
    best.with_suffix(".mp4").write_bytes(b"of cudc")
    page, files = page_of(results)
    assert files["cpu.td3.walker/best-walk.mp4"] == b"of cudc"
    assert "cpu.td3.walker/best-walk.gif" not in files
    assert "The video that lies beside its record" in page
    assert "<video controls" in page
    assert "cudc-bench render" not in page


def test_a_video_that_no_page_should_load_is_left_out(results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cudc_bench.leaderboard.output.media._LARGEST", 10)
    record(results, "cudc-seed2-v0/td3-seed1.mp4").write_bytes(b"x" * 11)
    record(results, "icm-seed1-v0/td3-seed1.mp4").mkdir()
    assert not any("best-" in name for name in page_of(results)[1])


def test_records_are_linked_where_they_lie_beside_the_report(results: Path, tmp_path: Path) -> None:
    loaded = load_records([results])
    links = links_to_records(loaded, tmp_path / "report")
    assert sorted(links.values()) == sorted(f"../results/{file.relative_to(results).as_posix()}" for file in loaded.paths)
    _, files = page_of(results, links=links)
    runs = files["cpu.td3.walker/runs-walk.icm.html"]
    assert '<a href="../../results/cpu/walker/walk/icm-seed1-v0/td3-seed1.json">' in runs  # type: ignore[operator]
    # Where somebody keeps things elsewhere is nobody's business.
    assert links_to_records(loaded, tmp_path / "elsewhere" / "report") == {}


def test_odd_names_of_files_are_addresses(make_record: Callable[..., Record], tmp_path: Path) -> None:
    folder = tmp_path / 'a "b" <c>#?'
    folder.mkdir()
    (folder / "é&%.json").write_text(make_record().model_dump_json())
    (link,) = links_to_records(load_records([folder]), tmp_path / "report").values()
    assert link == "../a%20%22b%22%20%3Cc%3E%23%3F/%C3%A9%26%25.json"


SIDES = [
    SideSummary(id=f"walker/{name}-v0", fingerprint=letter * 64, method=name, seed=1, steps=400_000, rewards={"walk": 0.25, "hop": 0.5})
    for name, letter in (("cudc", "b"), ("rnd", "c"))
]
PAIR = PairSummary(quantities=("height", "speed"), shared=0.375, sides=(SIDES[0], SIDES[1]))
PLACE = "walker.cudc-v0.walker.rnd-v0.pair"


def compared(output: Path, place: str = PLACE, text: str = PAIR.model_dump_json()) -> None:
    """What ``compare`` leaves, and the page that a leaderboard put beside it."""
    (output / place).mkdir(parents=True)
    for name in ("map.svg", "film.gif", "quality.csv", "index.html"):
        (output / place / name).write_text("<svg/>")
    (output / place / "pair.json").write_text(text)


def test_two_datasets_side_by_side_have_a_page_beside_their_figures(results: Path, tmp_path: Path) -> None:
    compared(tmp_path / "report")
    found = find_pairs(tmp_path / "report")
    assert found == {PLACE: (PAIR, ["film.gif", "map.svg", "quality.csv"])}
    _, files = page_of(results, pairs=[PAIR], files={PLACE: found[PLACE][1]})
    page, listed = files[f"{PLACE}/index.html"], files["datasets/index.html"]
    assert isinstance(page, str)
    for part in (
        "<h1>walker/cudc-v0 beside walker/rnd-v0</h1>", "38% of the states are in the same cells of height and speed", "bbbbbbbbbbbb …",
        ">0.250</td>", '<img src="map.svg" alt="Where their states lie: ', '<img src="film.gif"', 'href="quality.csv"',
        "cudc-bench compare walker/cudc-v0 walker/rnd-v0 --quantities height,speed",
    ):  # fmt: skip
        assert part in page
    assert not any(name in page for name in ("density", "spectra", "film.mp4", 'href="../datasets/walker'))
    assert f'<a href="../{PLACE}/index.html">walker/cudc-v0 beside walker/rnd-v0</a>' in listed  # type: ignore[operator]


def test_a_comparison_comes_and_goes_with_its_folder(results: Path, tmp_path: Path) -> None:
    def listed() -> bool:
        make_leaderboard(results, tmp_path / "report", datasets=False)
        return "Side by side" in (tmp_path / "report" / "datasets" / "index.html").read_text()

    assert not listed()
    compared(tmp_path / "report")
    assert listed()
    assert "Where their states lie" in (tmp_path / "report" / PLACE / "index.html").read_text()
    shutil.rmtree(tmp_path / "report" / PLACE)
    assert not listed()
    assert not (tmp_path / "report" / PLACE).exists()


def test_where_nothing_was_compared_nothing_is_said_of_it(results: Path, tmp_path: Path) -> None:
    (tmp_path / "report" / "empty.pair").mkdir(parents=True)
    assert find_pairs(tmp_path / "report") == find_pairs(tmp_path / "nowhere") == {}
    _, files = page_of(results)
    assert not [path for path, text in files.items() if ".pair" in path or (path.endswith(".html") and "Side by side" in str(text))]


@pytest.mark.parametrize(
    ("place", "text"),
    [
        ("walker.other-v0.walker.rnd-v0.pair", PAIR.model_dump_json()),
        (PLACE, "{"),
        (PLACE, PAIR.model_dump_json().replace("walker/cudc-v0", "../../x-v0")),
        (PLACE, PAIR.model_dump_json().replace("0.375", "NaN")),
        (PLACE, PAIR.model_dump_json().replace('"seed":1', '"seed":-1')),
    ],
)
def test_what_compare_did_not_write_is_no_comparison(place: str, text: str, tmp_path: Path) -> None:
    compared(tmp_path, place, text)
    assert find_pairs(tmp_path) == {}
