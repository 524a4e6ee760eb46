"""Figures in pages: axes fit what is drawn, lines are where the numbers are, and colours stand out by day and by night."""

from __future__ import annotations

from itertools import combinations
from math import log10
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cudc_bench.leaderboard.methods import PALETTE, styles
from cudc_bench.leaderboard.site.drawing import Axis, Line, Mark, References, linear, lines_panel, logarithmic, rows_panel
from cudc_bench.leaderboard.site.palette import CONTRAST, DARK, LIGHT, colour_class, contrast, on_ground, palette_css

LOOK = styles(("cudc",))["cudc"]
numbers = st.floats(allow_nan=False, allow_infinity=False, width=64)


@given(st.lists(numbers, min_size=1, max_size=5), st.lists(numbers, max_size=2))
def test_an_axis_holds_its_values_and_has_few_ticks(values, also):
    axis = linear(values, also=also)
    assert axis.low < axis.high
    clipped = [min(max(value, -1e100), 1e100) for value in values]
    assert axis.low <= min(clipped)
    assert max(clipped) <= axis.high
    assert len(axis.ticks) <= 12
    assert all(0 <= axis.place(tick, 0, 100) <= 100 for tick in axis.ticks)


@pytest.mark.parametrize(
    ("values", "ends", "ticks"),
    [
        ([30, 130], (0, 136.5), ["0", "50", "100"]),
        ([500, 560], (497, 563), ["500", "520", "540", "560"]),
        ([0.45, 0.53], (0.446, 0.534), ["0.46", "0.48", "0.50", "0.52"]),
        ([0, 1], (0, 1.05), ["0.00", "0.25", "0.50", "0.75", "1.00"]),
        ([7, 7], (6.65, 7.35), ["6.8", "7.0", "7.2"]),
    ],
)
def test_axes_fit_the_data(values, ends, ticks):
    axis = linear(values)
    assert (axis.low, axis.high) == pytest.approx(ends)
    assert list(axis.ticks.values()) == ticks


def test_what_is_near_is_on_the_axis_and_what_is_far_is_named():
    assert linear([100, 200], also=[230]).has(230)
    axis = linear([100, 200], also=[900])
    assert not axis.has(900)
    drawn = lines_panel("walk", [Line(LOOK, [(0, 100), (1, 200)])], linear([0, 1]), axis, References({"floor": 110, "ceiling": 900.4}))
    texts = [one.text for one in ElementTree.fromstring(drawn).iter("text")]
    assert "ceiling 900 ↑" in texts
    assert not any("floor" in (one or "") for one in texts)
    assert "floor: 110" in drawn


def test_lines_are_where_their_numbers_are():
    across, up = linear([0, 10], bounds=(0, 10)), Axis(0.0, 200.0, {})
    drawn = ElementTree.fromstring(lines_panel("", [Line(LOOK, [(0, 0), (5, 100), (10, 200)], [(0, 0, 50), (10, 150, 200)])], across, up))
    (line,) = [one for one in drawn.iter("path") if one.get("class") == "line"]
    corners = [float(part) for part in line.get("d")[1:].split()]
    # Of 320 by 200 pixels, less what names and ticks take.
    assert corners == [44, 162, 177, 93, 310, 24]
    (band,) = [one for one in drawn.iter("path") if one.get("class") == "band"]
    assert band.get("d") == "M44 162 310 58.5 310 24 44 127.5Z"


def test_rows_have_their_intervals_and_a_single_seed_is_hollow():
    marks = [Mark("a & <b>", LOOK, 50, (25, 75), title="it is 50"), Mark("c", LOOK, 100)]
    drawn = ElementTree.fromstring(rows_panel("walk", ["a & <b>", "c"], marks, Axis(0.0, 100.0, {})))
    assert [one.text for one in drawn.iter("text") if one.get("class") == "row"] == ["a & <b>", "c"]
    (interval,) = [one for one in drawn.iter("path") if one.get("class") == "interval"]
    whole, hollow = drawn.iter("circle")
    start, end = interval.get("d")[1:].split()[0], interval.get("d").partition("H")[2]
    assert float(whole.get("cx")) == pytest.approx((float(start) + float(end)) / 2, abs=0.1)
    assert (whole.get("class"), hollow.get("class")) == (None, "hollow")


def test_a_line_of_many_points_is_drawn_with_as_many_as_can_be_seen():
    points = [(float(step), float(step % 7)) for step in range(10_000)]
    drawn = lines_panel("", [Line(LOOK, points)], linear([0, 9_999]), linear([0, 7]))
    assert len(drawn) < 5_000


def test_a_logarithmic_axis_is_one():
    axis = logarithmic(1, 10_000, {10.0: "10", 100.0: "100"})
    assert [axis.place(value, 0, 4) for value in (1, 10, 1_000, 10_000)] == pytest.approx([log10(one) for one in (1, 10, 1_000, 10_000)])


@pytest.mark.parametrize("ground", [LIGHT, DARK])
def test_methods_colours_stand_out_and_differ(ground):
    found = [on_ground(one, ground) for one in PALETTE]
    assert min(contrast(one, ground) for one in found) >= CONTRAST
    assert all(first != second for first, second in combinations(found, 2))


def test_every_colour_of_a_method_has_its_class():
    css = palette_css()
    every = {one["color"] for one in styles([*map(str, range(40)), "cudc", "be", "cudc-kmax8", "cudc-live"]).values()}
    assert every <= set(PALETTE)
    assert all(f".{colour_class(one)} {{" in css for one in PALETTE)
