from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from cudc_bench.leaderboard.intake.load import to_frame
from cudc_bench.leaderboard.numbers.table import build_tables
from cudc_bench.leaderboard.numbers.words import short
from cudc_bench.leaderboard.show.figures.runs import draw_curves


def only(records):
    (table,), problems = build_tables(records)
    return table, problems


def cell(table, section, task, method):
    return table.cells.get((table.milestones[section], task, method))


def test_mean_and_sample_deviation_over_collector_seeds(make_record):
    finals = {1: [100.0, 200.0], 2: [310.0], 3: [505.0, 507.0]}
    table, problems = only([make_record(seed=seed, final=returns) for seed, returns in finals.items()])
    scores = np.array([150.0, 310.0, 506.0])
    found = cell(table, 1, "walk", "cudc")
    assert problems == []
    assert found.n == 3
    assert found.value == pytest.approx(scores.mean())
    assert found.std == pytest.approx(np.sqrt(((scores - scores.mean()) ** 2).sum() / 2))


def test_milestones_use_their_own_evaluation(make_record):
    table, _ = only([make_record()])
    assert table.milestones == (10_000, 20_000)
    assert cell(table, 0, "walk", "cudc").value == 150.0
    # The last milestone is the final evaluation (500), not the last point of the curve (300).
    assert cell(table, 1, "walk", "cudc").value == 500.0
    assert table.episodes == {10_000: (2, 2), 20_000: (3, 3)}


def test_training_runs_on_one_dataset_are_one_seed(make_record):
    first = make_record(seed=1, final=[100.0])
    again = make_record(seed=1, final=[300.0]).model_copy(update={"seed": 2})
    found = cell(only([first, again, make_record(seed=2, final=[600.0])])[0], 1, "walk", "cudc")
    assert (found.n, found.value) == (2, 400.0)
    assert found.std == pytest.approx(np.std([200.0, 600.0], ddof=1))


def test_one_seed_has_no_deviation(make_record):
    found = cell(only([make_record()])[0], 1, "walk", "cudc")
    assert (found.n, found.std) == (1, None)


def test_rows_are_the_domains_tasks_that_have_records_then_others_and_missing_cells_are_none(make_record):
    table, _ = only([make_record(task="juggle"), make_record(task="run"), make_record(method="random", task="stand")])
    assert table.tasks == ("stand", "run", "juggle")
    assert "Tasks of walker without any run: walk, flip." in table.caption
    assert cell(table, 0, "stand", "cudc") is None
    assert cell(table, 0, "juggle", "random") is None
    assert cell(table, 0, "stand", "random") is not None


def test_a_domain_that_is_not_ours_has_its_tasks_by_name(make_record):
    table, _ = only([make_record(task=task, dataset_domain="cheetah") for task in ("run", "flip")])
    assert table.tasks == ("flip", "run")


def test_methods_are_in_the_papers_order_then_by_name(make_record):
    names = ["zeta", "cudc", "aps", "alpha", "proto", "apt", "icm", "random"]
    table, _ = only([make_record(method=name) for name in names])
    assert table.methods == ("random", "icm", "apt", "proto", "aps", "cudc", "alpha", "zeta")


def test_best_is_by_rounded_mean_and_ties_share_it(make_record):
    table, _ = only(
        [
            make_record(method="random", final=[99.4]),
            make_record(method="icm", final=[100.4]),
            make_record(method="apt", final=[99.6]),
        ]
    )
    assert [c.best for c in table.grid.parts[1].lines[0].entries] == [False, True, True]


def marked(make_record, scores):
    """The methods that are best on one task, from each one's score for each seed."""
    records = [make_record(method=m, seed=i, final=[score]) for m, of_seeds in scores.items() for i, score in enumerate(of_seeds, 1)]
    table, _ = only(records)
    return {method for method in table.methods if table.cells[table.milestones[-1], "walk", method].best}


FAR, NEAR, TOP = [100.0, 130.0, 90.0, 120.0, 110.0], [480.0, 560.0, 500.0, 530.0, 430.0], [500.0, 540.0, 520.0, 560.0, 480.0]


