from __future__ import annotations

import random
import xml.etree.ElementTree as ET

import matplotlib
import numpy as np
import pytest

from cudc_bench.leaderboard.methods import COLOURS, METHOD_ORDER, styles
from cudc_bench.leaderboard.numbers.figures import curve
from cudc_bench.leaderboard.numbers.table import build_tables
from cudc_bench.leaderboard.show.figures.runs import curve_files, draw_curves


def only(records):
    (table,), _ = build_tables(records)
    return table


def texts(svg):
    return [element.text for element in ET.fromstring(svg).iter("{http://www.w3.org/2000/svg}text")]


def lines_of(panel):
    """The lines of methods; milestones are dotted."""
    return [line for line in panel.get_lines() if line.get_linestyle() != ":"]


def test_curve_is_the_mean_over_seeds_with_the_final_evaluation_last(make_record):
    records = [
        make_record(seed=1, scores=[(0, [0.0]), (10, [1.0, 3.0]), (20, [9.0])], final=[10.0]),
        make_record(seed=2, scores=[(0, [4.0]), (10, [6.0]), (15, [1.0]), (20, [9.0])], final=[30.0]),
    ]
    steps, means, stds = curve(records)
    assert steps == [0, 10, 20]
    assert means == [2.0, 4.0, 20.0]
    assert stds == pytest.approx([np.std(pair, ddof=1) for pair in ([0, 4], [2, 6], [10, 30])])


def test_curve_of_one_seed_has_no_band(make_record):
    assert curve([make_record()]) == ([0, 10_000, 20_000], [0.0, 150.0, 500.0], None)


def test_curves_without_a_common_step_draw_nothing(make_record):
    records = [make_record(seed=1, scores=[(1, [0.0])]), make_record(seed=2, scores=[(2, [0.0])])]
    assert curve(records) == ([], [], [])
    assert curve_files(only(records)).keys() == {"curves.svg", "curves.pdf"}


def test_a_panel_for_each_task_and_a_line_for_each_method(make_record):
    table = only(
        [
            *(make_record(task=task, seed=seed) for task in ("run", "stand") for seed in (1, 2)),
            make_record(method="random", task="run"),
        ]
    )
    stand, run = draw_curves(table.runs).axes
    assert (stand.get_title(), run.get_title()) == ("stand", "run")
    assert len(lines_of(stand)) == 1
    assert (len(lines_of(run)), len(run.collections)) == (2, 1)
    assert run.get_ylim() == (0, 1000)
    assert run.get_xlim() == (0, 20_000)
    dotted = [line.get_xdata()[0] for line in run.get_lines() if line.get_linestyle() == ":"]
    assert dotted == [10_000, 20_000]
    thin, thick = (line.get_linewidth() for line in lines_of(run))
    assert thin < thick


def test_returns_of_unknown_tasks_are_not_cut_off(make_record):
    panel = draw_curves(only([make_record(task="juggle", final=[5000.0])]).runs).axes[0]
    assert panel.get_ylim()[1] >= 5000


def test_svg_is_xml_with_each_label_as_text(make_record):
    table = only([make_record(method=method) for method in (*METHOD_ORDER, "cudc-no-reach", "my_method")])
    found = texts(curve_files(table)["curves.svg"])
    assert set(table.methods) <= set(found)
    assert {"walk", "gradient steps", "return", "10K", "20K"} <= set(found)


def test_hostile_text_is_shown_as_it_is(make_record):
    table = only([make_record(overrides={"note": "$\\frac{$ <b> &amp; \x00 \x1b[31m ]]>"})])
    joined = " ".join(filter(None, texts(curve_files(table)["curves.svg"])))
    assert table.group in joined


def test_same_records_give_same_bytes_whatever_the_users_settings(make_record):
    records = [make_record(method=method, seed=seed) for method in ("cudc", "icm") for seed in (1, 2)]
    first = curve_files(only(records))
    random.Random(0).shuffle(records)
    with matplotlib.rc_context({"axes.facecolor": "red", "svg.fonttype": "path", "font.size": 30}):
        assert curve_files(only(records)) == first
    assert first["curves.pdf"].startswith(b"%PDF")


def test_no_date_is_written(make_record):
    files = curve_files(only([make_record()]))
    assert b"<dc:date>" not in files["curves.svg"]
    assert b"CreationDate" not in files["curves.pdf"]


def test_methods_look_different_and_the_papers_always_the_same():
    methods = [*METHOD_ORDER, *(f"other{i}" for i in range(9))]
    assert len({(style["color"], style["linestyle"]) for style in styles(methods).values()}) == len(methods)
    assert tuple(COLOURS) == METHOD_ORDER[: len(COLOURS)]
    assert styles(["zeta", "cudc"])["cudc"] == styles(methods)["cudc"]


def test_settings_of_matplotlib_are_left_as_they_were(make_record):
    before = dict(matplotlib.rcParams)
    curve_files(only([make_record()]))
    assert dict(matplotlib.rcParams) == before
