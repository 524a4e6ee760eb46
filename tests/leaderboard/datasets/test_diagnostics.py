"""Diagnostics in figures and in the terminal: the numbers are those of the files, and what cannot be compared is never shown together."""

from __future__ import annotations

import io
import json
import math
import random
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from rich.console import Console

import cudc_bench
from cudc_bench import plugins
from cudc_bench.artefacts.manifest import KEY, Base, Import, Manifest, metadata_path
from cudc_bench.errors import RunError, UsageError
from cudc_bench.leaderboard.api import draw_diagnostics
from cudc_bench.leaderboard.datasets.diagnostics import REPRESENTATION, compare, read_diagnostics, series
from cudc_bench.leaderboard.methods import LOSSES, styles
from cudc_bench.leaderboard.show.figures.diagnostics import diagnostic_files, draw_k, draw_losses, draw_representation
from cudc_bench.leaderboard.show.terminal import of_diagnostics as diagnostics_to_rich

Rows = Sequence[dict[str, Any]]
FIGURES = {"k.svg", "k.pdf", "losses.svg", "losses.pdf"}  # and, where one was measured, of the representation
HOSTILE = "[red]x[/red] $\\frac{$ <b> &amp; \x1b[31m\n ]]>"


def learning(k: Sequence[float] = (3, 3, 4, 5), scale: float = 1.0) -> list[dict[str, Any]]:
    """Lines as a learner writes them, the first before its first update."""
    rows: list[dict[str, Any]] = [{"step": 1000, "updates": 0, "coverage_cells": 5, "coverage_entropy": 1.5}]
    for index, value in enumerate(k):
        losses = {name: scale * (number + 1) / (index + 1) for number, name in enumerate(LOSSES)}
        rows.append(rows[0] | losses | {"step": 1000 * (index + 2), "updates": 100 * (index + 1), "k": float(value)})
    return rows


