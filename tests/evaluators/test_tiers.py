"""``make_tiers``: the datasets of one online training, exactly what that training and its policies did, made once and continued."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import minari
import numpy as np
import pytest
import torch

import cudc_bench
from cudc_bench.artefacts.again import commands_from_nothing
from cudc_bench.artefacts.manifest import KEY, Manifest, read_manifest
from cudc_bench.artefacts.records import read_record
from cudc_bench.artefacts.tiers import TIERS, LearningPoint, step_of
from cudc_bench.cli.app import main
from cudc_bench.envs import DOMAINS
from cudc_bench.errors import RunError, UsageError
from cudc_bench.evaluators.running import tiers
from cudc_bench.evaluators.running.reference import make_references
from cudc_bench.evaluators.running.tiers import make_tiers
from cudc_bench.evaluators.td3 import TD3
from cudc_bench.execution import interrupts
from cudc_bench.leaderboard.numbers.columns import column, is_own

WORLD, TASK = DOMAINS["jaco"], "reach_top_left"
# Of Jaco, whose episodes are the shortest: 250 steps. The evaluations are after 0, 300 and 600.
SHORT = {"steps": 600, "seed_steps": 200, "update_every": 50, "evaluations": 2, "final_episodes": 1}
IDS = [f"jaco/{TASK}/{kind}-smoke-v0" for kind in TIERS]
EXPERT, MEDIUM, MEDIUM_REPLAY, REPLAY = IDS
BRIEF = {"gradient_steps": 4, "evaluate_every": 2, "milestones": [2, 4], "final_episodes": 1, "final_evaluations": 1}


def made(**options: Any) -> list[str]:
    return make_tiers("jaco", [TASK], **{"profile": "smoke", "settings": SHORT, "steps": 300} | options)


@pytest.fixture(scope="module")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("tiers") / "datasets"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        assert made() == IDS
    return root


@pytest.fixture
def there(made_once: Path, datasets: Path) -> Path:
    shutil.copytree(made_once, datasets)
    return datasets


def timeless(one: str, root: Path | None = None) -> dict[str, Any]:
    """A manifest but for the time that it took."""
    return read_manifest(one, root).model_dump(exclude={"seconds", "created"})


def test_they_are_of_the_parts_of_one_training(there: Path) -> None:
    manifests = {kind: read_manifest(one) for kind, one in zip(TIERS, IDS, strict=True)}
    for kind, manifest in manifests.items():
        tier = manifest.tier
        assert tier is not None
        assert (manifest.method, manifest.label, tier.kind, manifest.task, manifest.base) == (kind, kind, kind, TASK, None)
        assert [point.step for point in tier.curve] == [0, 300, 600]
        assert (manifest.hyperparameters["steps"], manifest.hyperparameters["data_steps"], manifest.overrides["data_steps"]) == (
            600,
            300,
            300,
        )
        assert tier.score == next(point.score for point in tier.curve if point.step == tier.step)
    middle = 300 if manifests["medium"].tier.curve[1].score > manifests["medium"].tier.expert_score / 3 else 600
    steps = {kind: (manifest.tier.step, manifest.steps) for kind, manifest in manifests.items()}
    assert steps == {"expert": (600, 300), "medium": (middle, 300), "medium-replay": (middle, middle), "replay": (600, 600)}
    # All begin in the same states, those of the seed's environment; the medium replay is the beginning of the replay.
    episodes = {kind: list(minari.load_dataset(one)) for kind, one in zip(TIERS, IDS, strict=True)}
    assert [len(one.actions) for one in episodes["replay"]] == [250, 250, 100]
    for short, long in zip(episodes["medium-replay"], episodes["replay"], strict=False):
        length = len(short.actions)
        for name in ("observations", "actions", "rewards"):
            rows = length + (name == "observations")
            assert getattr(short, name).tobytes() == getattr(long, name)[:rows].tobytes()
        assert short.infos["physics"].tobytes() == long.infos["physics"][: length + 1].tobytes()
        assert short.truncations[-1]
    for kind in ("expert", "medium"):
        assert np.array_equal(episodes[kind][0].observations[0], episodes["replay"][0].observations[0])
        assert not np.array_equal(episodes[kind][0].actions, episodes["replay"][0].actions)


def test_the_training_is_a_references(there: Path, tmp_path: Path) -> None:
    (path,) = make_references("jaco", [TASK], [1], profile="smoke", settings=SHORT, output=tmp_path)
    (run,) = json.loads(path.read_text())["runs"]
    tier = read_manifest(EXPERT).tier
    assert tier is not None
    assert [(point.step, point.score) for point in tier.curve] == [(one["step"], np.mean(one["returns"])) for one in run["curve"]]
    assert tier.expert_score == pytest.approx(np.mean(run["final"]["returns"]), rel=1e-12)


def test_rewards_are_the_live_ones_and_those_of_the_states(there: Path) -> None:
    for one in IDS:
        found = cudc_bench.verify(one, sample=None)
        checks = {check.name: check.detail for check in found.checks}
        assert f"equal to {TASK} computed from the states" in checks["rewards"]
        assert "repeated from their seeds bit for bit" in checks["simulation"]
        assert not any("imported" in what for what in found.unproven)
    # Where nothing had to be computed again, somebody has reached for something.
    assert max(episode.rewards.max() for one in IDS for episode in minari.load_dataset(one)) > 0


def test_policies_act_with_the_noise_of_the_training(datasets: Path) -> None:
    """Without any, the actions are the policy's own; the final policy is that of the training."""
    kept: dict[int, dict[str, torch.Tensor]] = {}

    def keep(agent: Any, folder: Path, step: int, original: Callable[..., None] = tiers._keep_policies) -> None:
        original(agent, folder, step)
        kept[step] = {name: value.clone() for name, value in agent.policy.state_dict().items()}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tiers, "_keep_policies", keep)
        made(settings=SHORT | {"exploration_std": 0.0})
    agent = TD3(WORLD.observation_size, WORLD.action_size, TD3.configure({"width": 16}), (1,))
    for one in (EXPERT, MEDIUM):
        tier = read_manifest(one).tier
        assert tier is not None
        agent.policy.load_state_dict(kept[tier.step])
        for episode in minari.load_dataset(one):
            actions = agent.act(torch.from_numpy(episode.observations[None, :-1]))[0]
            np.testing.assert_allclose(episode.actions, actions.numpy(), rtol=0, atol=1e-6)