def test_best_are_all_that_are_not_significantly_worse(make_record):
    assert stats.ttest_ind(TOP, NEAR, equal_var=False).pvalue > 0.05 > stats.ttest_ind(TOP, FAR, equal_var=False).pvalue
    assert marked(make_record, {"cudc": TOP, "icm": NEAR, "random": FAR}) == {"cudc", "icm"}


def test_significance_is_corrected_for_the_methods_of_the_row(make_record):
    near = [score - 55.0 for score in TOP]
    p = stats.ttest_ind(TOP, near, equal_var=False).pvalue
    assert 0.05 / 6 < p < 0.05
    assert marked(make_record, {"cudc": TOP, "icm": near}) == {"cudc"}
    others = {f"other{i}": [score - 54.0 + i for score in TOP] for i in range(5)}
    assert marked(make_record, {"cudc": TOP, "icm": near} | others) == {"cudc", "icm", *others}


def test_methods_may_spread_differently(make_record):
    tight, wide = [499.0, 500.0, 500.0, 500.0, 501.0], [383.0, 414.0, 446.0, 478.0, 509.0]
    assert stats.ttest_ind(tight, wide).pvalue < 0.05 < stats.ttest_ind(tight, wide, equal_var=False).pvalue
    assert marked(make_record, {"cudc": tight, "icm": wide}) == {"cudc", "icm"}


def test_a_wide_spread_of_one_method_hides_no_difference_between_others(make_record):
    wild = [0.0, 900.0, 100.0, 800.0, 200.0]
    assert marked(make_record, {"cudc": TOP, "icm": wild, "random": FAR}) == {"cudc", "icm"}


def test_a_single_seed_is_not_tested(make_record):
    assert marked(make_record, {"cudc": TOP, "icm": [519.0], "random": FAR}) == {"cudc"}
    assert marked(make_record, {"cudc": [521.0], "icm": TOP, "random": FAR}) == {"cudc"}


def test_scores_without_any_spread_are_told_apart(make_record):
    assert marked(make_record, {"cudc": [500.0] * 5, "icm": [500.0] * 5, "random": [498.0] * 5}) == {"cudc", "icm"}


def test_a_cell_alone_in_its_row_is_not_best(make_record):
    table, _ = only([make_record(), make_record(method="icm", task="run")])
    assert not any(c.best for c in table.cells.values())


@pytest.mark.parametrize(
    "other",
    [
        {"profile": "paper"},
        {"dataset_profile": "paper"},
        {"overrides": {"gamma": 0.9}},
        {"dataset_overrides": {"steps": 100}},
        {"algorithm": "cql"},
        {"dataset_domain": "cheetah"},
    ],
)
def test_what_may_not_be_compared_never_shares_a_table(other, make_record):
    tables, _ = build_tables([make_record(seed=1), make_record(seed=2, **other)])
    assert len(tables) == 2
    assert [len(table.records) for table in tables] == [1, 1]
    assert all(c.n == 1 for table in tables for c in table.cells.values())


def test_slugs_of_domains_that_look_alike_differ_and_make_no_folders(make_record):
    domains = ["dm_control/cheetah-run", "dm_control-cheetah-run", "dm_control/cheetah_run", "dm_control_cheetah-run"]
    tables, _ = build_tables([make_record(dataset_domain=domain) for domain in domains])
    slugs = {table.slug for table in tables}
    assert len(slugs) == len(domains)
    assert not any("/" in slug for slug in slugs)


def test_other_milestones_are_left_out_and_reported(make_record):
    records = [make_record(seed=seed) for seed in (1, 2)]
    odd = make_record(seed=3, milestones=[10_000], final=[999.0])
    table, problems = only([odd, *records])
    assert cell(table, 1, "walk", "cudc").value == 500.0
    assert cell(table, 1, "walk", "cudc").n == 2
    (problem,) = problems
    assert odd.dataset.id in problem
    assert "10000, 20000" in problem


def test_a_milestone_without_evaluation_is_missing_and_reported(make_record):
    table, problems = only([make_record(milestones=[10_000, 15_000])])
    assert cell(table, 1, "walk", "cudc") is None
    assert "15000" in problems[0]


