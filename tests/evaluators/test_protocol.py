"""What ``evaluate`` promises beside one training run: parts of datasets, several of everything, resuming, policies."""

import json
import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import cudc_bench
from cudc_bench import plugins
from cudc_bench.artefacts.records import Record, read_record
from cudc_bench.cli.options import parse_sizes
from cudc_bench.envs import DOMAINS
from cudc_bench.errors import RunError, UsageError
from cudc_bench.evaluators.contract import BRIEF
from cudc_bench.evaluators.policies.rollout import play, recorded_seeds
from cudc_bench.evaluators.policies.stored import load_policy, policy_path
from cudc_bench.evaluators.running import evaluate as api
from cudc_bench.evaluators.running.datasets import load_members
from cudc_bench.evaluators.running.loop import Arena, run_evaluation
from cudc_bench.execution import interrupts
from cudc_bench.execution.checkpoints import Checkpoints
from cudc_bench.settings.evaluate_config import EvaluateConfig
from cudc_bench.settings.seeding import episode_seed

from ..served import briefly
from .helpers import make, random_walker_data

WALK = "walker/walk/cudc-smoke-v0"


def results(tmp_path: Path) -> Path:
    return tmp_path / "results"


def evaluated(tmp_path: Path, **options) -> list[tuple[Path, Record]]:
    with briefly():
        paths = cudc_bench.evaluate(output=results(tmp_path), **{"profile": "smoke", "dataset_id": WALK} | options)
    return [(path, read_record(path)) for path in paths]


# Parts of datasets


@pytest.mark.parametrize("used", [1, 999, 1000, 1001, 2500])
def test_the_first_transitions_are_the_datasets_own(smoke, used):
    whole, part = load_members([WALK], [1], "cpu"), load_members([WALK], [1], "cpu", used)
    assert int(part.lengths.sum()) == used
    assert part.episodes() == -(-used // 1000)
    assert torch.equal(part.actions[0], whole.actions[0, :used])
    assert torch.equal(part.rewards[0], whole.rewards[0, :used])
    rows = used + part.episodes()
    assert torch.equal(part.observations[0, :rows], whole.observations[0, :rows])
    # Transitions are sampled from these alone.
    batch = part.sample(2000, torch.ones(1, dtype=torch.int64))
    assert set(map(tuple, batch.observation[0].tolist())) <= set(map(tuple, part.observations[0, :rows].tolist()))


def test_sizes_have_records_and_tables_of_their_own(smoke, tmp_path):
    found = evaluated(tmp_path, dataset_sizes=[3000, 500, 1500])
    assert [path.name for path, _ in found] == ["td3-first500-seed1.json", "td3-first1500-seed1.json", "td3-seed1.json"]
    assert [record.dataset.used for _, record in found] == [500, 1500, None]
    assert "--dataset-size 500" in found[0][1].command
    assert "--dataset-size" not in found[2][1].command
    report = cudc_bench.make_leaderboard(results(tmp_path), None)
    assert sorted(table.group for table in report.tables) == [
        "smoke", "smoke (first 1,500 transitions)", "smoke (first 500 transitions)",
    ]  # fmt: skip
    assert report.problems == []
    # All data are those of a run that was not asked for a size.
    alone = evaluated(tmp_path / "other")[0][1]
    assert (alone.curve, alone.final) == (found[2][1].curve, found[2][1].final)
    assert found[0][1].curve[-1] != alone.curve[-1]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"dataset_sizes": [500, 3001]}, "'walker/walk/cudc-smoke-v0' has 3,000 transitions, not 3,001"),
        ({"dataset_sizes": [0]}, "a dataset size is a number of transitions, 1 or more"),
        ({"dataset_sizes": []}, "a dataset size is"),
        ({"dataset_id": []}, "no dataset was named"),
        ({"algo": []}, "no algorithm was given; allowed: bc, cql"),
        ({"algo": ["td3", "td5"]}, "unknown algo 'td5'"),
        ({"algo": ["bc", "td3"], "settings": {"beta": 1.0}}, "nothing here is called 'beta'"),
        ({"steps": 0}, "'milestones' cannot be"),
        ({"steps": 10, "settings": {"gradient_steps": "5"}}, "--steps and --set gradient_steps say the same"),
        ({"dataset_id": ["walker/walk/cudc-smoke-v0"], "tasks": ["run"]}, "is labelled for walk, not for run"),
    ],
)
def test_wrong_input_is_refused_and_nothing_is_trained(smoke, tmp_path, options, said):
    with pytest.raises(UsageError, match=said.replace("(", r"\(")):
        evaluated(tmp_path, **options)
    assert not results(tmp_path).exists()


