"""Which scores enter a comparison, what is said of the rest, and how it is shown."""

from __future__ import annotations

import csv
import io
import random
from collections.abc import Callable
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from matplotlib import style
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from rich.console import Console

from cudc_bench.artefacts.records import Record
from cudc_bench.envs.domains import DOMAINS
from cudc_bench.leaderboard.methods import COLOURS
from cudc_bench.leaderboard.numbers import statistics
from cudc_bench.leaderboard.numbers.overall import ALL, THRESHOLDS, Overall, build_overall
from cudc_bench.leaderboard.numbers.statistics import Interval
from cudc_bench.leaderboard.numbers.table import build_tables
from cudc_bench.leaderboard.show.csv import of_overall as overall_to_csv
from cudc_bench.leaderboard.show.csv import of_scores as scores_to_csv
from cudc_bench.leaderboard.show.figures.comparisons import (
    draw_domains,
    draw_intervals,
    draw_profiles,
    draw_ranks,
    overall_figure_files,
    overall_figures,
)  # fmt: skip
from cudc_bench.leaderboard.show.figures.drawing import _STYLE
from cudc_bench.leaderboard.show.latex import of_overall as overall_to_latex
from cudc_bench.leaderboard.show.markdown import of_overall as overall_to_markdown
from cudc_bench.leaderboard.show.terminal import of_overall as overall_to_rich

quick = settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(autouse=True)
def fewer_resamples(monkeypatch: pytest.MonkeyPatch) -> None:
    draw = statistics.draw
    monkeypatch.setattr(statistics, "draw", lambda n, tasks, name: draw(n, tasks, name, 500))


@pytest.fixture
def runs(make_record: Callable) -> Callable[..., list[Record]]:
    """Records of a method on all tasks of some domains, with returns that are different everywhere."""

    def make(method: str, seeds: range = range(1, 6), domains: tuple[str, ...] = ("walker", "jaco"), level: float = 0.3, **changes: object):
        return [
            make_record(
                method, task, seed,
                scores=[(0, [0.0]), (10_000, [0.5 * score]), (20_000, [1.0])], final=[score], dataset_domain=domain, **changes,
            )
            for domain in domains
            for index, task in enumerate(DOMAINS[domain].tasks)
            for seed in seeds
            for score in [DOMAINS[domain].max_return * (level + 0.05 * index + 0.01 * seed + 0.003 * (seed * index % 3))]
        ]  # fmt: skip

    return make


def only(records: list[Record]) -> Overall:
    (overall,) = build_overall(build_tables(records)[0])
    return overall


def without(records: list[Record], **what: object) -> list[Record]:
    """Records but those whose dataset is all of ``what``."""
    return [one for one in records if any(getattr(one.dataset, name) != value for name, value in what.items())]


def test_scopes_and_milestones(runs: Callable) -> None:
    overall = only([*runs("cudc"), *runs("random", level=0.1)])
    assert (overall.group, overall.algorithm, overall.slug) == ("cpu", "td3", "cpu.td3")
    shown = [(one.scope, one.milestone, len(one.tasks)) for one in overall.comparisons]
    assert shown == [(scope, step, tasks) for step in (20_000, 10_000) for scope, tasks in ((ALL, 8), ("walker", 4), ("jaco", 4))]
    assert overall.headline is overall.comparisons[0]
    assert overall.headline.methods == ("random", "cudc")
    assert overall.headline.left_out == ()


def test_one_domain_is_one_scope(runs: Callable) -> None:
    assert [one.scope for one in only(runs("cudc", domains=("jaco",))).comparisons] == ["jaco", "jaco"]


def test_scores_are_returns_divided_by_the_tasks_largest(runs: Callable) -> None:
    records = runs("cudc")
    headline = only(records).headline
    (standing,) = headline.standings
    assert headline.tasks == tuple((domain, task) for domain in ("walker", "jaco") for task in DOMAINS[domain].tasks)
    assert headline.domains == ("walker", "jaco")
    for domain, returns, scores in zip(headline.domains, standing.returns, standing.scores, strict=True):
        for column, task in enumerate(DOMAINS[domain].tasks):
            expected = [one.final.mean for one in records if (one.dataset.domain, one.dataset.task) == (domain, task)]
            assert returns[:, column].tolist() == expected
            assert scores[:, column] == pytest.approx(np.array(expected) / {"walker": 1000, "jaco": 250}[domain])
    for name, aggregate in statistics.AGGREGATES.items():
        assert standing.estimates[name].value == aggregate(standing.scores)
    assert standing.profile.tolist() == statistics.profile(standing.scores, THRESHOLDS).tolist()
    for before, last in zip(only(records).comparisons[3].standings[0].returns, standing.returns, strict=True):
        assert before == pytest.approx(0.5 * last)


