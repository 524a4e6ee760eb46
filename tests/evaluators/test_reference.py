"""``make_references``: floors and ceilings in files of their own, made once, continued where they were left, refused where they differ."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cudc_bench
from cudc_bench.artefacts.records import Evaluation
from cudc_bench.artefacts.references import Reference, read_reference, read_references, write_reference
from cudc_bench.cli.app import main
from cudc_bench.envs import DOMAINS, make_simulators, reward_function
from cudc_bench.errors import BrokenDownError, RunError, UsageError
from cudc_bench.evaluators.running import online, reference
from cudc_bench.evaluators.running.loop import Arena
from cudc_bench.evaluators.running.reference import RandomActions, make_references
from cudc_bench.execution import interrupts
from cudc_bench.runs.execution import Execution
from cudc_bench.settings.profiles import PROFILES
from cudc_bench.settings.seeding import episode_seed

from .helpers import make

WALKER = DOMAINS["walker"]
# Of Jaco, whose episodes are the shortest.
LEFT, RIGHT = "reach_top_left", "reach_top_right"
SHORT = {"steps": 600, "seed_steps": 200, "update_every": 50, "evaluations": 1, "final_episodes": 1}


def made(folder: Path, seeds: tuple[int, ...] = (1, 2), tasks: tuple[str, ...] = (LEFT,), **options: Any) -> list[Path]:
    return make_references("jaco", tasks, seeds, **{"profile": "smoke", "settings": SHORT, "output": folder} | options)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What comes out of a run that was left alone."""
    (path,) = made(tmp_path_factory.mktemp("undisturbed"))
    return timeless(path)


def timeless(path: Path) -> dict[str, Any]:
    """A reference but for the time that it took."""
    return {name: value for name, value in json.loads(path.read_text()).items() if name not in {"seconds", "created"}}


def test_a_profiles_reference_holds_its_floors_and_its_ceiling(tmp_path: Path) -> None:
    (path,) = make_references("walker", ["walk"], [1], profile="smoke", output=tmp_path)
    assert path == tmp_path / "smoke" / "walker" / "walk" / "reference.json"
    assert [file for file in tmp_path.rglob("*") if file.is_file()] == [path]
    found = read_reference(path)
    assert (found.domain, found.task, found.profile, found.overrides, found.seeds) == ("walker", "walk", "smoke", {}, (1,))
    smoke = PROFILES["smoke"]
    for name, value in found.hyperparameters.items():
        assert value == smoke.evaluate.get(name, smoke.collect.get(name, value))
    assert found.hyperparameters["steps"] == smoke.collect["steps"]
    assert found.hyperparameters["width"] == smoke.evaluate["width"]
    (run,) = found.runs
    # Before the first update nothing has been learnt; the episodes are other ones.
    agent = make("td3", (1,), **{name: value for name, value in smoke.evaluate.items() if name in ("width", "batch_size", "learning_rate")})
    seeds = [[episode_seed(1, "untrained policy", 0, episode) for episode in range(2)]]
    assert run.untrained == pytest.approx(Arena(WALKER, ["walk"], threads=1).returns(agent, seeds)[0].tolist())
    # So short a training may end below the floor; what is the profile's own does not depend on it.
    better = found.model_copy(update={"runs": [run.model_copy(update={"final": Evaluation(step=run.final.step, returns=[999.0] * 2)})]})
    write_reference(path, better)
    assert read_references([tmp_path]) == ({("smoke", "walker", "walk"): better.bounds}, ())
    assert shlex.split(found.command)[1:] == [
        "reference", "--domain", "walker", "--task", "walk", "--seeds", "1", "--profile", "smoke", "--overwrite"
    ]  # fmt: skip


def test_random_actions_get_what_uniform_ones_of_anybody_else_get() -> None:
    episodes = 16
    (ours,) = Arena(WALKER, ["stand"], threads=1).evaluate(RandomActions((1,), 6), (1,), "random actions", 0, episodes)
    (simulator,), rewards, draw = make_simulators("walker", 1), reward_function("walker"), np.random.default_rng(0)
    theirs, quantities = np.zeros(episodes), np.empty(len(WALKER.quantities))
    for episode in range(episodes):
        simulator.reset(100 + episode)
        for action in draw.uniform(-1, 1, (1000, 6)):
            simulator.step(action)
            simulator.quantities(quantities)
            theirs[episode] += rewards(quantities)[0]
    assert len(set(ours)) == episodes
    error = np.sqrt((ours.var(ddof=1) + theirs.var(ddof=1)) / episodes)
    assert abs(ours.mean() - theirs.mean()) < 3 * error


