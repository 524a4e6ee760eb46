"""The least p-values and the leads that so many seeds can show, against simulations with the leaderboard's own test."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from rich.console import Console
from scipy import stats

from cudc_bench.artefacts.records import Record
from cudc_bench.artefacts.references import Bounds
from cudc_bench.leaderboard.numbers import power as ours
from cudc_bench.leaderboard.numbers import statistics
from cudc_bench.leaderboard.numbers.overall import Overall, build_overall
from cudc_bench.leaderboard.numbers.table import build_tables
from cudc_bench.leaderboard.show.csv import of_power as power_to_csv
from cudc_bench.leaderboard.show.latex import of_overall as overall_to_latex
from cudc_bench.leaderboard.show.markdown import of_overall as overall_to_markdown
from cudc_bench.leaderboard.show.terminal import of_overall as overall_to_rich

TASKS = ("stand", "walk", "run", "flip")
COVARIANCE = 0.05**2 * (0.3 * np.eye(4) + 0.7) * np.outer([1, 1, 0.4, 0.7], [1, 1, 0.4, 0.7])


def drawn(random: np.random.Generator, seeds: int, covariances: Sequence[np.ndarray], lead: float = 0.0) -> list[np.ndarray]:
    return [lead + random.multivariate_normal(np.zeros(len(one)), one, size=seeds) for one in covariances]


@pytest.mark.parametrize(
    ("seeds", "domains", "comparisons"), [(5, 1, 5), (4, 1, 1), (6, 1, 2), (9, 1, 5), (2, 3, 1), (3, 3, 4), (5, 3, 5)]
)  # fmt: skip
def test_a_lead_of_that_size_is_found_in_eight_of_ten_cases(seeds: int, domains: int, comparisons: int) -> None:
    """By what makes an improvement: the p-value of the records' own test after the strictest correction, and the interval."""
    covariances = [COVARIANCE] * domains
    deviation = float(np.sqrt(sum(one.sum() for one in covariances))) / (4 * domains)
    lead = ours.smallest_lead(covariances, seeds, comparisons, deviation)
    assert lead is not None
    random = np.random.default_rng(3)
    found, repeats = 0, 500
    for _ in range(repeats):
        x, y = drawn(random, seeds, covariances, lead), drawn(random, seeds, covariances)
        interval = statistics.improvement_interval(x, y)
        found += interval is not None and interval.low > 0.5 and statistics.improvement_p(x, y) * comparisons < 0.05
    print(
        f"power, {seeds} seeds, domains {domains}, comparisons {comparisons}: lead {lead / deviation:.2f} deviations, {found / repeats:.3f}"
    )
    assert found / repeats == pytest.approx(0.8, abs=3 * np.sqrt(0.8 * 0.2 / repeats) + 0.03)


def test_the_lead_of_one_task_is_that_of_wilcoxons_test() -> None:
    """Of one task the test is Wilcoxon's, whose power for five against five at 0.01 is that of complete separation."""
    lead = ours.smallest_lead([np.eye(1)], 5, 5, 1.0)
    assert lead is not None
    x = np.linspace(-9, 9, 4001)
    # The smallest of five is above the largest of five others.
    smallest = 5 * stats.norm.pdf(x - lead) * stats.norm.sf(x - lead) ** 4
    assert np.trapezoid(smallest * stats.norm.cdf(x) ** 5, x) == pytest.approx(0.8, abs=0.03)


def test_what_is_measured_is_the_pooled_covariance() -> None:
    random = np.random.default_rng(0)
    methods = [drawn(random, 5, [COVARIANCE], lead=0.1 * index) for index in range(4)]
    found = ours.power_of(methods)
    assert found is not None
    means = np.stack([one[0].mean(1) for one in methods])
    assert found.deviation == pytest.approx(np.sqrt(means.var(1, ddof=1).mean()))
    assert (found.freedom, found.comparisons, found.own) == (16, 3, 5)
    # The interval of a normal variable's deviation.
    assert (found.within.low, found.within.high) == pytest.approx(
        (found.deviation * np.sqrt(16 / stats.chi2.ppf(0.975, 16)), found.deviation * np.sqrt(16 / stats.chi2.ppf(0.025, 16)))
    )
    assert [one.seeds for one in found.designs] == [3, 5, 8, 12]
    assert [one.least for one in found.designs] == pytest.approx([2 / 20, 2 / 252, 2 / 12870, 2 / 2704156])
    assert [one.corrected for one in found.designs] == pytest.approx([3 * one.least for one in found.designs])
    leads = [one.lead for one in found.designs]
    assert leads[0] is None
    assert leads[1] > leads[2] > leads[3] > 0  # type: ignore[operator]
    # Twice the scores, twice the lead.
    twice = ours.power_of([[2 * block for block in one] for one in methods])
    assert twice is not None
    assert [one.lead for one in twice.designs[1:]] == pytest.approx([2 * lead for lead in leads[1:] if lead])
    two = ours.power_of([[one[0], one[0][:3]] for one in methods])
    assert two is not None
    assert (two.own, two.freedom) == (3, 8)
    assert two.designs[0].least == pytest.approx(2 / 20**2)