def test_training_runs_on_one_dataset_are_one_seed(runs: Callable) -> None:
    again = [
        one.model_copy(update={"seed": 2, "final": one.final.model_copy(update={"returns": [one.final.mean + 10]})})
        for one in runs("cudc", range(1, 2))
    ]
    once, twice = only(runs("cudc")).headline.standings[0], only([*runs("cudc"), *again]).headline.standings[0]
    assert once.n == twice.n == 5
    for before, after in zip(once.returns, twice.returns, strict=True):
        assert after[0] == pytest.approx(before[0] + 5)
        assert (after[1:] == before[1:]).all()


def test_a_method_without_a_domain_is_compared_on_the_others(runs: Callable) -> None:
    overall = only([*runs("cudc"), *runs("random"), *runs("rnd", domains=("walker",))])
    every, walker, jaco = overall.comparisons[:3]
    assert every.methods == ("random", "cudc")
    assert every.left_out == ("rnd: it has no results on jaco.",)
    assert walker.methods == ("random", "cudc", "rnd")
    assert jaco.methods == ("random", "cudc")
    assert len(every.tasks) == 8


def test_only_tasks_that_all_methods_have_are_compared(runs: Callable) -> None:
    headline = only([*runs("cudc"), *without(runs("random"), domain="walker", task="flip")]).headline
    assert ("walker", "flip") not in headline.tasks
    assert [[block.shape for block in standing.scores] for standing in headline.standings] == [[(5, 3), (5, 4)]] * 2
    assert headline.left_out == ("walker flip: random lacks it.",)


def test_a_seed_enters_with_all_tasks_of_its_domain_or_not_at_all(runs: Callable) -> None:
    headline = only([*without(runs("cudc"), domain="walker", task="run", seed=2), *runs("random")]).headline
    random_runs, cudc = headline.standings
    # The other domain loses none for that.
    assert cudc.seeds == {"walker": (1, 3, 4, 5), "jaco": (1, 2, 3, 4, 5)}
    assert (cudc.n, random_runs.n) == (4, 5)
    assert (cudc.seeds_text, random_runs.seeds_text, headline.seeds) == ("4 to 5", "5", "4 to 5 seeds")
    assert headline.preliminary
    assert headline.left_out == ("cudc, walker, seed 2: without all of the tasks.",)


def test_a_domain_with_few_seeds_takes_none_from_another(runs: Callable) -> None:
    records = [*runs("cudc", range(1, 9), ("walker",)), *runs("cudc", range(1, 4), ("jaco",))]
    every, walker, jaco = only(records).comparisons[:3]
    (both,), (alone,) = every.standings, walker.standings
    assert [block.shape for block in both.scores] == [(8, 4), (3, 4)]
    assert every.left_out == ()
    assert both.scores[0].tolist() == alone.scores[0].tolist()
    # Each task weighs the same.
    means = [one.standings[0].estimates["mean"] for one in (walker, jaco)]
    assert both.estimates["mean"].value == pytest.approx((means[0].value + means[1].value) / 2)
    assert both.estimates["mean"].interval is not None
    assert both.estimates["mean"].stratified is None  # rliable's is of one number of seeds
    frame = pd.read_csv(io.StringIO(overall_to_csv(only(records))))
    assert frame[frame.scope == ALL][["seeds", "datasets"]].drop_duplicates().to_numpy().tolist() == [[3, 11]]
    assert len(pd.read_csv(io.StringIO(scores_to_csv(only(records)))).query("scope == @ALL and milestone == 20000")) == 8 * 4 + 3 * 4