def test_random_actions_are_each_members_own() -> None:
    import torch

    seen = torch.zeros(2, 5, 24)
    both, alone = RandomActions((1, 2), 6).act(seen), RandomActions((2,), 6).act(seen[:1])
    assert torch.equal(both[1:], alone)
    assert not torch.equal(both[0], both[1])
    assert both.abs().max() <= 1


def test_what_is_there_is_kept_and_what_differs_refused(tmp_path: Path) -> None:
    paths = made(tmp_path, tasks=(LEFT, RIGHT))
    assert [path.parent.name for path in paths] == [LEFT, RIGHT]
    before = {path: path.read_bytes() for path in paths}
    assert made(tmp_path, tasks=(RIGHT, LEFT), seeds=(2, 1)) == paths
    assert {path: path.read_bytes() for path in paths} == before
    for options in ({"seeds": (1, 2, 3)}, {"settings": SHORT | {"exploration_std": 0.1}}):
        with pytest.raises(UsageError, match=r"reference.json is another reference .*; use --overwrite or another --output"):
            made(tmp_path, **options)
    assert {path: path.read_bytes() for path in paths} == before
    (again,) = made(tmp_path, seeds=(1,), overwrite=True)
    found, (other, *_) = read_reference(again), read_reference(paths[1]).runs
    assert found.seeds == (1,)
    # The same training, whatever else is made beside it; another task of it is another training.
    assert found.runs[0] == Reference.model_validate_json(before[again]).runs[0]
    assert found.runs[0].random != other.random
    again.write_text("{")
    with pytest.raises(RunError, match=r"is not a reference: .*; use --overwrite or another --output"):
        made(tmp_path)


def test_settings_are_written_down_and_keep_it_from_being_the_profiles(tmp_path: Path) -> None:
    (path,) = made(tmp_path, seeds=(1,), settings=SHORT | {"width": "8", "update_every": "50"})
    found = read_reference(path)
    # What the profile has anyway is no change.
    assert found.overrides == {name: value for name, value in SHORT.items() if name != "update_every"} | {"width": 8}
    assert "--set width=8" in found.command
    bounds, (problem,) = read_references([tmp_path])
    assert bounds == {}
    assert "settings of its own" in problem


def test_workers_do_not_change_it_and_leave_nothing_else(tmp_path: Path, undisturbed: dict[str, Any]) -> None:
    (path,) = made(tmp_path, workers=2)
    assert timeless(path) == undisturbed
    assert [file for file in tmp_path.rglob("*") if file.is_file()] == [path]


