"""Verdicts say what the tests say: whatever the scores, no sentence claims a difference that no pair has, or leaves one out."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cudc_bench.leaderboard.numbers.grid import Entry
from cudc_bench.leaderboard.numbers.overall import Comparison, Estimate, Overall, Pair, Standing
from cudc_bench.leaderboard.numbers.table import mark_best
from cudc_bench.leaderboard.numbers.verdict import task_verdict, verdict

NAMES = ("random", "icm", "apt", "proto", "aps", "cudc")


def said(methods: Sequence[str], wins: set[tuple[str, str]], seeds: int = 5, single: Sequence[str] = ()) -> str:
    """What is said of methods of which some beat others."""
    counts = {method: 1 if method in single else seeds for method in methods}
    nothing = Estimate(0.5, None, None)
    standings = tuple(
        Standing(method, (np.zeros((n, 1)),), (np.zeros((n, 1)),), {"walker": tuple(range(n))}, {"mean": nothing}, np.zeros(1), None, None)
        for method, n in counts.items()
    )
    pairs = tuple(Pair(x, y, 0.5, None, None, None, (x, y) in wins) for x in methods for y in methods if x != y)
    comparison = Comparison("walker", 10, (("walker", "walk"),), standings, pairs, ())
    return " ".join(verdict(Overall("cpu", "td3", "cpu.td3", (comparison,)), comparison))


EQUAL = "Methods that cannot be told apart need not be equal."


def test_what_is_said_of_ordinary_results() -> None:
    beat_random = {(method, "random") for method in NAMES[1:]}
    assert said(NAMES, beat_random) == (f"Five methods cannot be told apart: icm, apt, proto, aps and cudc. All five beat random. {EQUAL}")
    assert said(NAMES, set()).startswith(
        "Five methods cannot be told apart: icm, apt, proto, aps and cudc. icm, apt, proto, aps and cudc cannot be told from random."
    )
    best = {("cudc", other) for other in NAMES[:-1]}
    assert said(NAMES, beat_random | best) == f"cudc beats all four others. All five beat random. {EQUAL}"
    assert said(("random", "cudc"), {("cudc", "random")}) == "cudc beats random."
    assert said(("random", "cudc"), {("random", "cudc")}) == "random beats cudc."
    assert said(("icm", "cudc"), {("cudc", "icm")}) == "cudc beats icm."
    assert said(("random", "icm", "apt"), {("icm", "random")}) == (
        f"Two methods cannot be told apart: icm and apt. icm beats random; apt cannot be told from it. {EQUAL}"
    )
    assert said(("icm", "apt", "aps", "cudc"), {("cudc", "icm"), ("apt", "icm"), ("cudc", "aps")}) == (
        "Of four methods none is found better than apt or cudc, and these cannot be told apart; apt beats one and cudc beats two."
        f" Beaten by another: icm and aps. {EQUAL}"
    )


def test_what_cannot_be_tested_is_not_judged() -> None:
    assert said(("cudc",), set()) == "There is one method only, and nothing to compare it with."
    for seeds, methods in ((1, ("icm", "cudc")), (5, ("icm", "cudc"))):
        text = said(methods, set(), seeds, single=("icm",))
        assert text == "Nothing can be told yet: a test needs two collector seeds in each domain of two methods at least."
    assert said(("icm", "apt", "cudc"), set(), 5, single=("icm",)) == (
        f"Two methods cannot be told apart: apt and cudc. Not tested, with a single seed in a domain: icm. {EQUAL}"
    )
    # Two against two datasets of one domain can give no p below 1/3.
    assert said(("apt", "cudc"), set(), 2).endswith("No difference could be found: with so few seeds nothing can pass the test.")


@settings(suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_whatever_is_found_no_sentence_says_more(data: st.DataObject) -> None:
    methods = data.draw(st.lists(st.sampled_from([*NAMES, *"abcdefghi"]), min_size=1, max_size=14, unique=True))
    pairs = [(x, y) for x in methods for y in methods if x < y]
    found = data.draw(st.lists(st.sampled_from(pairs), unique=True)) if pairs else []
    wins = {pair if data.draw(st.booleans()) else pair[::-1] for pair in found}
    single = data.draw(st.lists(st.sampled_from(methods), unique=True, max_size=2))
    wins = {pair for pair in wins if not set(pair) & set(single)}
    text = said(methods, wins, 9, single)
    tested = [method for method in methods if method not in single]
    if len(tested) < 2:
        assert "beat" not in text
        return
    others = [method for method in tested if method != "random"]
    among = {pair for pair in wins if "random" not in pair}
    assert ("methods cannot be told apart" in text) == (len(others) > 1 and not among)
    assert ("Both beat random." in text or "All " in text) == (
        "random" in tested and len(others) > 1 and all((one, "random") in wins for one in others)
    )
    assert ("need not be equal" in text) == (len({frozenset(pair) for pair in wins}) < len(tested) * (len(tested) - 1) // 2)
    for method in single:
        assert method in text.partition("single seed in a domain: ")[2]


def test_a_task_is_judged_by_its_marks() -> None:
    def of(**cells: tuple[float, float | None, int]) -> str:
        entries = [Entry(mean, std, None, n) for mean, std, n in cells.values()]
        return " ".join(task_verdict({name: one for name, one in zip(cells, mark_best(entries), strict=True) if one}))

    assert of(cudc=(900, 10, 5), icm=(895, 10, 5), random=(100, 10, 5), mine=(50, None, 1)) == (
        "cudc has the largest mean. Not significantly worse, or the same after rounding: icm. Significantly worse: random."
        " Not tested, with a single seed: mine."
    )
    assert of(cudc=(900, None, 1), icm=(100, 10, 5)) == (
        "cudc has the largest mean. It has a single seed, so that nothing can be tested against it."
    )
    assert of(cudc=(900, 10, 5)) == "There is one method only: cudc."
    assert task_verdict({}) == ()


@pytest.mark.parametrize("seeds", [2, 5])
def test_real_comparisons_have_a_verdict_for_each_milestone(example_records: list, seeds: int, make_record: Callable) -> None:
    from cudc_bench.leaderboard.numbers.overall import build_overall
    from cudc_bench.leaderboard.numbers.table import build_tables

    records = [
        make_record(method, task, seed, final=[base + 3.0 * seed])
        for method, base in (("random", 10.0), ("icm", 400.0), ("cudc", 400.5)) for task in ("walk", "run") for seed in range(seeds)
    ]  # fmt: skip
    (overall,) = build_overall(build_tables(records)[0])
    text = " ".join(verdict(overall, overall.headline))
    if seeds == 5:
        assert text.startswith(
            "Two methods cannot be told apart: icm and cudc. Both beat random. Methods that cannot be told apart need not"
        )
        assert text.endswith("points a task is found in 8 of 10 cases.")
    else:
        assert "nothing can pass the test" in text