def test_ranks_are_of_methods_with_the_same_seeds(runs: Callable) -> None:
    alike = only([*runs("cudc", level=0.5), *runs("random"), *runs("icm")]).headline
    assert alike.unranked is None
    assert not any("ranks" in line for line in alike.remarks)
    assert np.sum([standing.ranks for standing in alike.standings], axis=0) == pytest.approx([1, 1, 1])
    assert alike.standings[2].ranks[0] > 0.99
    others = {
        "of fewer seeds": [*runs("cudc"), *runs("random", range(1, 5))],
        "of other seeds": [*runs("cudc"), *runs("random", range(2, 7))],
        "of fewer in one domain": [*runs("cudc"), *runs("random", domains=("walker",)), *runs("random", range(1, 4), ("jaco",))],
        "of a third method": [*runs("cudc"), *runs("random"), *runs("icm", range(1, 2))],
    }
    for what, records in others.items():
        comparison = only(records).headline
        assert [standing.ranks for standing in comparison.standings] == [None] * len(comparison.standings), what
        assert comparison.remarks[0] == "No probabilities of ranks: the methods do not have the same collector seeds."
        assert "ranks" not in overall_figures(only(records))
    assert "rank_1" not in overall_to_csv(only(others["of fewer seeds"]))
    assert "No probabilities of ranks" in overall_to_markdown(only(others["of fewer seeds"]))
    single = only([*runs("cudc", range(1, 2)), *runs("random", range(1, 2))]).headline
    assert single.unranked == "each method has a single seed in a domain"
    assert only(runs("cudc")).headline.remarks == ()  # There is nothing to be ranked.


def test_a_method_whose_seeds_share_no_domain_is_left_out(runs: Callable) -> None:
    records = runs("cudc", range(1, 3), ("walker",))
    torn = [one for one in runs("icm", range(1, 5), ("walker",)) if (one.dataset.seed < 3) == (one.dataset.task == "run")]
    comparison = only([*records, *torn]).headline
    assert comparison.methods == ("cudc",)
    assert comparison.left_out[-1] == "icm: no collector seed has all of a domain's tasks."


def test_methods_that_share_no_domain_are_not_ranked_together(runs: Callable) -> None:
    overall = only([*runs("cudc", domains=("walker",)), *runs("icm", domains=("jaco",)), *runs("apt", domains=("jaco",))])
    assert [one.scope for one in overall.comparisons] == ["walker", "jaco"] * 2
    assert overall.headline.methods == ("icm", "apt")


def test_what_has_no_known_largest_return_does_not_enter(runs: Callable, make_record: Callable) -> None:
    headline = only([*runs("cudc"), make_record(task="juggle"), make_record(dataset_domain="cheetah", task="run")]).headline
    assert len(headline.tasks) == 8
    assert set(headline.left_out) == {
        "cheetah: run: their largest return is not known.",
        "walker: juggle: their largest return is not known.",
    }
    assert build_overall(build_tables([make_record(dataset_domain="cheetah")])[0]) == []


def test_domains_with_other_milestones_are_left_out_of_them(runs: Callable) -> None:
    late = runs("cudc", domains=("jaco",), milestones=[10_000])
    overall = only([*runs("cudc", domains=("walker",)), *late])
    assert [(one.scope, one.milestone) for one in overall.comparisons] == [
        ("walker", 20_000), (ALL, 10_000), ("walker", 10_000), ("jaco", 10_000),
    ]  # fmt: skip
    # Its records were evaluated there, but it is nothing that was asked of them.
    assert overall.headline.left_out == ("jaco: 20K steps is none of its milestones.",)


def test_groups_and_algorithms_are_apart(runs: Callable) -> None:
    records = [*runs("cudc"), *runs("cudc", profile="paper"), *runs("cudc", algorithm="cql"), *runs("cudc", overrides={"gamma": 0.5})]
    found = build_overall(build_tables(records)[0])
    assert len({one.slug for one in found}) == 4
    assert {len(one.headline.standings) for one in found} == {1}


def test_no_slug_is_that_of_a_domain(runs: Callable, make_record: Callable) -> None:
    records = [*runs("cudc"), *(make_record(dataset_domain=domain) for domain in ("overall", "td3", "cpu"))]
    tables, _ = build_tables(records)
    assert not {table.slug for table in tables} & {one.slug for one in build_overall(tables)}


def test_a_single_seed_has_no_interval_and_improves_on_nothing(runs: Callable) -> None:
    overall = only([*runs("cudc", range(1, 2), level=0.7), *runs("random", level=0.1), *runs("icm", level=0.2)])
    headline = overall.headline
    random_runs, icm, cudc = headline.standings
    assert cudc.band is cudc.estimates["iqm"].interval is cudc.estimates["iqm"].stratified is None
    pair = headline.pair("cudc", "random")
    assert (pair.probability, pair.interval, pair.p, pair.holm, pair.better) == (1.0, None, None, None, False)
    assert headline.pair("icm", "random").better
    # How likely a method comes first depends on all others.
    assert icm.ranks is random_runs.ranks is None
    # A family is those that can be tested.
    assert headline.pair("icm", "random").holm == headline.pair("icm", "random").p
    assert "A single seed has no interval. Preliminary: fewer than five seeds" in overall.caption