def test_where_too_little_is_known_nothing_is_claimed() -> None:
    random = np.random.default_rng(0)
    assert ours.power_of([]) is None
    assert ours.power_of([drawn(random, 9, [COVARIANCE])]) is None
    assert ours.power_of([drawn(random, 3, [COVARIANCE]) for _ in range(3)]) is None  # 6 degrees of freedom
    assert ours.power_of([[np.full((9, 4), 0.3)], [np.full((9, 4), 0.4)]]) is None  # no deviation
    single = [drawn(random, 9, [COVARIANCE]), drawn(random, 9, [COVARIANCE]), drawn(random, 1, [COVARIANCE])]
    found = ours.power_of(single)
    assert found is not None
    assert found.comparisons == 1


@pytest.fixture
def runs(make_record: Callable) -> Callable[..., list[Record]]:
    """Records on Walker whose scores differ between seeds."""

    def make(method: str, level: float, seeds: range = range(1, 6), **changes: object) -> list[Record]:
        return [
            make_record(method, task, seed, final=[1000 * (level + 0.04 * np.sin(7 * seed + len(method)) + 0.01 * np.cos(seed * index))],
                        dataset_id=f"walker/{task}/{method}-seed{seed}-v0", **changes)
            for index, task in enumerate(TASKS)
            for seed in seeds
        ]  # fmt: skip

    return make


def only(records: list[Record], references: dict[tuple[str, str, str], Bounds] | None = None) -> Overall:
    (overall,) = build_overall(build_tables(records, references)[0])
    return overall


def terminal(overall: Overall) -> str:
    screen = Console(file=io.StringIO(), width=1000)
    screen.print(overall_to_rich(overall))
    return screen.file.getvalue()  # type: ignore[attr-defined, no-any-return]


def test_it_is_shown_wherever_the_comparison_is(runs: Callable) -> None:
    overall = only([*runs("cudc", 0.5), *runs("icm", 0.4), *runs("random", 0.2)])
    power = overall.power
    assert power is not None
    lead = power.design.lead
    assert lead is not None
    said = f"Power: with 5 seeds a lead of {1000 * lead:.0f} points a task is found in 8 of 10 cases (with 8 one of "
    least = "The permutation test of 5 against 5 seeds can give no p below 0.0079, which Holm's correction for 2 comparisons makes 0.016."
    for text in (overall_to_markdown(overall), terminal(overall), overall_to_latex(overall).replace("\\", "")):
        assert said in text
        assert least in text
    assert f"| 5 | 0.0079 | 0.016 | {1000 * lead:.0f} points a task |" in overall_to_markdown(overall)
    assert f"5 & 0.0079 & 0.016 & {1000 * lead:.0f} points a task" in overall_to_latex(overall)
    assert "| 3 | 0.1 | 0.2 | – |" in overall_to_markdown(overall)
    lines = {one["seeds"]: one for one in csv.DictReader(io.StringIO(power_to_csv(overall)))}
    assert (float(lines["5"]["lead_score"]), lines["5"]["own"], lines["3"]["lead_score"]) == (lead, "True", "")
    assert float(lines["5"]["lead_points"]) == pytest.approx(1000 * lead)


def test_by_references_it_is_in_scores(runs: Callable) -> None:
    references = {("cpu", "walker", task): Bounds(10.0, 10.0, 610.0, 3) for task in TASKS}
    overall = only([*runs("cudc", 0.5), *runs("icm", 0.4), *runs("random", 0.2)], references)
    plain = only([*runs("cudc", 0.5), *runs("icm", 0.4), *runs("random", 0.2)])
    assert overall.power is not None
    assert plain.power is not None
    lead, other = overall.power.design.lead, plain.power.design.lead
    assert lead is not None
    assert other is not None
    assert lead == pytest.approx(other / 0.6)
    assert f"a lead of {lead:.3f} in score ({600 * lead:.0f} points) a task is found" in overall.power_text


def test_designs_that_can_show_nothing_say_so(runs: Callable) -> None:
    few = only([*runs("cudc", 0.5, range(1, 4)), *runs("icm", 0.4, range(1, 4)), *runs("random", 0.2, range(1, 4))])
    assert few.headline.remarks[-1] == (
        "The permutation test of 3 against 3 seeds can give no p below 0.1, which Holm's correction for 2 comparisons makes 0.2: no"
        " difference can pass it."
    )
    assert few.power_text == "Power: not known, since too few seeds say how much seeds differ."
    assert power_to_csv(few).count("\n") == 1
    mixed = only([*runs("cudc", 0.5), *runs("icm", 0.4, range(1, 4)), *runs("random", 0.2)])
    assert mixed.headline.remarks[-1] == (
        "The permutation test of its pairs, which have different numbers of seeds, can give no p below 0.0079 to 0.018, which Holm's"
        " correction for 2 comparisons makes 0.016 to 0.036."
    )
    many = [one for index in range(5) for one in runs(f"m{index}", 0.2 + 0.05 * index, range(1, 4))]
    assert "with 3 seeds no lead is found in 8 of 10 cases (with 5 one of " in only(many).power_text
    two = only([*runs("cudc", 0.5), *runs("icm", 0.4)]).headline
    assert two.remarks == ("The permutation test of 5 against 5 seeds can give no p below 0.0079.",)
    assert only(runs("cudc", 0.5)).power_text == ""
    assert only(runs("cudc", 0.5)).headline.remarks == ()


def test_the_same_records_give_the_same_power(runs: Callable) -> None:
    records = [*runs("cudc", 0.5), *runs("icm", 0.4), *runs("random", 0.2)]
    assert power_to_csv(only(records)) == power_to_csv(only(records[::-1]))