@pytest.mark.parametrize("after", [2, 5, 8])
def test_a_run_that_was_interrupted_ends_the_same(after: int, made_once: Path, datasets: Path) -> None:
    expected = {one: timeless(one, made_once) for one in IDS}
    saves = 0
    original = tiers.Checkpoints.save

    def save(self: Any, step: int, state: Any) -> None:
        nonlocal saves
        original(self, step, state)
        saves += 1
        if saves == after:
            raise interrupts.interrupted("here")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tiers.Checkpoints, "save", save)
        with pytest.raises(interrupts.Interrupted):
            made(checkpoint_every=0.0)
    assert not (datasets / REPLAY).exists()
    made(checkpoint_every=0.0)
    assert {one: timeless(one) for one in IDS} == expected
    assert not list(datasets.rglob(".*"))


@pytest.mark.parametrize("change", [lambda path: path.unlink(), lambda path: path.write_bytes(path.read_bytes()[:100])])
def test_a_policy_that_is_gone_is_missed_in_one_line(change: Callable[[Path], Any], datasets: Path) -> None:
    def stop(*_: Any) -> None:
        raise interrupts.interrupted("here")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tiers, "_finish", stop)
        with pytest.raises(interrupts.Interrupted):
            made()
    change(next(datasets.rglob("policies/000000000600.pt")))
    with pytest.raises(RunError, match="the policy at step 600 of the tiers of reach_top_left seed 1 at smoke was not kept whole"):
        made()


def test_what_is_there_is_kept_and_what_is_missing_is_made_again(there: Path, capfd: pytest.CaptureFixture[str]) -> None:
    before = {one: read_manifest(one) for one in IDS}
    assert made() == IDS
    assert "those of 1 trainings made before are kept" in capfd.readouterr().err
    assert {one: read_manifest(one) for one in IDS} == before
    shutil.rmtree(there / MEDIUM)
    made()
    assert timeless(MEDIUM) == before[MEDIUM].model_dump(exclude={"seconds", "created"})
    assert {one: read_manifest(one) for one in (EXPERT, MEDIUM_REPLAY, REPLAY)} == {
        one: before[one] for one in (EXPERT, MEDIUM_REPLAY, REPLAY)
    }
    with pytest.raises(UsageError, match=f"'{EXPERT}' exists .expert, profile smoke"):
        made(steps=250)