# Several of everything


def test_several_algorithms_and_datasets_in_one_call(smoke, tmp_path):
    found = evaluated(tmp_path, algo=["bc", "iql"], dataset_id=["walker/run/cudc-smoke-v0", "walker/cudc-smoke-v0"], tasks=["run", "stand"])
    assert [(record.algorithm, record.dataset.task) for _, record in found] == [
        ("bc", "run"), ("bc", "stand"), ("iql", "run"), ("iql", "stand"),
    ]  # fmt: skip
    assert len({path for path, _ in found}) == 4


def test_a_setting_goes_to_the_algorithms_that_have_it(smoke, tmp_path):
    found = dict.fromkeys(["bc", "iql"])
    for _, record in evaluated(tmp_path, algo=["bc", "iql"], settings={"beta": "1.5"}):
        found[record.algorithm] = record.overrides
    assert found == {"bc": {}, "iql": {"beta": 1.5}}


def test_steps_shorten_a_run_with_its_schedule_and_milestones(smoke, tmp_path):
    ((_, record),) = evaluated(tmp_path, algo="iql", steps=30)
    assert record.milestones == [20, 30]
    assert record.hyperparameters["schedule_steps"] == record.final.step == 30
    # The schedule follows from the length, and is nobody's change of its own.
    assert record.overrides == {"gradient_steps": 30, "milestones": [20, 30]}
    ((_, longer),) = evaluated(tmp_path / "longer", algo="iql", steps=60)
    assert longer.milestones == [20, 40, 60]
    ((_, own),) = evaluated(tmp_path / "own", steps=30, settings={"milestones": "[30]"})
    assert own.milestones == [30]


# Algorithms and domains meet in sizes alone, which the battery of contract.py tries for all of them.
@pytest.mark.parametrize(
    ("domain", "tasks", "algos"),
    [
        ("jaco", ["reach_top_left"], plugins.names("evaluators")),
        *((domain, list(facts.tasks), ["td3"]) for domain, facts in DOMAINS.items()),
    ],
)
def test_every_algorithm_and_every_task(datasets, tmp_path, domain, tasks, algos):
    """Collected, relabelled, trained and in the table."""
    cudc_bench.relabel(*cudc_bench.collect("random", domain, profile="smoke"), tasks)
    with briefly(domain):
        paths = cudc_bench.evaluate(
            algos, domain, tasks, ["random"], profile="smoke", output=results(tmp_path), steps=20, workers=1,
            settings={"evaluate_every": "20", "milestones": "[20]", "evaluation_episodes": "1", "final_episodes": "1"},
        )  # fmt: skip
    records = [read_record(path) for path in paths]
    found = [(record.algorithm, record.dataset.task) for record in records]
    assert found == [(algo, task) for algo in algos for task in tasks]
    assert all(np.isfinite(record.final.returns).all() for record in records)
    report = cudc_bench.make_leaderboard(results(tmp_path), None)
    assert [table.algorithm for table in report.tables] == list(algos)
    assert all({task for _, task, _ in table.runs.cells} == set(tasks) for table in report.tables)


# Resuming


def run_in(folder, agent):
    config = EvaluateConfig(gradient_steps=20, evaluate_every=10, evaluation_episodes=1, final_episodes=2, milestones=(10, 20))
    arena = Arena(BRIEF, ["stand", "walk"])
    with interrupts.leaving_gracefully():
        data = random_walker_data(1, "stand", (3, 4))
        return run_evaluation(agent, data, config, arena, lambda n: None, (), Checkpoints(folder, {}))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """What comes out of a run that nobody interrupts."""
    return run_in(tmp_path_factory.mktemp("whole"), make("td3", (3, 4)))