def test_improvements_need_both_the_interval_and_the_corrected_p(runs: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    records = [*runs("cudc", level=0.5), *runs("random", level=0.1), *runs("icm", level=0.499)]
    headline = only(records).headline
    assert [pair.better for pair in (headline.pair("cudc", "random"), headline.pair("random", "cudc"))] == [True, False]
    near = headline.pair("cudc", "icm")
    assert not near.better
    assert near.probability == pytest.approx(1 - headline.pair("icm", "cudc").probability)
    assert near.holm == headline.pair("icm", "cudc").p == near.p
    assert headline.pair("cudc", "random").holm == pytest.approx(2 * headline.pair("cudc", "random").p)
    with monkeypatch.context() as patch:
        patch.setattr(statistics, "improvement_p", lambda *_: 0.03)
        assert not any(pair.better for pair in only(records).headline.pairs)
    with monkeypatch.context() as patch:
        patch.setattr(statistics, "improvement_interval", lambda *_: Interval(0.49, 0.9))
        assert not any(pair.better for pair in only(records).headline.pairs)


def test_other_methods_change_nothing_of_a_methods_interval(runs: Callable) -> None:
    alone = only(runs("cudc")).headline.standings[0]
    beside = only([*runs("cudc"), *runs("icm"), *runs("zeta")]).headline.standings[1]
    assert alone.estimates == beside.estimates
    assert (alone.band[0] == beside.band[0]).all()


def test_order_of_records_does_not_matter(runs: Callable) -> None:
    records = [*runs("cudc"), *runs("icm", range(1, 4)), *without(runs("apt"), task="run", seed=3)]
    first = only(records)
    random.Random(1).shuffle(records)
    again = only(records)
    assert overall_to_csv(first) == overall_to_csv(again)
    assert scores_to_csv(first) == scores_to_csv(again)
    assert overall_to_markdown(first) == overall_to_markdown(again)


@quick
@given(data=st.data())
def test_whatever_is_missing_the_tasks_are_common_and_the_numbers_in_bounds(data: st.DataObject, runs: Callable) -> None:
    records = [*runs("cudc", range(1, 4)), *runs("icm", range(1, 3)), *runs("random", range(2, 4))]
    kept = [record for record in records if data.draw(st.integers(0, 9))]
    kept += data.draw(st.lists(st.sampled_from(records), max_size=3))
    for overall in build_overall(build_tables(kept)[0]):
        for one in overall.comparisons:
            for standing in one.standings:
                assert sum(block.shape[1] for block in standing.scores) == len(one.tasks)
                assert [len(block) for block in standing.scores] == standing.counts
                for found in standing.estimates.values():
                    ends = [end for it in (found.interval, found.stratified) if it for end in (it.low, it.high)]
                    assert all(0 <= number <= 1 for number in (found.value, *ends))
                    assert bool(ends) == (standing.n > 1)
                    assert found.interval is None or found.interval.low <= found.value <= found.interval.high
            assert all(0 <= pair.probability <= 1 for pair in one.pairs)
            assert len(one.pairs) == len(one.methods) * (len(one.methods) - 1)
            entered = {(domain, task) for domain, task in one.tasks}
            everything = {(r.dataset.domain, r.dataset.task) for r in kept if one.scope in {ALL, r.dataset.domain}}
            assert entered == everything or one.left_out
        overall_to_markdown(overall), overall_to_latex(overall), overall_to_rich(overall)


def test_renderings(runs: Callable) -> None:
    records = [*runs("cudc", level=0.5), *runs("random", level=0.1), *runs("my_method", range(1, 2)), *runs("late", domains=("walker",))]
    overall = only(records)
    win = overall.headline.pair("cudc", "random").interval
    text, latex = overall_to_markdown(overall), overall_to_latex(overall)
    mean = overall.headline.standings[1].estimates["mean"]
    assert f"| cudc | {mean.value:.3f} \\[{mean.interval.low:.3f}, {mean.interval.high:.3f}\\] \\{{" in text
    assert "### all domains, 20K steps, 8 tasks, 1 to 5 seeds" in text
    assert f"| cudc | **1.00 \\[{win.low:.2f}, 1.00\\]** | – | 1.00 |" in text
    assert "- late: it has no results on jaco." in text
    assert f"cudc & {mean.value:.3f} [{mean.interval.low:.3f}, {mean.interval.high:.3f}] \\{{" in latex
    assert r"cudc & \textbf{1.00} & -- & 1.00 \\" in latex
    assert r"my\_method & " in latex
    assert latex.isascii()
    rows = [line for line in latex.split(r"\begin{tabular}")[2].splitlines() if line.endswith(r"\\")]
    assert {line.count("&") for line in rows} == {3}
    screen = Console(file=io.StringIO(), width=80)
    screen.print(overall_to_rich(overall))
    shown = screen.file.getvalue()
    assert f"{mean.value:.3f}  [{mean.interval.low:.3f}, {mean.interval.high:.3f}]" in shown
    assert "Left out: late: it has no results on jaco." in shown
    assert "Preliminary: fewer than five seeds" in shown
    frame = pd.read_csv(io.StringIO(overall_to_csv(overall)))
    line = frame[(frame.scope == ALL) & (frame.milestone == 20_000) & (frame.method == "cudc") & (frame.statistic == "mean")].iloc[0]
    assert (line.value, line.low, line.high, line.stratified_low) == (
        mean.value,
        mean.interval.low,
        mean.interval.high,
        mean.stratified.low,
    )
    (win,) = frame[(frame.scope == ALL) & (frame.milestone == 20_000) & (frame.method == "cudc") & (frame.other == "random")].itertuples()
    assert (win.value, win.improvement) == (1.0, True)
    scores = list(csv.DictReader(io.StringIO(scores_to_csv(overall))))
    assert len([one for one in scores if one["scope"] == ALL]) == 2 * 8 * 11
    assert all(float(one["score"]) == float(one["return"]) / DOMAINS[one["domain"]].max_return for one in scores)


def drawn_texts(figure: Figure) -> list[tuple[str, Bbox]]:
    """Each text that can be seen, and where it is."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    hidden = {
        id(tick.label1)
        for panel in figure.axes
        for axis in (panel.xaxis, panel.yaxis)
        for tick in axis.get_major_ticks()
        if not min(axis.get_view_interval()) <= tick.get_loc() <= max(axis.get_view_interval())
    }
    texts = [one for one in figure.findobj(Text) if one.get_text() and one.get_visible() and id(one) not in hidden]
    return [(one.get_text(), one.get_window_extent(canvas.get_renderer())) for one in texts]


def test_figures_of_twelve_methods_have_no_text_upon_another(runs: Callable) -> None:
    methods = [*COLOURS, "cic", "diayn", "disagreement", "cudc-no-regularize", "proto_of_somebody_else_with_a_long_name", "be"]
    overall = only([record for i, method in enumerate(methods) for record in runs(method, level=0.2 + 0.004 * i)])
    with style.context(_STYLE, after_reset=True):
        for draw in (draw_intervals, draw_profiles, draw_ranks):
            figure = draw(overall)
            texts = drawn_texts(figure)
            assert len(texts) > 20
            for index, (text, box) in enumerate(texts):
                assert not [(text, other) for other, place in texts[index + 1 :] if box.overlaps(place)]
                assert figure.bbox.x0 - 1 <= box.x0, draw
                assert box.x1 <= figure.bbox.x1 + 1, draw


def test_figures_are_repeatable_and_show_what_they_should(runs: Callable) -> None:
    overall = only([*runs("cudc", level=0.5), *runs("random"), *runs("icm", range(1, 2))])
    assert set(overall_figures(overall)) == {"intervals", "profiles", "domains"}
    ranked = only([*runs("cudc", level=0.5), *runs("random"), *runs("icm")])
    files = overall_figure_files(ranked)
    names = ("intervals", "profiles", "ranks", "domains")
    assert set(files) == {f"{name}.{kind}" for name in names for kind in ("svg", "pdf")}
    assert files == overall_figure_files(ranked)
    for name in names:
        texts = {element.text for element in ElementTree.fromstring(files[f"{name}.svg"]).iter("{http://www.w3.org/2000/svg}text")}
        assert {"cudc", "icm", "random"} <= texts
    (panel, *_) = draw_intervals(overall).axes
    lines = {tuple(line.get_xdata()) for line in panel.lines}
    mean = overall.headline.standings[2].estimates["mean"]
    assert {(mean.value,), (mean.interval.low, mean.interval.high), (mean.stratified.low, mean.stratified.high)} <= lines
    assert "ranks" not in overall_figures(only(runs("cudc", range(1, 2))))
    every, walker, jaco = draw_domains(overall).axes
    assert [panel.get_title() for panel in (every, walker, jaco)] == [ALL, "walker", "jaco"]
    assert (mean.value,) in {tuple(line.get_xdata()) for line in every.lines}
    assert every.get_xlim() == walker.get_xlim() == jaco.get_xlim()
    assert "domains" not in overall_figures(only(runs("cudc", domains=("jaco",))))