def test_seeds_that_are_done_are_not_trained_again(tmp_path: Path, undisturbed: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    trained: list[tuple[int, int]] = []
    step, asked = online._Run.step, [(2, 350)]

    def asking(run: Any) -> None:
        trained.append((run._seeds[0], run.steps))
        step(run)
        if (run._seeds[0], run.steps) in asked:
            interrupts.request_stop()

    monkeypatch.setattr(online._Run, "step", asking)
    with pytest.raises(interrupts.Interrupted, match="td3 online: reach_top_left seed 2 at step 350 of 600"):
        made(tmp_path)
    assert not list(tmp_path.rglob("reference.json"))
    with pytest.raises(
        UsageError, match=r"an interrupted run of the reference of reach_top_left seed 1 at smoke had other settings: .*--fresh"
    ):
        made(tmp_path, settings=SHORT | {"width": 8})
    trained.clear()
    asked.clear()
    (path,) = made(tmp_path)
    assert trained == [(2, number) for number in range(350, 600)]
    assert timeless(path) == undisturbed
    assert [file for file in tmp_path.rglob("*") if file.is_file()] == [path]


def test_started_over_it_is_the_same(tmp_path: Path, undisturbed: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(reference, "write_reference", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            made(tmp_path)
    assert len(list(tmp_path.rglob("*.pt"))) == 2
    (path,) = made(tmp_path, fresh=True)
    assert timeless(path) == undisturbed


def test_a_stack_of_all_tasks_and_seeds_makes_the_references_of_its_members_alone(
    tmp_path: Path, undisturbed: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on CUDA: one training of all of them, which is continued as a whole if it ended before all references were written."""
    plan = reference.ReferencePlan.checked("jaco", (LEFT, RIGHT), (1, 2), "smoke", SHORT, Execution(), results=tmp_path)
    stack = reference.Stack(plan, [reference.Member(task, seed) for task in plan.tasks for seed in plan.seeds])

    def train() -> None:
        reference.train_members(lambda n: None, stack=stack, execution=Execution(checkpoint_every=0.0), stacks=[stack])

    write, calls = reference.write_reference, [0]

    def failing(path: Path, one: Reference) -> None:
        calls[0] += 1
        if calls[0] == 2:
            raise KeyboardInterrupt
        write(path, one)

    monkeypatch.setattr(reference, "write_reference", failing)
    with pytest.raises(KeyboardInterrupt):
        train()
    assert [path.exists() for path in map(plan.path, plan.tasks)] == [True, False]
    first = plan.path(LEFT).read_bytes()
    monkeypatch.setattr(online._Run, "step", lambda run: pytest.fail("it is trained again"))
    train()
    assert plan.path(LEFT).read_bytes() == first
    assert {file for file in tmp_path.rglob("*") if file.is_file()} == {plan.path(LEFT), plan.path(RIGHT)}
    left, right = (read_reference(plan.path(task)) for task in plan.tasks)
    assert left.seeds == right.seeds == (1, 2)
    # Larger matrices round differently, which a simulation amplifies; random actions come from no matrix.
    assert [run.random for run in left.runs] == [run["random"] for run in undisturbed["runs"]]
    assert left.runs[0].random != left.runs[1].random != right.runs[1].random


def test_what_a_killed_process_left_is_tidied_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("cudc_bench.execution.checkpoints.Checkpoints.remove", lambda self: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            made(tmp_path)
    (path,) = tmp_path.rglob("reference.json")
    assert (tmp_path / ".checkpoints").exists()
    before = path.read_bytes()
    assert made(tmp_path) == [path]
    assert path.read_bytes() == before
    assert not (tmp_path / ".checkpoints").exists()


def test_a_training_that_breaks_down_leaves_nothing_to_continue(tmp_path: Path) -> None:
    with pytest.raises(BrokenDownError, match="not finite; try a smaller learning_rate"):
        made(tmp_path, seeds=(1,), settings=SHORT | {"learning_rate": 1e30, "update_every": 1})
    assert not list(tmp_path.rglob("*.pt"))


def test_the_command_says_what_came_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    words = [word for name, value in SHORT.items() for word in ("--set", f"{name}={value}")]
    with pytest.raises(SystemExit) as ended:
        main(["reference", "--domain", "jaco", "--task", LEFT, "--seeds", "1", "--profile", "smoke", "--workers", "1", *words])
    out, err = capfd.readouterr()
    assert ended.value.code == 0, err
    assert out == f"results/smoke/jaco/{LEFT}/reference.json\n"
    bounds = read_reference(Path(out.strip())).bounds
    assert f"{LEFT}: random {bounds.floor:.1f}, untrained {bounds.untrained:.1f}, trained online {bounds.ceiling:.1f}" in err
    # Nothing of it is taken for a record.
    with pytest.raises(SystemExit):
        main(["list"])
    assert "Records in results: 0; references: 1" in capfd.readouterr().out


def test_training_online_is_logged_as_it_is_kept(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    from tests.execution.test_runlog import check_rows, scalars

    (path,) = made(tmp_path, seeds=(1,), log="tensorboard", log_dir=tmp_path / "runs")
    (run,) = read_reference(path).runs
    expected: dict[int, dict[str, float]] = {one.step: {"return_mean": one.mean} for one in run.curve}
    for one in run.metrics:
        expected[one.step] |= one.values
    expected[run.final.step]["final_return_mean"] = run.final.mean
    check_rows(scalars(tmp_path / f"runs/reference/smoke/jaco/{LEFT}/seed1"), expected)


def test_it_is_there_from_python() -> None:
    makes: Callable[..., Any] = cudc_bench.make_references
    assert makes is make_references