@pytest.mark.parametrize("acts", [int(n * BRIEF.episode_length) for n in (1.5, 2.5, 3.5, 4.5)])
def test_an_evaluation_that_was_interrupted_is_made_again(acts, tmp_path, whole):
    """Interrupted in the second evaluation, in the larger one beside it, in the one after the last update, and in the larger one then."""
    agent = make("td3", (3, 4))
    act, count = agent.act, [0]

    def asking(observation):
        count[0] += 1
        if count[0] == acts:
            interrupts.request_stop()
        return act(observation)

    agent.act = asking
    with pytest.raises(interrupts.Interrupted, match=f"at gradient step {10 if acts < 3 * BRIEF.episode_length else 20} of 20"):
        run_in(tmp_path, agent)
    assert run_in(tmp_path, make("td3", (3, 4))) == whole


def test_other_data_and_settings_are_never_continued(smoke, tmp_path, monkeypatch):
    def interrupted(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(api, "write_record", interrupted)
    with pytest.raises(KeyboardInterrupt):
        evaluated(tmp_path, checkpoint_every=0.0)
    folder = results(tmp_path) / ".checkpoints" / "smoke" / WALK / "td3-seed1"
    assert len(list(folder.glob("*.pt"))) == 2
    monkeypatch.undo()
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(smoke))
    line = r"td3-seed1.json' had other settings: hyperparameters.learning_rate 0.001, not 0.002\. Use those to continue"
    with pytest.raises(UsageError, match=line):
        evaluated(tmp_path, settings={"learning_rate": "0.002"})
    # Other records are none of its business.
    evaluated(tmp_path, dataset_id="walker/run/cudc-smoke-v0")
    assert folder.exists()
    ((_, record),) = evaluated(tmp_path, settings={"learning_rate": "0.002"}, fresh=True)
    assert record.hyperparameters["learning_rate"] == 0.002
    assert not folder.parents[4].exists()


# The score at the end


def test_the_score_at_the_end_is_the_mean_of_the_last_evaluation_points(smoke, tmp_path):
    options = {"steps": 80, "settings": {"milestones": "[40,80]", "evaluate_every": "20"}}
    ((_, record),) = evaluated(tmp_path, **options)
    assert [evaluation.step for evaluation in record.curve] == [0, 20, 40, 60, 80]
    assert [(one.step, len(one.returns)) for one in record.finals] == [(40, 2), (60, 2), (80, 2)]
    assert record.score(80) == pytest.approx(np.mean([one.returns for one in record.finals]))
    # The curve's own evaluations stay what they were, of other episodes.
    assert record.score(40) == record.curve[2].mean
    returns = [value for one in (*record.curve, *record.finals) for value in one.returns]
    assert len(set(returns)) == len(returns)
    report = cudc_bench.make_leaderboard(results(tmp_path), None)
    (table,) = report.tables
    assert table.episodes == {40: (1, 1), 80: (6, 6)}
    (cell,) = [cell for cell in table.cells.values() if cell.value == pytest.approx(record.score(80))]
    assert cell.n == 1
    # The training is the same however often it is looked at, and so is what the last policy gets.
    ((one, alone),) = evaluated(tmp_path / "alone", **options | {"settings": options["settings"] | {"final_evaluations": "1"}})
    assert (alone.curve, alone.final, alone.metrics, alone.late) == (record.curve, record.final, record.metrics, [])
    assert alone.overrides["final_evaluations"] == 1
    # A record from before it could be set is the same run as one that sets it to what was done then, and another than one of today.
    before = json.loads(one.read_text())
    del before["hyperparameters"]["final_evaluations"], before["overrides"]["final_evaluations"]
    one.write_text(json.dumps(before))
    content = one.read_bytes()
    evaluated(tmp_path / "alone", **options | {"settings": options["settings"] | {"final_evaluations": "1"}})
    assert one.read_bytes() == content
    with pytest.raises(UsageError, match="records another run"):
        evaluated(tmp_path / "alone", **options)