def test_different_hyperparameters_in_one_group_are_reported_by_name(make_record):
    records = [make_record(seed=seed, hyperparameters={"gamma": 0.9, "width": seed}) for seed in (1, 2)]
    (problem,) = only(records)[1]
    assert problem.endswith("hyperparameters: width.")


def test_caption_says_what_the_numbers_are(make_record):
    caption = only([make_record(seed=1), make_record(seed=2), make_record(method="icm")])[0].caption
    for part in ("sample standard deviation", "10K and 20K gradient steps", "td3", "walker", "Profile: cpu.", "1 to 2 seeds.",
                 "2 at 10K, 3 at 20K", "not significantly worse (two-sided Welch test", "Preliminary: fewer than five seeds."):  # fmt: skip
        assert part in caption


def test_five_seeds_are_not_preliminary(make_record):
    caption = only([make_record(seed=seed) for seed in range(1, 6)])[0].caption
    assert "5 seeds." in caption
    assert "Preliminary" not in caption


def test_commands_are_listed_once(make_record):
    table, _ = only([make_record(command="a"), make_record(task="run", command="a"), make_record(task="flip", command="b\nc")])
    assert table.commands == ["a", "b c"]


def test_slugs_are_safe_and_unique(make_record):
    values = ["1e-3", "1e+3", "../../etc", "a/b", "x" * 500, "\x00\n", "ü"]
    tables, _ = build_tables([make_record(overrides={"lr": value}) for value in values] + [make_record()])
    slugs = [table.slug for table in tables]
    assert len(set(slugs)) == len(values) + 1
    assert "cpu.td3.walker" in slugs
    for slug in slugs:
        assert len(slug) < 200
        assert set(slug) <= set("abcdefghijklmnopqrstuvwxyz0123456789-_.")
        assert ".." not in slug


def test_order_of_records_does_not_matter(make_record):
    records = [make_record(seed=seed, final=[0.1 * seed, 7.7]) for seed in range(1, 8)]
    assert only(records)[0].grid == only(records[::-1])[0].grid


@pytest.mark.parametrize(
    ("steps", "text"), [(0, "0"), (40, "40"), (2_500, "2.5K"), (100_000, "100K"), (1_000_000, "1M"), (1_500_000, "1.5M")]
)
def test_short(steps, text):
    assert short(steps) == text


def test_an_imported_dataset_has_a_column_of_its_own_for_each_size(make_record):
    imported = {"method": "proto", "dataset_source": "ExORL", "dataset_profile": "imported"}
    records = [
        make_record(method="proto", final=[100.0]),
        make_record(**imported, dataset_steps=10_000_000, final=[900.0]),
        make_record(**imported, dataset_steps=1_000_000, final=[300.0]),
        make_record(**imported | {"dataset_source": "A. Nother"}, dataset_steps=1_000_000, final=[200.0]),
    ]
    table, problems = only(records)
    assert problems == []
    assert table.group == "cpu"
    assert table.methods == ("proto", "proto (A. Nother, 1M)", "proto (ExORL, 10M)", "proto (ExORL, 1M)")
    assert [cell(table, 1, "walk", method).value for method in table.methods] == [100.0, 200.0, 900.0, 300.0]
    assert "that dataset was imported, not collected here." in table.caption
    assert "imported" not in only(records[:1])[0].caption
    assert list(to_frame(records).method.unique()) == ["proto", "proto (ExORL, 10M)", "proto (ExORL, 1M)", "proto (A. Nother, 1M)"]


def test_a_figure_draws_an_imported_dataset_as_a_line_of_its_own(make_record):
    imported = make_record(method="cudc", dataset_source="ExORL", dataset_profile="imported", dataset_steps=10_000_000)
    figure = draw_curves(only([make_record(), imported])[0].runs)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["cudc", "cudc (ExORL, 10M)"]
    (panel,) = [panel for panel in figure.axes if panel.get_visible()]
    solid, dashed = [line for line in panel.lines if line.get_linestyle() != ":"]
    assert (solid.get_linestyle(), dashed.get_linestyle()) == ("-", "-.")