@pytest.fixture
def put(datasets: Path) -> Callable[..., str]:
    """Makes what diagnostics are read from: a manifest and the lines beside it, without arrays."""

    def make(method: str = "cudc", seed: int = 1, rows: Rows | None = None, dataset_id: str | None = None, **changes: Any) -> str:
        one = dataset_id or f"walker/{method}-seed{seed}-v0"
        manifest = Manifest(
            **{
                "domain": "walker", "method": method, "seed": seed, "steps": 5000, "episodes": 5, "profile": "cpu",
                "hyperparameters": {"width": 128}, "hyperparameters_hash": "0", "fields": {}, "fingerprint": "a" * 64, "versions": {},
                "machine": {}, "seconds": 1.0, "created": "2026-01-01T00:00:00+00:00", "command": "cudc-bench collect", **changes,
            }
        )  # fmt: skip
        file = metadata_path(one)
        file.parent.mkdir(parents=True)
        file.write_text(json.dumps({KEY: manifest.model_dump()}))
        if rows is None:
            rows = learning()
        (datasets / one / "diagnostics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        return one

    return make


def grown(*changes: tuple[int, int], suspect: bool = True) -> dict[str, Any]:
    """What a method with a schedule says of it: (step, old k) of each growth."""
    increments = [{"step": step, "old_k": k, "new_k": k + 1, "p": 0.6, "mean_w": 0.1} for step, k in changes]
    return {"k_increments": increments, "k_schedule_suspect": suspect}


def shown(comparison: Any, width: int = 100) -> str:
    file = io.StringIO()
    Console(file=file, width=width, color_system=None).print(diagnostics_to_rich(comparison))
    return file.getvalue()


def lines_of(panel: Any) -> list[Any]:
    """The lines of methods, in the order in which they were drawn; those that mark growths are dotted."""
    return [line for line in panel.get_lines() if line.get_linestyle() != ":"]


def texts(svg: bytes) -> str:
    return " ".join(element.text or "" for element in ET.fromstring(svg).iter("{http://www.w3.org/2000/svg}text"))


# --------------------------------------------------------------------------------------------------------------------------- numbers


def test_lines_are_means_over_seeds_and_bands_sample_deviations(put: Callable) -> None:
    schedules = {1: (3, 3, 4, 5), 2: (3, 4, 4, 6), 5: (3, 3, 3, 4)}
    for seed, k in schedules.items():
        put(seed=seed, rows=learning(k, scale=seed))
    (comparison,) = draw_diagnostics(output=None).comparisons
    (panel,) = draw_k(comparison).axes
    (line,) = lines_of(panel)
    assert line.get_xdata().tolist() == [2000, 3000, 4000, 5000]
    np.testing.assert_allclose(line.get_ydata(), np.mean(list(schedules.values()), axis=0))
    assert line.get_drawstyle() == "steps-post"
    (band,) = panel.collections
    corners = band.get_paths()[0].vertices
    std = np.std([5, 6, 4], ddof=1)
    assert corners[:, 1].max() == pytest.approx(5 + std)
    assert panel.get_xlim() == (0, 5000)
    panels = draw_losses(comparison).axes
    assert [panel.get_title() for panel in panels] == ["forward loss", "inverse loss", "step loss", "contrastive loss"]
    for number, panel in enumerate(panels):
        (line,) = lines_of(panel)
        assert line.get_xdata().tolist() == [2000, 3000, 4000, 5000]
        np.testing.assert_allclose(line.get_ydata(), [(number + 1) / index * np.mean([1, 2, 5]) for index in (1, 2, 3, 4)])


def test_a_collapse_can_be_seen_in_figure_and_table(put: Callable) -> None:
    rows = [
        row | {"error_over_persistence": 1.0 + index / 10, "effective_rank": 9.0 - index, "state_spread": 0.5 / index, "action_share": 0.5}
        for index, row in enumerate(learning((3, 3, 3, 3))[1:], start=1)
    ]
    put(rows=rows), put("icm")
    (comparison,) = draw_diagnostics(output=None).comparisons
    panels = draw_representation(comparison).axes
    assert [panel.get_title() for panel in panels] == list(REPRESENTATION.values())
    line, persistence = (one.get_ydata() for one in panels[0].get_lines())
    assert [*line] == pytest.approx([row["error_over_persistence"] for row in rows])
    assert [*persistence] == [1, 1]
    heads, _, _, cudc = (text.split() for text in shown(comparison).splitlines()[1:])
    assert heads[-3:] == ["error", "rank", "spread"]
    assert cudc[-3:] == [f"{rows[-1][name]:.3g}" for name in ("error_over_persistence", "effective_rank", "state_spread")]


def test_one_seed_is_a_thin_staircase_without_a_band(put: Callable) -> None:
    put()
    put("icm", 1), put("icm", 2)
    (comparison,) = draw_diagnostics(output=None).comparisons
    (panel,) = draw_k(comparison).axes
    icm, cudc = lines_of(panel)
    assert cudc.get_ydata().tolist() == [3, 3, 4, 5]
    assert cudc.get_linewidth() < icm.get_linewidth()
    assert len(panel.collections) == 1


def test_only_steps_that_all_seeds_have_count_and_what_is_missing_is_left_out(put: Callable) -> None:
    first, second = learning(), learning()
    first[1]["k"], first[2]["loss_step"], first[2]["loss_reach"] = None, math.nan, math.inf
    del second[3]["k"]
    put(seed=1, rows=first), put(seed=2, rows=second)
    (comparison,) = draw_diagnostics(output=None).comparisons
    assert series(comparison.of("cudc", "k"), "k")[0] == [3000, 5000]
    assert series(comparison.of("cudc", "loss_reach"), "loss_reach")[0] == [2000, 4000, 5000]
    assert series(comparison.of("cudc", "loss_step"), "loss_step")[0] == [2000, 4000, 5000]


def test_seeds_that_lack_a_measure_or_a_common_step_are_told(put: Callable) -> None:
    put(seed=1)
    put(seed=2, rows=[{name: value for name, value in row.items() if name != "k"} for row in learning()])
    put("icm", 1)
    put("icm", 2, rows=[row | {"step": row["step"] + 1} for row in learning()])
    report = draw_diagnostics(output=None)
    (comparison,) = report.comparisons
    assert "cpu.diagnostics.walker: cudc is shown without walker/cudc-seed2-v0 where 'k' is: it was not measured there." in report.remarks
    assert "cpu.diagnostics.walker: 'k' of icm is not shown: its seeds were never measured at the same step." in report.remarks
    assert diagnostic_files(comparison).keys() == FIGURES


def test_coinciding_lines_share_their_place(put: Callable) -> None:
    for method in ("icm", "apt", "proto"):
        put(method, rows=learning((3, 3, 3, 3)))
    put()
    (comparison,) = draw_diagnostics(output=None).comparisons
    *flat, cudc = lines_of(draw_k(comparison).axes[0])
    assert [line.get_ydata().tolist() for line in flat] == [[3, 3, 3, 3]] * 3
    patterns = {line._unscaled_dash_pattern for line in flat if isinstance(line._unscaled_dash_pattern[1], list | tuple)}
    offsets = sorted(offset for offset, _ in patterns)
    ((on, off),) = {tuple(dashes) for _, dashes in patterns}
    assert off == pytest.approx(2 * on)
    assert np.diff(offsets) == pytest.approx([on, on])
    assert cudc.get_linestyle() == "-"


def test_growth_is_marked_in_the_methods_colour_while_marks_are_few(put: Callable) -> None:
    put(diagnostics=grown((2500, 3), (3500, 4)))
    put("icm")

    def marks() -> list[tuple[float, str]]:
        (comparison,) = draw_diagnostics(output=None).comparisons
        figure = draw_losses(comparison)
        found = [(line.get_xdata()[0], line.get_color()) for line in figure.axes[0].get_lines() if line.get_linestyle() == ":"]
        assert ("dotted: k grew" in figure.get_suptitle()) == bool(found)
        return found

    colour = styles(["cudc"])["cudc"]["color"]
    assert marks() == [(2500, colour), (3500, colour)]
    for seed in range(2, 14):
        put(seed=seed, diagnostics=grown((100 * seed, 3)))
    assert marks() == []


@pytest.mark.parametrize(
    "values", [(0.0, 0.0, 0.0, 0.0), (8.0, 1.0, 1e-7, 0.0), (1.0, -2.0, 0.0, 3.0), (5.0, 5.1, 5.2, 5.0), (1e29, 1, 1, 1)]
)
def test_any_loss_has_an_axis_that_shows_it_all(values: tuple[float, ...], put: Callable) -> None:
    rows = [row | ({"loss_step": value} if "k" in row else {}) for row, value in zip(learning(), (0.0, *values), strict=True)]
    put(rows=rows)
    (comparison,) = draw_diagnostics(output=None).comparisons
    panel = draw_losses(comparison).axes[2]
    low, high = panel.get_ylim()
    assert low < min(values) <= max(values) < high
    assert len([tick for tick in panel.get_yticks() if low <= tick <= high]) > 1


# -------------------------------------------------------------------------------------------------------------------------- grouping


def test_profiles_settings_and_domains_never_share_a_figure(put: Callable) -> None:
    put()
    put(seed=2, profile="paper", rows=learning((3, 3, 3, 4)))
    put(seed=3, overrides={"k_max": 4})
    put(seed=4, overrides={"k_max": 5})
    put(seed=5, domain="jaco")
    report = draw_diagnostics(output=None)
    groups = [(comparison.domain, comparison.group, [run.manifest.seed for run in comparison.runs]) for comparison in report.comparisons]
    assert groups == [
        ("jaco", "cpu", [5]),
        ("walker", "cpu", [1]),
        ("walker", "cpu (collect: k_max=4)", [3]),
        ("walker", "cpu (collect: k_max=5)", [4]),
        ("walker", "paper", [2]),
    ]
    assert len({comparison.slug for comparison in report.comparisons}) == 5
    assert {"cpu.diagnostics.jaco", "paper.diagnostics.walker"} < {comparison.slug for comparison in report.comparisons}
    for comparison in report.comparisons:
        (line,) = lines_of(draw_k(comparison).axes[0])
        (run,) = comparison.runs
        assert line.get_ydata().tolist() == list(run.values["k"].values())


def test_of_one_method_and_seed_the_newest_counts(put: Callable) -> None:
    put(rows=learning((3, 3, 3, 3)))
    put(dataset_id="walker/again-v0", created="2026-02-01T00:00:00+00:00")
    report = draw_diagnostics(output=None)
    assert [run.id for run in report.comparisons[0].runs] == ["walker/again-v0"]
    (remark,) = report.remarks
    assert remark.startswith("cpu.diagnostics.walker: walker/cudc-seed1-v0 is left out: walker/again-v0 has the same method, seed")


def test_other_hyperparameters_behind_one_profile_are_told(put: Callable) -> None:
    put(seed=1), put(seed=2, hyperparameters={"width": 64, "depth": 2})
    (remark,) = draw_diagnostics(output=None).remarks
    assert remark == "cpu.diagnostics.walker: the datasets of cudc were collected with different hyperparameters: depth, width."


def test_filters(put: Callable) -> None:
    put(), put("icm"), put("apt"), put(seed=2, domain="jaco")

    def found(**wanted: Any) -> list[tuple[str, tuple[str, ...]]]:
        return [(comparison.domain, comparison.methods) for comparison in draw_diagnostics(output=None, **wanted).comparisons]

    assert found() == [("jaco", ("cudc",)), ("walker", ("icm", "apt", "cudc"))]
    assert found(domain="jaco") == [("jaco", ("cudc",))]
    assert found(methods=["cudc", "icm"], domain="walker") == [("walker", ("icm", "cudc"))]
    assert found(dataset_ids=["walker/apt-seed1-v0", "walker/apt-seed1-v0"]) == [("walker", ("apt",))]
    assert found(dataset_ids="walker/apt-seed1-v0") == [("walker", ("apt",))]
    refused = [
        ({"domain": "jacko"}, "no dataset has the domain 'jacko'; there are: jaco, walker. Did you mean 'jaco'?"),
        ({"methods": ["cudc", "cudk"]}, "no dataset has the method 'cudk'; there are: apt, cudc, icm. Did you mean 'cudc'?"),
    ]
    for wanted, message in refused:
        with pytest.raises(UsageError) as caught:
            found(**wanted)
        assert str(caught.value) == message


# ------------------------------------------------------------------------------------------------------------------------------ files


def test_the_same_datasets_give_the_same_bytes(put: Callable, tmp_path: Path) -> None:
    names = [("cudc", 1), ("cudc", 2), ("icm", 1), ("rnd", 1), ("my_method", 3)]
    random.Random(0).shuffle(names)
    for method, seed in names:
        put(method, seed, diagnostics=grown((2500, 3)) if method == "cudc" else {})
    first = draw_diagnostics(output=tmp_path / "a").files
    with matplotlib.rc_context({"axes.facecolor": "red", "svg.fonttype": "path", "font.size": 30}):
        second = draw_diagnostics(sorted(f"walker/{method}-seed{seed}-v0" for method, seed in names), tmp_path / "b").files
    assert {file.relative_to(tmp_path / "a").as_posix() for file in first} == {f"cpu.diagnostics.walker/{name}" for name in FIGURES}
    for one, other in zip(first, second, strict=True):
        assert one.read_bytes() == other.read_bytes()
        assert b"<dc:date>" not in one.read_bytes()


def test_without_output_nothing_is_written(put: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    put()
    assert draw_diagnostics(output=None).files == []
    assert list(tmp_path.iterdir()) == []


def test_only_figures_and_panels_with_values_are_drawn(put: Callable, tmp_path: Path) -> None:
    put("random", rows=[{"step": 1000, "updates": 0, "coverage_cells": 7, "coverage_entropy": 1.0}])
    report = draw_diagnostics(output=tmp_path)
    assert report.files == []
    assert report.remarks == [
        "cpu.diagnostics.walker: there is no figure of k, since nothing here reports one (random).",
        "cpu.diagnostics.walker: there is no figure of losses, since nothing here reports forward or inverse or step or contrastive losses"
        " (random).",
    ]
    put("icm", rows=[{name: value for name, value in row.items() if name not in {"k", "loss_step", "loss_reach"}} for row in learning()])
    report = draw_diagnostics(output=tmp_path)
    assert {file.name for file in report.files} == {"losses.svg", "losses.pdf"}
    figure = draw_losses(report.comparisons[0])
    assert [panel.get_title() for panel in figure.axes if panel.get_visible()] == ["forward loss", "inverse loss"]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["icm"]


def test_a_failed_write_is_one_line(put: Callable, tmp_path: Path) -> None:
    put()
    (tmp_path / "out" / "cpu.diagnostics.walker" / "k.svg").mkdir(parents=True)
    with pytest.raises(RunError, match=r"cannot write .*k\.svg") as caught:
        draw_diagnostics(output=tmp_path / "out")
    assert "\n" not in str(caught.value)


def test_all_registered_methods_look_different() -> None:
    methods = plugins.names("collectors")
    assert len({(style["color"], style["linestyle"]) for style in styles(methods).values()}) == len(methods)


# ------------------------------------------------------------------------------------------------------------------------- terminal


def test_the_terminal_has_a_line_for_each_dataset(put: Callable) -> None:
    # The last line's minibatch was drawn before the last growth.
    put(seed=3, diagnostics=grown((2500, 3), (4_999, 4), (5000, 5)))
    put(seed=4, diagnostics=grown(suspect=False))
    put("random", 1, rows=learning()[:1])
    (comparison,) = draw_diagnostics(output=None).comparisons
    title, _, _, *lines = (line.split() for line in shown(comparison).splitlines())
    assert title == ["walker,", "profile", "cpu"]
    assert lines == [
        ["random", "1", "5,000", "–", "–", "–", "5", "1.50"],
        ["cudc", "3", "5,000", "6", "3→4", "at", "2,500", "yes", "5", "1.50"],
        ["4→5", "at", "4,999"],
        ["5→6", "at", "5,000"],
        ["cudc", "4", "5,000", "5", "–", "no", "5", "1.50"],
    ]


def test_hostile_text_is_shown_as_it_is(put: Callable, tmp_path: Path) -> None:
    increments = [HOSTILE, {"step": HOSTILE}, {"step": 10**400, "old_k": 3, "new_k": 4}]
    put(
        method=HOSTILE, profile=HOSTILE, domain=f"../{HOSTILE}", overrides={HOSTILE: HOSTILE}, dataset_id="walker/hostile-v0",
        diagnostics={"k_increments": increments, "k_schedule_suspect": "x"},
    )  # fmt: skip
    report = draw_diagnostics(output=tmp_path / "out")
    assert {file.parent.parent for file in report.files} == {tmp_path / "out"}
    (comparison,) = report.comparisons
    whole = shown(comparison, width=400)
    assert "[red]x[/red] $\\frac{$ <b> &amp; [31m ]]>" in whole
    assert "\x1b" not in whole
    found = texts((tmp_path / "out" / comparison.slug / "k.svg").read_bytes())
    assert comparison.group in found
    assert "[red]x[/red] $\\frac{$ <b> &amp; [31m" in found


# --------------------------------------------------------------------------------------------------------------------------- errors


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("{", "Expecting property name"),
        ("[1]", "it is not a JSON object with 'step'"),
        ("{}", "it is not a JSON object with 'step'"),
        ("[" * 100_000, "it is nested too deeply"),
        ("\udcff", "can't decode byte"),
        ('{"step": "2000"}', "'step' is not a number of steps beyond that of the line before"),
        ('{"step": 1000}', "'step' is not a number of steps beyond that of the line before"),
        ('{"step": 99999999999999}', "'step' is not a number of steps beyond that of the line before"),
        ('{"step": true}', "'step' is not a number of steps beyond that of the line before"),
        ('{"step": 2000, "k": "3"}', "'k' is not a number"),
        ('{"step": 2000, "loss_step": true}', "'loss_step' is not a number"),
        ('{"step": 2000, "k": 1e300}', "'k' is beyond 1e+30"),
        ('{"step": 2000, "k": 1' + "0" * 400 + "}", "'k' is beyond 1e+30"),
        ('{"step": 2000, "k": 1' + "0" * 5000 + "}", "Exceeds the limit"),
    ],
    ids=lambda value: value[:20],
)  # fmt: skip
def test_a_damaged_line_is_named(line: str, why: str, put: Callable, datasets: Path) -> None:
    one = put(rows=learning()[:1])
    path = datasets / one / "diagnostics.jsonl"
    path.write_bytes(path.read_bytes() + line.encode("utf-8", "surrogateescape") + b"\n")
    for dataset_ids in (None, [one]):
        with pytest.raises(RunError) as caught:
            draw_diagnostics(dataset_ids, None)
        assert f"the diagnostics of '{one}' are damaged ({path}, line 2): " in str(caught.value)
        assert why in str(caught.value)
        assert str(caught.value).isprintable()


