"""One training without rewards, and what it answers: from a task-agnostic dataset to records, policies, and questions asked later."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import cudc_bench
from cudc_bench.artefacts.manifest import exists, read_manifest
from cudc_bench.artefacts.records import read_record
from cudc_bench.data.reader import load_episodes
from cudc_bench.envs import DOMAINS, make_simulators
from cudc_bench.envs.rewards import load_reward
from cudc_bench.errors import RunError, UsageError
from cudc_bench.evaluators.contract import BRIEF
from cudc_bench.evaluators.policies import rendering
from cudc_bench.evaluators.policies.rollout import recorded_seeds
from cudc_bench.evaluators.policies.stored import learner_path, load_learner, policy_path
from cudc_bench.evaluators.running.labels import Interview, Question, draw_labels
from cudc_bench.execution.parallel import run_jobs
from cudc_bench.leaderboard.intake.submit import RefusedError
from cudc_bench.runs import execution

from ...documents.pages import block
from ...served import briefly
from ..helpers import ZERO_SHOT, make
from ..test_rendering import Sketch

BASE = "walker/cudc-smoke-v0"
WALKER = DOMAINS["walker"]
OWN = """
import numpy as np

def hop(measured):
    return measured["torso_height"] * (measured["torso_upright"] > 0)

def never(measured):
    return np.zeros(len(measured["action"]))
