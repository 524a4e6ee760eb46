"""A NaN, a simulation that diverges or a training that blows up ends a command in one line and reaches no file."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from cudc_bench.envs.walker import Walker
from cudc_bench.execution import interrupts

from .helpers import COLLECT, EVALUATE, PILOT, but, refused

LEARN_SETTINGS = ("--set", "seed_steps=1200", "--set", "measure_every=500")
LEARN = ("collect", "--method", "icm", "--workers", "1", "--checkpoint-every", "0", *LEARN_SETTINGS)


def clean(datasets: Path) -> bool:
    """Whether nothing of a dataset is left, visible or hidden."""
    return [path.name for path in datasets.rglob("*") if path.name not in ("walker", "namespace_metadata.json")] == []


def poison(name: str, step: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have a simulator write a NaN at a step of its second episode, into its observation or its state."""
    real, calls = getattr(Walker, name), 0

    def written(simulator: Walker, out: Any) -> None:
        nonlocal calls
        calls += 1
        real(simulator, out)
        if calls == 1001 + step:
            out[3] = np.nan

    monkeypatch.setattr(Walker, name, written)


@pytest.mark.parametrize(
    ("step", "where"), [(50, "in the episode before step 2,000"), (700, "at step 1,699")], ids=["random actions", "own actions"]
)
def test_a_nan_in_an_observation_never_reaches_a_network_or_a_dataset(
    step: int, where: str, main: Callable, datasets: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    poison("observe", step, monkeypatch)
    # Random actions do not depend on what was observed: it is found when the episode ends.
    early = 2999 if step == 50 else 1200
    refused(
        main(*but(LEARN, seed_steps=early)),
        1,
        f"the simulation broke down {where}: what was observed is not finite; run again with another seed.",
    )
    assert clean(datasets)


def test_a_nan_in_a_state_is_not_stored(main: Callable, datasets: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    poison("state", 5, monkeypatch)
    refused(main(*but(COLLECT, steps=2000)), 1, "the simulation broke down in the episode before step 2,000")
    assert clean(datasets)


def test_actions_that_no_dataset_may_hold_are_refused_when_they_are_chosen(
    main: Callable, datasets: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A simulator would clip them without a word, and verify would refuse the dataset later."""
    from cudc_bench.collectors.random import Random

    monkeypatch.setattr(Random, "act", lambda self, observation, explore=True: torch.full((1, 6), 5.0))
    refused(main(*COLLECT), 1, "the method acts out of [-1, 1] at step 0 (up to 5); its act() must keep actions there.")
    assert clean(datasets)


def test_a_collection_that_blows_up_says_so_and_does_not_stand_in_the_next_ones_way(main: Callable, datasets: Path) -> None:
    """In the actions before any metric is looked at, and in the metrics of a line."""
    huge = but(LEARN, learning_rate=1e30)
    refused(main(*huge), 1, "training broke down at step 1,2", "not finite; try a smaller learning_rate.")
    assert clean(datasets)
    refused(main(*but(huge, measure_every=1)), 1, "training broke down at step 1,2", "not finite; try a smaller learning_rate.")
    assert clean(datasets)
    assert main(*LEARN).code == 0


def test_a_run_interrupted_after_it_broke_is_given_up_when_it_is_continued(
    main: Callable, datasets: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its checkpoint holds the broken networks: with the same command it fails once more, and then the next one starts."""
    from cudc_bench.collectors.icm import ICM

    real, calls = ICM.update, 0

    def update(collector: Any, batch: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == 10:
            with torch.no_grad():
                next(iter(collector.actor.parameters())).fill_(float("nan"))
            interrupts.request_stop()
        return real(collector, batch)

    with monkeypatch.context() as patch:
        patch.setattr(ICM, "update", update)
        assert main(*LEARN).code == 130
    assert list(datasets.rglob("*.pt"))
    refused(main(*LEARN), 1, "training broke down at step", "actions not finite")
    assert clean(datasets)
    assert main(*but(LEARN, learning_rate=1e-3)).code == 0


def test_a_training_that_blows_up_is_one_line_and_leaves_no_record(main: Callable, smoke: Path, tmp_path: Path) -> None:
    evaluate = (*EVALUATE, "--dataset-id", "walker/walk/cudc-smoke-v0", "--output", "results", "--checkpoint-every", "0")
    refused(main(*but(evaluate, learning_rate=1e30)), 1, "training broke down", "not finite; try a smaller learning_rate.")
    assert not [path for path in (tmp_path / "results").rglob("*") if path.is_file()]
    assert main(*evaluate).code == 0


def test_actions_and_returns_of_an_evaluation_are_finite(
    main: Callable, smoke: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Broken networks are named before MuJoCo complains of its controls, and what it measures before it is recorded."""
    from cudc_bench.evaluators.td3 import TD3

    evaluate = (*EVALUATE, "--dataset-id", "walker/walk/cudc-smoke-v0", "--output", "results")
    with monkeypatch.context() as patch:
        patch.setattr(TD3, "act", lambda self, observation: torch.full((*observation.shape[:2], 6), float("nan")))
        refused(main(*evaluate), 1, "training broke down before this evaluation: actions not finite; try a smaller learning_rate.")
    with monkeypatch.context() as patch:
        patch.setattr(Walker, "quantities", lambda self, out: out.fill(np.nan))
        refused(main(*evaluate), 1, "the simulation broke down in an evaluation")
    assert not list((tmp_path / "results").rglob("*.json"))
    assert main(*evaluate).code == 0


def test_a_pilot_that_blows_up_does_not_stand_in_the_next_ones_way(main: Callable, tmp_path: Path) -> None:
    refused(main(*but(PILOT, learning_rate=1e30)), 1, "not finite", "try a smaller learning_rate.")
    # One that is too short to have learnt anything says so each time, too, and leaves nothing to continue.
    refused(main(*but(PILOT, seed_steps=1079)), 1, "learnt nothing within 1,080 steps; take a longer run or fewer seed_steps.")
    thresholds = Path(os.environ["CUDC_BENCH_THRESHOLDS"])
    assert not thresholds.exists()
    assert main(*PILOT).code == 0
    assert thresholds.exists()


def test_a_simulation_that_diverges_is_one_line_in_every_command(
    main: Callable, smoke: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A speed that MuJoCo warns of and resets by itself."""
    evaluate = (*EVALUATE, "--dataset-id", "walker/walk/cudc-smoke-v0", "--output", "results", "--checkpoint-every", "0")
    assert main(*evaluate).code == 0
    record = tmp_path / "results/smoke/walker/walk/cudc-smoke-v0/td3-seed1.json"
    real, calls = Walker.step, 0

    def step(simulator: Walker, action: Any) -> None:
        nonlocal calls
        calls += 1
        if calls % 1500 == 999:
            simulator.data.qvel[2] = 1e12
        real(simulator, action)

    monkeypatch.setattr(Walker, "step", step)
    line = "the walker simulation diverged (mjWARN_BADQ"
    before = sorted(tmp_path.rglob("*"))
    for command in (
        ("collect", "--method", "random", "--workers", "1", "--checkpoint-every", "0"),
        (*evaluate, "--overwrite"),
        ("render", record, "--output", "a.gif", "--width", "16", "--height", "16", "--fps", "1"),
    ):
        calls = 0
        refused(main(*command), 1, line, "run again with another seed.")
    assert sorted(tmp_path.rglob("*")) == before
    assert not (smoke / "walker/random-smoke-v0").exists()
    assert [path.name for path in (smoke / "walker").iterdir() if path.name.startswith(".")] == []


REWARD = """
import os
import numpy as np

calls = 0

def hop(measured):
    global calls
    calls += 1
    # In an evaluation only after a while, when there is a checkpoint.
    wrong = os.environ.get("WRONG") if len(measured["action"]) > 1 or calls > 1500 else None
    if wrong == "raises":
        raise ZeroDivisionError("division by zero")
    rewards = measured["torso_height"] * 1.0
    return {"nan": rewards * np.nan, "shape": rewards[:0]}.get(wrong, rewards)
"""


@pytest.mark.parametrize(
    ("wrong", "line"), [("nan", "numbers that are not finite"), ("shape", "shape (0,)"), ("raises", "failed: ZeroDivisionError")]
)
def test_a_reward_function_that_fails_is_one_line_and_once_mended_the_same_command_goes_on(
    wrong: str, line: str, main: Callable, smoke: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / f"own_{wrong}.py").write_text(REWARD)
    monkeypatch.syspath_prepend(tmp_path)
    reward = ("--reward", f"own_{wrong}:hop")
    evaluate = (*EVALUATE, "--dataset-id", "walker/hop/cudc-smoke-v0", "--output", "results", "--checkpoint-every", "0", *reward)
    with monkeypatch.context() as patch:
        patch.setenv("WRONG", wrong)
        refused(main("relabel", "walker/cudc-smoke-v0", *reward), 1, f"the reward function own_{wrong}:hop", line)
    assert not (smoke / "walker/hop").exists()
    assert main("relabel", "walker/cudc-smoke-v0", *reward).code == 0
    with monkeypatch.context() as patch:
        patch.setenv("WRONG", wrong)
        refused(main(*evaluate), 1, f"the reward function own_{wrong}:hop", line)
    assert not [path for path in (tmp_path / "results").rglob("*") if path.is_file()]
    assert main(*evaluate).code == 0