def test_files_that_cannot_be_read(put: Callable, datasets: Path) -> None:
    one = put(rows=[])
    with pytest.raises(RunError, match=r"line 1\): the file is empty"):
        read_diagnostics(one)
    path = datasets / one / "diagnostics.jsonl"
    path.unlink()
    path.mkdir()
    with pytest.raises(RunError, match="cannot read the diagnostics"):
        read_diagnostics(one)


def test_datasets_without_diagnostics_of_their_own(put: Callable, datasets: Path) -> None:
    base = put()
    put(dataset_id="walker/walk/cudc-v0", task="walk", base=Base(id=base, fingerprint="a" * 64, linked=True))
    imported = Import(source="ExORL", files=1, sha256="b" * 64)
    put("proto", imported=imported, profile="imported"), put("proto", 2, imported=imported, profile="imported", task="walk")
    bare = put("icm")
    (datasets / bare / "diagnostics.jsonl").unlink()
    refusals = {
        "walker/walk/cudc-v0": f"'walker/walk/cudc-v0' is labelled for walk; the diagnostics are those of its base '{base}'.",
        "walker/proto-seed1-v0": "'walker/proto-seed1-v0' has no diagnostics: it was imported from ExORL, not collected here.",
        "walker/proto-seed2-v0": "'walker/proto-seed2-v0' has no diagnostics: it was imported from ExORL, not collected here.",
        bare: f"'{bare}' has no diagnostics: there is no file {datasets / bare / 'diagnostics.jsonl'}.",
        "walker/none-v0": f"there is no dataset 'walker/none-v0' in {datasets}.",
        "../evil-v0": "'../evil-v0' is not a dataset id",
    }
    for one, message in refusals.items():
        with pytest.raises(UsageError) as caught:
            draw_diagnostics([base, one], None)
        assert str(caught.value).startswith(message)
    with pytest.raises(UsageError, match="no dataset was named"):
        draw_diagnostics([], None)
    # Without names, what has none is no mistake; what should have some is told.
    metadata_path("walker/none-v0").parent.mkdir(parents=True)
    metadata_path("walker/none-v0").write_text("{")
    report = draw_diagnostics(output=None)
    assert [run.id for comparison in report.comparisons for run in comparison.runs] == [base]
    assert [remark.split(" is left out: ")[0] for remark in report.remarks if "left out" in remark] == [bare]
    assert len([remark for remark in report.remarks if "the metadata of 'walker/none-v0' cannot be read" in remark]) == 1


