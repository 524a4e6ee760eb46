"""Between what scores are normalised, and which files say so."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from cudc_bench.artefacts.records import Evaluation
from cudc_bench.artefacts.references import (
    Bounds,
    Reference,
    ReferenceRun,
    read_reference,
    read_references,
    reference_path,
    write_reference,
)
from cudc_bench.errors import RunError
from cudc_bench.settings.config import as_dict, build, config_hash
from cudc_bench.settings.evaluate_config import OnlineConfig
from cudc_bench.settings.profiles import PROFILES

SMOKE = build(OnlineConfig, PROFILES["smoke"].collect, PROFILES["smoke"].evaluate)


def make_run(seed: int, floor: float = 20.0, ceiling: float = 900.0) -> ReferenceRun:
    """Every second episode a point above the mean, every other one below it."""

    def around(mean: float, count: int) -> list[float]:
        return [mean + (-1) ** episode for episode in range(count)]

    curve = [Evaluation(step=step, returns=[float(step)] * SMOKE.evaluation_episodes) for step in SMOKE.points]
    final = Evaluation(step=SMOKE.steps, returns=around(ceiling, SMOKE.final_episodes))
    many = SMOKE.final_episodes
    return ReferenceRun(seed=seed, random=around(floor, many), untrained=around(floor + 5, many), curve=curve, final=final, metrics=[])


def make_reference(**changes: Any) -> Reference:
    values = as_dict(SMOKE) | {"width": 16}
    facts: dict[str, Any] = {
        "domain": "walker", "task": "walk", "profile": "smoke", "overrides": {}, "hyperparameters": values,
        "hyperparameters_hash": config_hash(values), "runs": [make_run(1, 20, 900), make_run(2, 40, 800)], "seconds": 3.0,
        "versions": {"torch": "2.8"}, "machine": {}, "command": "cudc-bench reference", "created": "2026-11-20T10:00:00+00:00",
    }  # fmt: skip
    return Reference(**facts | changes)


def changed(**settings: Any) -> Reference:
    values = make_reference().hyperparameters | settings
    return make_reference(hyperparameters=values, hyperparameters_hash=config_hash(values), overrides=settings)


def test_floor_and_ceiling_are_means_over_seeds_and_become_0_and_1() -> None:
    bounds = make_reference().bounds
    assert bounds == Bounds(floor=30.0, untrained=35.0, ceiling=850.0, seeds=2)
    assert [bounds.normalise(score) for score in (30.0, 850.0, 440.0, -52.0, 1260.0)] == [0.0, 1.0, 0.5, -0.1, 1.5]


def test_it_is_found_below_a_folder_under_its_profile_domain_and_task(tmp_path: Path) -> None:
    for domain, task in (("walker", "walk"), ("dm_control/cheetah-run", "run")):
        write_reference(reference_path(tmp_path, domain, task, "smoke"), make_reference(domain=domain, task=task))
    bounds = make_reference().bounds
    assert (tmp_path / "smoke" / "dm_control" / "cheetah_run" / "run" / "reference.json").exists()
    expected = {("smoke", "walker", "walk"): bounds, ("smoke", "dm_control/cheetah-run", "run"): bounds}
    assert read_references([tmp_path]) == (expected, ())
    assert read_references([tmp_path, tmp_path / "smoke"]) == (expected, ())
    assert read_references([tmp_path / "nowhere"]) == ({}, ())
    assert read_reference(reference_path(tmp_path, "walker", "walk", "smoke")) == make_reference()


def test_what_is_not_the_profiles_own_is_left_out_and_said_in_one_line(tmp_path: Path) -> None:
    unusable = {
        "settings of its own (width=32)": changed(width=32),
        "profile smoke does not have exploration_std=0.3": changed(exploration_std=0.3).model_copy(update={"overrides": {}}),
        "no profile 'mine'": make_reference(profile="mine"),
        "its ceiling, 20, is not above its floor, 20": make_reference(runs=[make_run(1, 20, 20)]),
    }
    for says, reference in unusable.items():
        path = tmp_path / says.split()[0] / "reference.json"
        write_reference(path, reference)
        found, problems = read_references([path.parent])
        assert found == {}
        assert len(problems) == 1
        assert says in problems[0]
        assert str(path) in problems[0]


@pytest.mark.parametrize("content", ["", "{", "[]", '{"schema_version": 1}', "\0"])
def test_a_damaged_file_never_stops_the_rest(tmp_path: Path, content: str) -> None:
    (tmp_path / "a\x1b[31m").mkdir()
    (tmp_path / "a\x1b[31m" / "reference.json").write_text(content)
    write_reference(tmp_path / "b" / "reference.json", make_reference())
    found, problems = read_references([tmp_path])
    assert list(found) == [("smoke", "walker", "walk")]
    assert len(problems) == 1
    assert problems[0].isprintable()


def test_of_two_of_one_task_the_newer_counts(tmp_path: Path) -> None:
    old = make_reference(runs=[make_run(7, 0, 100)], created="2026-11-19T10:00:00+00:00")
    for first, second in (("a", "b"), ("d", "c")):
        write_reference(tmp_path / first / "reference.json", old)
        write_reference(tmp_path / second / "reference.json", make_reference())
        found, problems = read_references([tmp_path / first, tmp_path / second])
        assert found == {("smoke", "walker", "walk"): make_reference().bounds}
        assert len(problems) == 1
        assert f"{tmp_path / first / 'reference.json'} is left out" in problems[0]


def test_one_that_contradicts_itself_is_no_reference() -> None:
    run = make_run(1)
    short = run.model_copy(update={"random": run.random[:-1]})
    late = run.model_copy(update={"curve": run.curve[:-1]})
    for changes, says in (
        ({"hyperparameters_hash": "0" * 16}, "hyperparameters_hash"),
        ({"overrides": {"width": 64}}, "overrides"),
        ({"runs": [run, run]}, "twice"),
        ({"runs": [short]}, "as many episodes"),
        ({"runs": [late]}, "not evaluated where"),
        ({"hyperparameters": {"steps": -1}, "hyperparameters_hash": config_hash({"steps": -1})}, "steps"),
    ):
        with pytest.raises(ValueError, match=says):
            make_reference(**changes)


def test_a_file_with_an_unknown_field_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "reference.json"
    write_reference(path, make_reference())
    path.write_text(path.read_text().replace('"seconds"', '"more": 1, "seconds"'))
    with pytest.raises(RunError, match=r"is not a reference: more: Extra inputs"):
        read_reference(path)


def test_evaluations_are_spread_over_all_steps() -> None:
    assert OnlineConfig(steps=400_000, evaluations=4).points == [0, 100_000, 200_000, 300_000, 400_000]
    assert OnlineConfig(steps=10, evaluations=3).points == [0, 3, 6, 10]
    assert OnlineConfig(steps=2, evaluations=5).points == [0, 1, 2]