@pytest.mark.parametrize(
    ("gradient_steps", "every", "wanted", "points"),
    [(50, 5, 3, [40, 45, 50]), (50, 5, 1, [50]), (52, 5, 3, [45, 50, 52]), (10, 10, 3, [10]), (7, 10, 3, [7]), (20, 10, 3, [10, 20])],
)
def test_the_larger_evaluations_are_at_the_last_points_after_the_first_update(gradient_steps, every, wanted, points):
    config = EvaluateConfig(gradient_steps=gradient_steps, evaluate_every=every, final_evaluations=wanted)
    assert config.final_points == points


# Training seeds


def timeless(path: Path) -> str:
    """A record but for the time that it took."""
    return json.dumps({name: value for name, value in json.loads(path.read_text()).items() if name not in ("seconds", "created")})


def test_a_dataset_is_trained_on_once_with_each_training_seed(smoke, tmp_path):
    found = evaluated(tmp_path, algo=["bc", "td3"], training_seeds=[1, 5], dataset_sizes=[500, 3000])
    names = [path.name for path, _ in found]
    assert names == [
        *("bc-first500-seed1.json", "bc-first500-seed1-training5.json", "bc-seed1.json", "bc-seed1-training5.json"),
        *("td3-first500-seed1.json", "td3-first500-seed1-training5.json", "td3-seed1.json", "td3-seed1-training5.json"),
    ]
    assert [(record.seed, record.dataset.seed) for _, record in found] == [(1, 1), (5, 1)] * 4
    assert len({record.dataset.fingerprint for _, record in found}) == 1
    # Weights, minibatches and the episodes of evaluations: nothing is the same.
    (_, own), (path, other) = found[-2:]
    assert all(a.returns != b.returns for a, b in zip(own.curve, other.curve, strict=True))
    assert all(a.values != b.values for a, b in zip(own.metrics, other.metrics, strict=True))
    assert "--training-seeds 5" in other.command
    assert "--training-seeds" not in own.command
    assert recorded_seeds(other, 2) == [episode_seed(5, "final evaluation", 40, episode) for episode in range(2)]
    # Each has its own policy, which is that of its seed.
    assert policy_path(path).exists()
    observation = torch.randn(1, 24)
    assert not torch.equal(load_policy(found[-2][0])(observation), load_policy(path)(observation))
    # Played again it gets what its own record says.
    with briefly():
        (played,) = play(lambda n: None, policy=load_policy(path), seeds=recorded_seeds(other, 1), recorded=other.final.returns)
    assert played.total == other.final.returns[0] == played.recorded


def test_without_training_seeds_nothing_is_different(smoke, tmp_path):
    ((path, plain),) = evaluated(tmp_path / "plain")
    ((same, _),) = evaluated(tmp_path / "same", training_seeds=[1])
    assert (path.name, same.name, plain.seed) == ("td3-seed1.json", "td3-seed1.json", 1)
    assert timeless(path) == timeless(same)
    assert "training" not in plain.command
    # It is one and the same run, which is not made again under another name.
    content = path.read_bytes()
    again = evaluated(tmp_path / "plain", training_seeds=[1, 2])
    assert path.read_bytes() == content
    assert [one.name for one, _ in again] == ["td3-seed1.json", "td3-seed1-training2.json"]