def test_learners_train_on_them_and_records_say_how_they_were_made(there: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    how = {"profile": "smoke", "settings": BRIEF, "policies": False}
    paths = cudc_bench.evaluate("bc", "jaco", [TASK], ["expert", "medium-replay"], **how)
    records = [read_record(path) for path in paths]
    assert [(record.dataset.id, column(record), is_own(record)) for record in records] == [
        (EXPERT, "expert", False), (MEDIUM_REPLAY, "medium-replay", False)
    ]  # fmt: skip
    making = read_manifest(EXPERT).command
    assert making.startswith(f"cudc-bench tiers --domain jaco --task {TASK} --seed 1 --profile smoke --steps 300 --set steps=600 ")
    assert sorted(commands_from_nothing(records[0])[0].split()) == sorted(making.split())
    assert records[0].dataset.collection is not None
    assert records[0].dataset.collection.hyperparameters["data_steps"] == 300
    cudc_bench.make_leaderboard("results", output=tmp_path / "report")
    (table,) = (tmp_path / "report").glob("*/table.md")
    assert "| expert | medium-replay |" in table.read_text()
    with pytest.raises(UsageError, match=r"is of an online training, which is not made again here \(cudc-bench tiers"):
        cudc_bench.rerun(paths, collect=True)


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (
            f"relabel {EXPERT} --tasks reach_top_right",
            f"'{EXPERT}' is of a training on {TASK}, whose rewards it has, and cannot be relabelled",
        ),
        (f"mix {EXPERT} {MEDIUM}", f"'{EXPERT}' is labelled for {TASK}, and a mixture is of task-agnostic datasets"),
        (f"diagnostics {EXPERT}", f"'{EXPERT}' has no diagnostics of a collector: it is of a training on {TASK}"),
        (
            "evaluate --algo bc --method expert --domain jaco --tasks reach_top_right --profile smoke",
            "it comes of an online training: cudc-bench tiers --domain jaco --tasks reach_top_right --seeds 1 --profile smoke",
        ),
        (f"evaluate --algo fb --method expert --domain jaco --tasks {TASK} --profile smoke", "expert holds the rewards of one task"),
        ("tiers --domain jaco --tasks fly --profile smoke", "unknown jaco task 'fly'"),
    ],
)
def test_what_cannot_be_done_with_them_is_said_in_one_line(
    command: str, message: str, there: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(command.split())
    out, err = capfd.readouterr()
    assert (ended.value.code, out, len(err.splitlines())) == (2, "", 1)
    assert message in err


def test_the_medium_policy_is_the_first_above_a_third() -> None:
    curve = [LearningPoint(step=step, score=score) for step, score in ((0, 50.0), (10, 20.0), (20, 31.0), (30, 90.0), (40, 80.0))]
    assert [step_of(kind, curve, 90.0) for kind in TIERS] == [40, 20, 20, 40]
    assert step_of("medium", curve, 93.0) == 30  # 31 is no more than a third
    assert step_of("medium", curve[:3], 300.0) == 20  # none of them: the last


LIES: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "kind": (lambda m: m["tier"].update(kind="medium"), "it is medium of a training, and says method expert"),
    "score": (lambda m: m["tier"].update(score=1e3), "its training's curve leads to step 600 of 600"),
    "step": (lambda m: m["tier"].update(step=300), "its training's curve leads to step 600 of 600, and it says step 300"),
    "size": (lambda m: m["hyperparameters"].update(data_steps=301), "the hyperparameters do not fit their hash"),
    "seed": (lambda m: m.update(seed=2), "its command says --seeds 1, and it has 2"),
}  # fmt: skip


@pytest.mark.parametrize("lie", LIES)
def test_a_manifest_that_says_otherwise_is_found(lie: str, there: Path) -> None:
    change, message = LIES[lie]
    path = there / EXPERT / "data" / "metadata.json"
    metadata = json.loads(path.read_text())
    change(metadata[KEY])
    Manifest.model_validate(metadata[KEY])
    path.write_text(json.dumps(metadata))
    with pytest.raises(RunError, match=message):
        cudc_bench.verify(EXPERT)