"""


@pytest.fixture
def base(smoke, monkeypatch, tmp_path):
    """A task-agnostic dataset alone, in a folder in which people wrote reward functions."""
    (tmp_path / "zero_shot_rewards.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield BASE
    sys.modules.pop("zero_shot_rewards", None)
    load_reward.__globals__["_load"].cache_clear()


def evaluated(output="results", algo="fb", **options):
    """The records of a brief evaluation by task and number of labels."""
    with briefly():
        paths = cudc_bench.evaluate(algo, dataset_id=BASE, profile="smoke", output=output, **options)
    records = [(path, read_record(path)) for path in paths]
    return {(one.dataset.task, one.zero_shot.labels): (path, one) for path, one in records}


def answers(found):
    """What of records follows from a training and its questions."""
    return {key: (one.curve, one.late, one.final, one.metrics, one.zero_shot.norm, policy_path(path).read_bytes())
            for key, (path, one) in found.items()}  # fmt: skip


# --------------------------------------------------------------------------------------------------------------------------- labels


def test_labels_are_what_relabelling_gives(smoke):
    drawn = draw_labels(BASE, WALKER, WALKER.tasks, 500)
    rows = {}
    flat = load_episodes(BASE, ("observations", "actions"))
    for episode, (observations, actions) in enumerate(zip(flat.split("observations"), flat.split("actions"), strict=True)):
        for step, action in enumerate(actions):
            rows[observations[step].tobytes(), action.tobytes(), observations[step + 1].tobytes()] = episode, step
    where = [rows[s.numpy().tobytes(), a.numpy().tobytes(), n.numpy().tobytes()]
             for s, a, n in zip(drawn.observation, drawn.action, drawn.next_observation, strict=True)]  # fmt: skip
    assert len(set(where)) == 500
    assert len({episode for episode, _ in where}) == len(flat.lengths)
    for task in WALKER.tasks:
        labelled = load_episodes(f"walker/{task}/cudc-smoke-v0", ("rewards",)).split("rewards")
        assert drawn.rewards[task].tolist() == [float(labelled[episode][step]) for episode, step in where]


def test_labels_are_the_same_for_everybody_and_fewer_are_the_beginning_of_more(base):
    many, few = (draw_labels(base, WALKER, ["walk"], count) for count in (10_000, 40))
    assert len(many.action) == read_manifest(base).steps
    for name in ("observation", "action", "next_observation"):
        assert torch.equal(getattr(many, name)[:40], getattr(few, name))
    assert torch.equal(many.rewards["walk"][:40], few.rewards["walk"])
    own = draw_labels(base, WALKER, ["hop"], 40, load_reward("zero_shot_rewards:hop", WALKER))
    assert torch.equal(own.action, few.action)
    assert (own.rewards["hop"] > 0).any()


def test_labels_of_a_part_are_of_that_part(base):
    first = load_episodes(base, ("actions",)).arrays["actions"][:300]
    drawn = draw_labels(base, WALKER, ["walk"], 10_000, used=300)
    assert sorted(map(bytes, drawn.action.numpy())) == sorted(map(bytes, first))


def test_each_question_is_answered_by_itself(base):
    agent = make("fb", (1, 2))
    samples = [draw_labels(base, WALKER, WALKER.tasks, 200)] * 2
    questions = [Question(task, labels) for task in WALKER.tasks for labels in (50, 200)]
    together = Interview(agent, samples, questions)
    observation = torch.randn(2 * len(questions), 3, 24, generator=torch.Generator().manual_seed(0))
    actions = together.actor().act(observation).view(2, len(questions), 3, 6)
    for index, question in enumerate(questions):
        alone = Interview(agent, samples, [question])
        assert torch.equal(together.told().z[:, [index]], alone.told().z)
        assert torch.equal(alone.actor().act(observation.view(2, len(questions), 3, 24)[:, index]), actions[:, index])


# -------------------------------------------------------------------------------------------------------------------------- records


def test_one_training_has_a_record_for_each_task_and_budget_and_needs_no_labelled_dataset(base, smoke, tmp_path):
    cudc_bench.collect("random", profile="smoke", dataset_id="walker/alone-v0")
    with briefly():
        paths = cudc_bench.evaluate("fb", dataset_id="walker/alone-v0", profile="smoke", labels=[20, 10_000], tasks=["walk", "run"])
    names = [str(path.relative_to("results")) for path in paths]
    assert names == [
        "smoke/walker/walk/alone-v0/fb-labels20-seed1.json", "smoke/walker/walk/alone-v0/fb-seed1.json",
        "smoke/walker/run/alone-v0/fb-labels20-seed1.json", "smoke/walker/run/alone-v0/fb-seed1.json",
    ]  # fmt: skip
    assert not exists("walker/walk/alone-v0")
    records = [read_record(path) for path in paths]
    assert len({one.zero_shot.training for one in records}) == 1
    assert {(one.zero_shot.records, one.zero_shot.rule) for one in records} == {(4, "normalised mean of r B(s')")}
    assert [one.zero_shot.drawn for one in records] == [20, 3000, 20, 3000]
    assert [(one.dataset.id, one.labelled_id) for one in records[::2]] == [
        ("walker/alone-v0", "walker/walk/alone-v0"), ("walker/alone-v0", "walker/run/alone-v0"),
    ]  # fmt: skip
    assert [one.group for one in records[:2]] == ["smoke (20 labels)", "smoke"]
    seconds = sum(one.seconds for one in records)
    assert seconds == pytest.approx(records[0].zero_shot.training_seconds, abs=0.2)
    before = [path.read_bytes() for path in paths]
    with briefly():
        cudc_bench.evaluate("fb", dataset_id="walker/alone-v0", profile="smoke", labels=[20, 10_000], tasks=["walk", "run"])
    assert [path.read_bytes() for path in paths] == before


def test_what_a_record_says_depends_on_no_other_question(base):
    every = answers(evaluated("every", labels=[30, 10_000]))
    assert len(every) == 8
    alone = answers(evaluated("alone", labels=[30], tasks=["run"]))
    assert alone == {("run", 30): every["run", 30]}
    assert every["run", 30] != every["run", 10_000]


def test_a_named_labelled_dataset_stands_for_the_one_behind_it(base):
    with briefly():
        (path,) = cudc_bench.evaluate("fb", dataset_id="walker/walk/cudc-smoke-v0", profile="smoke", output="by-labelled")
    record = read_record(path)
    assert (record.dataset.id, record.dataset.task) == (BASE, "walk")
    assert record.dataset.fingerprint == read_manifest(BASE).fingerprint
    found = evaluated("by-base", tasks=["walk"])
    assert answers(found)["walk", 10_000] == answers({("walk", 10_000): (path, record)})["walk", 10_000]


@pytest.mark.parametrize("algo", ZERO_SHOT)
def test_the_policy_beside_a_record_is_that_of_its_task(base, algo):
    found = evaluated(algo=algo, tasks=["stand", "flip"])
    observation = np.random.default_rng(0).normal(size=(4, 24)).astype(np.float32)
    acted = {}
    for (task, _), (path, record) in found.items():
        policy = cudc_bench.load_policy(path)
        acted[task] = policy.act(observation)
        assert record.zero_shot.norm > 0
    assert not np.allclose(acted["stand"], acted["flip"])


def test_labels_of_another_dataset(base):
    cudc_bench.collect("random", profile="smoke", dataset_id="walker/other-v0")
    found = evaluated(labels_from="walker/other-v0", tasks=["walk"])
    ((_, record),) = found.values()
    assert record.zero_shot.source.id == "walker/other-v0"
    assert record.group == f"smoke (labels of walker/other-v0 {read_manifest('walker/other-v0').fingerprint[:8]})"
    assert "--labels-from walker/other-v0" in record.command
    with pytest.raises(UsageError, match="records another run"):
        evaluated(tasks=["walk"])


def test_rewards_that_are_all_zero_are_an_outcome(base, capsys):
    found = evaluated(reward="zero_shot_rewards:never")
    ((path, record),) = found.values()
    assert (record.zero_shot.norm, record.zero_shot.rewarded) == (0.0, 0.0)
    assert set(record.final.returns) == {0.0}
    assert "none of the 3,000 labels has a reward" in capsys.readouterr().err
    assert np.isfinite(cudc_bench.load_policy(path).act(np.zeros(24, np.float32))).all()


def test_the_command_of_a_record_makes_it_again(base, tmp_path, cli):
    for options in ({"labels": [30], "tasks": ["walk"]}, {"reward": "zero_shot_rewards:hop"}):
        ((path, record),) = evaluated("first", **options).values()
        words = record.command.split()[1:]
        done = cli(*words, "--output", "again", brief=True)
        assert done.code == 0, done.err
        again = read_record(tmp_path / "again" / path.relative_to("first"))
        assert answers({0: (path, record)}) == answers({0: (tmp_path / "again" / path.relative_to("first"), again)})


def test_what_cannot_be_asked_is_said_before_any_training(base):
    cases: list[tuple[dict, str]] = [
        ({"algo": "td3", "labels": [100]}, "--labels and --labels-from are for learners without rewards"),
        ({"labels": [0]}, "--labels takes numbers of transitions"),
        ({"labels": []}, "--labels takes numbers of transitions"),
        ({"labels_from": "walker/nothing-v0"}, "no dataset 'walker/nothing-v0'"),
    ]
    for options, message in cases:
        with pytest.raises(UsageError, match=message):
            cudc_bench.evaluate(**{"algo": "fb", "dataset_id": BASE, "profile": "smoke"} | options)
    assert not Path("results").exists()


# ------------------------------------------------------------------------------------------------------------------------------ ask


def test_a_task_that_is_asked_for_later_is_answered_as_it_was_at_once(base):
    found = evaluated(tasks=["walk", "run"])
    path, record = found["run", 10_000]
    with briefly():
        asked = cudc_bench.ask_policy(found["walk", 10_000][0], task="run", episodes=len(record.final.returns))
    assert list(asked.returns) == record.final.returns
    assert asked.norm == record.zero_shot.norm
    there = read_record(asked.record)
    assert there.labelled_id == record.labelled_id
    assert policy_path(asked.record).read_bytes() == policy_path(path).read_bytes()
    # Of a record with fewer labels, and by the learner's own file, too.
    few = evaluated("few", tasks=["walk"], labels=[30])["walk", 30][0]
    assert learner_path(few, read_record(few)).is_file()
    with briefly():
        by_file = cudc_bench.ask_policy(learner_path(path, record), task="run", episodes=2, output="by-file")
        of_few = cudc_bench.ask_policy(few, task="run", episodes=2, output="of-few")
        by_fews_file = cudc_bench.ask_policy(learner_path(few, read_record(few)), task="run", episodes=2, output="by-fews-file")
    assert by_file.returns == of_few.returns == by_fews_file.returns
    assert by_file.norm == of_few.norm == by_fews_file.norm == asked.norm


def test_a_user_asks_and_sees_the_video(base, cli, monkeypatch):
    """The story of docs/how-to/zero-shot.md."""
    (path, _), *_ = evaluated(tasks=["walk"]).values()
    program = block("docs/how-to/zero-shot.md", "ask_policy").replace("my_rewards", "zero_shot_rewards")
    program = program.replace("results/cpu/walker/walk/cudc-v0/fb-seed1.json", str(path))
    known: dict = {}
    with briefly():
        exec(program, known)
    assert len(known["asked"].returns) == 10
    assert known["policy"].act(np.zeros(24, np.float32)).shape == (6,)
    done = cli("ask", str(path), "--reward", "zero_shot_rewards:hop", "--episodes", "2", brief=True)
    assert done.code == 0, done.err
    record = Path(done.out.strip())
    assert "of the labels have a reward" in done.err
    found = read_record(record)
    assert found.dataset.reward.reference == "zero_shot_rewards:hop"
    assert found.zero_shot.rewarded > 0
    monkeypatch.setattr(rendering, "Drawer", Sketch)
    with briefly():
        video = cudc_bench.render_policy(record, "hop.gif", reward="zero_shot_rewards:hop", fps=4, width=32, height=24)
    assert video.returns == video.recorded == tuple(found.final.returns[:1])
    with Image.open("hop.gif") as picture:
        assert picture.n_frames > 1
    exported = cudc_bench.export_policy(record)
    assert exported.is_file()


@pytest.mark.parametrize("algo", ["fb", "hilp"])
def test_a_goal_is_a_state_to_come_near(base, algo):
    (path, record), *_ = evaluated(algo=algo, tasks=["walk"]).values()
    flat = load_episodes(base, ("observations", "infos/physics"))
    state, physics = (flat.split(name)[1][300] for name in ("observations", "infos/physics"))
    np.save("state.npy", physics)
    with briefly():
        by_step = cudc_bench.ask_policy(path, goal="1:300", episodes=2)
        by_file = cudc_bench.ask_policy(path, goal="state.npy", episodes=2, output="by-file")
        by_array = cudc_bench.ask_policy(path, goal=state, episodes=2, output="by-array")
    assert by_step.returns == by_file.returns == by_array.returns
    found = read_record(by_step.record)
    name = found.dataset.task
    assert found.zero_shot.rule.endswith("with a reward at the goal alone")
    assert found.zero_shot.rewarded == by_step.rewarded == 1 / (found.zero_shot.drawn + 1)
    assert (found.machine["device"], found.machine["threads"]) == ("cpu", 1)
    assert found.dataset.reward.reference == f"{name}:{name}"
    assert Path(f"asked/{name}.py").is_file()
    agent = load_learner(path, record)
    if algo == "fb":
        z = cudc_bench.load_policy(by_step.record).module.z[0, 0]
        torch.testing.assert_close(z, agent.backward_map(torch.from_numpy(state)[None, None])[0, 0])
    # The return is minus the summed distance, by playing the policy again.
    monkey = cudc_bench.load_policy(by_step.record)
    (simulator,) = make_simulators("walker", 1)
    observations, total = np.empty((2, 24), np.float32), 0.0
    simulator.reset(recorded_seeds(found, 1)[0])
    simulator.observe(observations[0])
    for _ in range(BRIEF.episode_length):
        observations[:] = observations[0]
        simulator.step(monkey.act(observations)[0])
        simulator.observe(observations[0])
        total -= float(np.linalg.norm(observations[0] - state))
    assert total == pytest.approx(by_step.returns[0], rel=1e-6)


def test_what_is_asked_wrongly_is_one_line(base, tmp_path):
    (path, _), *_ = evaluated(tasks=["walk"]).values()
    with briefly():
        (onestep,) = cudc_bench.evaluate("fb-onestep", dataset_id=BASE, tasks=["walk"], profile="smoke")
        (td3,) = cudc_bench.evaluate("td3", dataset_id="walker/walk/cudc-smoke-v0", profile="smoke")
    cases = [
        ((td3, None), {"task": "walk"}, "was trained for walk alone"),
        ((path, None), {}, "ask for one thing"),
        ((path, "zero_shot_rewards:hop"), {"task": "walk"}, "ask for one thing"),
        ((path, None), {"task": "fly"}, "fly"),
        ((path, None), {"goal": "9999:0"}, "has no step 0 of episode 9999"),
        ((path, None), {"goal": "nothing.npy"}, "takes a file"),
        ((path, None), {"goal": np.zeros(5)}, "a goal of walker is"),
        ((path, None), {"goal": np.full(24, np.nan)}, "finite real numbers"),
        ((onestep, None), {"goal": np.zeros(24)}, "takes no --goal"),
        ((path, None), {"task": "walk", "labels": 0}, "--labels takes 1 or more"),
        ((path, None), {"task": "walk", "episodes": 0}, "--episodes takes 1 or more"),
        ((path, None), {"task": "walk", "labels_from": "walker/nothing-v0"}, "not here"),
        (("nothing.json", None), {"task": "walk"}, "there is no file"),
    ]
    for arguments, options, message in cases:
        with pytest.raises(UsageError, match=message):
            cudc_bench.ask_policy(*arguments, **options)
    learner_path(path, read_record(path)).write_bytes(b"damaged")
    with pytest.raises(RunError, match="is damaged"):
        cudc_bench.ask_policy(path, task="walk")
    learner_path(path, read_record(path)).unlink()
    with pytest.raises(RunError, match="is not here"):
        cudc_bench.ask_policy(path, task="walk")


# ----------------------------------------------------------------------------------------------------------------- handed in, run again


def test_a_record_that_is_handed_in_must_be_what_its_learner_makes(tmp_path, monkeypatch):
    cudc_bench.collect("cudc", profile="smoke")
    monkeypatch.chdir(tmp_path)
    paths = cudc_bench.evaluate("fb", tasks=["walk"], profile="smoke", labels=[30, 10_000], output="theirs")
    received = cudc_bench.submit(paths, by="ann", output="ours")
    assert [path.name for path in received.files] == ["fb-labels30-seed1.json", "fb-seed1.json"]
    there = json.loads(paths[1].read_text())
    wrong = {
        "labels": there | {"zero_shot": there["zero_shot"] | {"labels": 20}},
        "rewards": {name: value for name, value in there.items() if name != "zero_shot"},
    }
    for name, content in wrong.items():
        place = tmp_path / f"{name}.json"
        place.write_text(json.dumps(content))
        with pytest.raises(RefusedError):
            cudc_bench.submit([place], by="bob", output="ours")


def test_records_of_one_training_are_made_again_by_one(base):
    cudc_bench.collect("random", profile="smoke")
    with briefly():
        paths = cudc_bench.evaluate("fb", "walker", ["walk", "run"], ["random"], profile="smoke", labels=[30, 10_000])
        results = cudc_bench.rerun(paths[1:])
    assert [one.differences for one in results] == [(), (), ()]


@pytest.mark.parametrize("algo", ["fb", "hilp"])
def test_trainings_side_by_side_answer_as_they_do_alone(base, algo, monkeypatch):
    cudc_bench.collect("random", profile="smoke", dataset_id="walker/other-v0")
    monkeypatch.setattr(execution, "run_jobs", lambda *given, **options: run_jobs(*given, **options | {"workers": 1}))

    def found(output, *ids):
        with briefly():
            paths = cudc_bench.evaluate(algo, dataset_id=list(ids), profile="smoke", tasks=["walk", "run"], output=output)
        return {path.relative_to(output): (path, read_record(path)) for path in paths}

    together = found("together", BASE, "walker/other-v0")
    assert {one.machine.get("beside", 1) for _, one in together.values()} == {2}
    assert answers(together) == answers(found("alone", BASE) | found("alone", "walker/other-v0"))