def test_a_training_with_another_seed_is_continued_and_kept_by_itself(smoke, tmp_path, monkeypatch):
    ((undisturbed, _),) = evaluated(tmp_path / "undisturbed", training_seeds=[7], workers=2)
    with monkeypatch.context() as patch:
        patch.setattr("cudc_bench.evaluators.running.evaluate.write_record", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            evaluated(tmp_path, training_seeds=[7], checkpoint_every=0.0)
    folder = results(tmp_path) / ".checkpoints" / "smoke" / WALK / "td3-seed1-training7"
    assert len(list(folder.glob("*.pt"))) == 2
    evaluated(tmp_path)  # another run
    assert folder.exists()
    ((path, _),) = evaluated(tmp_path, training_seeds=[7])
    assert timeless(path) == timeless(undisturbed)
    assert not folder.parents[4].exists()
    planned = api.plan_evaluate("td3", "walker", ["walk"], "cudc", [1], profile="smoke", output=results(tmp_path), training_seeds=[1, 7, 8])
    assert [(Path(one.place).name, one.seed, one.done) for one in planned] == [
        ("td3-seed1.json", 1, True), ("td3-seed1-training7.json", 1, True), ("td3-seed1-training8.json", 1, False),
    ]  # fmt: skip
    # A file that was given another's place is another run.
    path.rename(path.with_name("td3-seed1-training8.json"))
    with pytest.raises(UsageError, match="records another run"):
        evaluated(tmp_path, training_seeds=[8])


def test_trainings_in_one_stack_are_those_of_their_seeds(smoke):
    """As on CUDA: two trainings of one dataset share its arrays, and nothing else."""
    both, alone = load_members([WALK, WALK], [1, 5], "cpu"), load_members([WALK], [5], "cpu")
    assert both.observations.shape[0] == 1
    horizon = torch.ones(2, dtype=torch.int64)
    drawn, own = both.sample(64, horizon), alone.sample(64, horizon[:1])
    assert torch.equal(drawn.observation[1:], own.observation)
    assert torch.equal(drawn.reward[1:], own.reward)
    assert not torch.equal(drawn.observation[0], drawn.observation[1])


def test_training_seeds_that_cannot_be_are_refused(smoke, tmp_path):
    for seeds, said in (([], "no seed was given"), ([-1], "a seed cannot be -1"), ([2, 2], "the seed 2 was given twice")):
        with pytest.raises(UsageError, match=said):
            evaluated(tmp_path, training_seeds=seeds)
    assert not results(tmp_path).exists()


# Policies


@pytest.mark.parametrize("algo", ["td3", "cql", "cql-fixed", "iql", "bc"])
def test_a_saved_policy_gives_the_recorded_returns(smoke, tmp_path, algo):
    ((path, record),) = evaluated(tmp_path, algo=algo)
    policy = load_policy(path)
    assert policy.record == record
    # Side by side, as in the run: a product of other shapes may round differently, which a simulation amplifies.
    together = SimpleNamespace(act=policy.module, device=torch.device("cpu"))
    seeds = [episode_seed(1, "final evaluation", 40, episode) for episode in range(2)]
    returns = Arena(BRIEF, ["walk"]).returns(together, [seeds])
    assert returns[0].tolist() == record.final.returns
    observation = torch.randn(5, 24)
    torch.testing.assert_close(policy(observation), policy.module(observation[None])[0])


def test_policies_are_for_the_member_that_they_belong_to(smoke, tmp_path):
    from cudc_bench.evaluators.policies.stored import save_policy

    ((path, _),) = evaluated(tmp_path, algo="td3")
    agent = make("td3", (5, 1))
    save_policy(agent.policy, 1, path)
    observation = torch.randn(3, 24)
    policy = load_policy(path)
    torch.testing.assert_close(policy(observation), agent.act(observation.expand(2, -1, -1))[1])


def test_no_policy_is_kept_when_none_is_wanted(smoke, tmp_path):
    ((path, _),) = evaluated(tmp_path, policies=False)
    assert not policy_path(path).exists()
    with pytest.raises(RunError, match=r"has no policy beside it \(td3-seed1.policy.pt\); train it again with: cudc-bench evaluate"):
        load_policy(path)


def test_the_command_line_takes_all_of_it(cli, smoke, tmp_path):
    done = cli(
        "evaluate", "--algo", "bc,td3-bc", "--dataset-id", f"{WALK},walker/run/cudc-smoke-v0", "--dataset-size", "1_000,2000", "--steps",
        "20", "--set", "evaluation_episodes=1", "--set", "final_episodes=1", "--no-policy", "--workers", "1", brief=True,
    )  # fmt: skip
    assert done.code == 0, done.err
    paths = done.out.split()
    assert len(paths) == 8
    assert {json.loads((tmp_path / path).read_text())["milestones"][-1] for path in paths} == {20}
    assert not list(tmp_path.rglob("*.pt"))
    assert os.path.basename(paths[0]) == "bc-first1000-seed1.json"
    for text in ("0", "1e3", "abc", "-5", "1,,x", "_1"):
        with pytest.raises(UsageError, match="--dataset-size cannot be"):
            parse_sizes(text)