def test_an_empty_root_says_what_to_run(datasets: Path, put: Callable) -> None:
    with pytest.raises(UsageError, match=r"has diagnostics; make one with: cudc-bench collect\."):
        draw_diagnostics(output=None)
    (datasets / put() / "diagnostics.jsonl").unlink()
    with pytest.raises(UsageError, match=r"Left out: 1, such as: walker/cudc-seed1-v0 is left out"):
        draw_diagnostics(output=None)


def test_an_output_that_cannot_be_a_folder_is_refused(put: Callable, tmp_path: Path) -> None:
    put()
    (tmp_path / "out").write_text("in the way")
    with pytest.raises(UsageError, match="cannot be a folder"):
        draw_diagnostics(output=tmp_path / "out")


def test_nothing_to_compare() -> None:
    assert compare([]) == ([], [])


# -------------------------------------------------------------------------------------------------------------------------- command


def test_the_command_on_real_datasets(cli: Callable, datasets: Path, tmp_path: Path) -> None:
    settings = {"steps": 2000}
    cudc_bench.collect("cudc", seeds=[1, 2], profile="smoke", settings=settings)
    cudc_bench.collect("random", profile="smoke", settings=settings)
    done = cli("diagnostics")
    assert done.code == 0, done.err
    assert done.err == ""
    assert "walker, profile smoke (collect: steps=2000)" in done.out
    files = [tmp_path / line for line in done.out.splitlines() if line.startswith("report/")]
    assert {file.name for file in files} == FIGURES | {"representation.svg", "representation.pdf"}
    assert sorted(file for file in (tmp_path / "report").rglob("*") if file.is_file()) == sorted(files)
    assert "random" not in texts(next(file for file in files if file.name == "k.svg").read_bytes())
    before = {file: file.read_bytes() for file in files}

    def told(dataset_id: str, name: str) -> dict[int, float]:
        rows = [json.loads(line) for line in (datasets / dataset_id / "diagnostics.jsonl").read_text().splitlines()]
        return {row["step"]: row[name] for row in rows if name in row}

    (comparison,) = draw_diagnostics(output=None).comparisons
    for figure, panels in ((draw_k(comparison), ["k"]), (draw_losses(comparison), list(LOSSES))):
        for panel, name in zip(figure.axes, panels, strict=True):
            (line,) = lines_of(panel)
            seeds = [told(one, name) for one in ("walker/cudc-smoke-v0", "walker/cudc-smoke-seed2-v0")]
            assert line.get_xdata().tolist() == list(seeds[0])
            assert len(seeds[0]) > 1
            np.testing.assert_allclose(line.get_ydata(), np.mean([list(values.values()) for values in seeds], axis=0))

    alone = cli("diagnostics", "walker/random-smoke-v0", "--output", "alone")
    assert alone.code == 0
    assert "there is no figure of k, since nothing here reports one (random)." in alone.err
    assert f"{told('walker/random-smoke-v0', 'coverage_cells')[2000]:,}" in alone.out
    assert not (tmp_path / "alone").exists()

    refused = cli("diagnostics", "walker/cudc-smoke-v0", "walker/cudk-v0")
    assert (refused.code, refused.out) == (2, "")
    assert refused.err == f"cudc-bench: error: there is no dataset 'walker/cudk-v0' in {datasets}.\n"
    with (datasets / "walker/random-smoke-v0/diagnostics.jsonl").open("a") as file:
        file.write('{"step": 20')
    damaged = cli("diagnostics", "--method", "random")
    assert (damaged.code, damaged.out, len(damaged.err.splitlines())) == (1, "", 1)
    assert "diagnostics.jsonl, line 5): " in damaged.err
    assert {file: file.read_bytes() for file in files} == before
