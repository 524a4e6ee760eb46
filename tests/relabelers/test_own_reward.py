"""A user's thirteenth task: one function labels data, scores policies and is the live reward, and is never run unasked."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import gymnasium
import minari
import numpy as np
import pytest

import cudc_bench
from cudc_bench.artefacts.manifest import read_manifest
from cudc_bench.artefacts.records import read_record
from cudc_bench.envs import DOMAINS, make_simulators
from cudc_bench.envs.rewards import Measured, load_reward
from cudc_bench.errors import RunError, UsageError

MODULE = '''
import numpy as np

def hop(measured):
    """High and upright, by what is measured, seen and done."""
    assert measured["physics"].dtype == np.float64
    effort = np.square(measured["action"]).mean(-1)
    return measured["torso_height"] * measured["torso_upright"] + measured["observation"][:, 14] - 0.1 * effort

def wrong_name(measured):
    return measured["torso_hight"]

def wrong_shape(measured):
    return np.zeros(3)

def not_a_number(measured):
    return np.log(-np.ones(len(measured["action"])))

def too_large(measured):
    return np.where(np.arange(len(measured["action"])) == 7, 1e300, 0.0)

def not_real(measured):
    return np.ones(len(measured["action"])) * 1j

def fails(measured):
    return 1 / 0

def walk(measured):
    return measured["torso_height"]

def Upper(measured):
    return measured["torso_height"]

constant = 1.0
'''


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A working folder with a module of reward functions, which no other test sees."""
    (tmp_path / "own_rewards.py").write_text(MODULE)
    (tmp_path / "broken_rewards.py").write_text("1 / 0\n")
    monkeypatch.chdir(tmp_path)
    path = list(sys.path)
    yield tmp_path
    sys.path[:] = path
    for name in ("own_rewards", "broken_rewards"):
        sys.modules.pop(name, None)
    load_reward.__globals__["_load"].cache_clear()


def expected(episode: minari.EpisodeData) -> np.ndarray:
    """The function's rewards by an independent route: height and uprightness as the observation has them."""
    reached = episode.observations[1:].astype(np.float64)
    height, upright = reached[:, 14], reached[:, 0]
    # The torso's rotation is about y, so that its zz entry equals its xx entry, which is observed.
    return height * upright + height - 0.1 * np.square(episode.actions.astype(np.float64)).mean(-1)


def test_a_dataset_is_labelled_by_it(place: Path, smoke: Path) -> None:
    assert cudc_bench.relabel("walker/cudc-smoke-v0", reward="own_rewards:hop") == ["walker/hop/cudc-smoke-v0"]
    manifest = read_manifest("walker/hop/cudc-smoke-v0")
    assert manifest.task == "hop"
    assert manifest.reward is not None
    assert manifest.reward.reference == "own_rewards:hop"
    assert manifest.command == "cudc-bench relabel walker/cudc-smoke-v0 --reward own_rewards:hop"
    dataset = minari.load_dataset("walker/hop/cudc-smoke-v0")
    for episode in dataset.iterate_episodes():
        np.testing.assert_allclose(episode.rewards, expected(episode), rtol=0, atol=1e-5)
        assert np.ptp(episode.rewards) > 0.1


def test_the_function_itself_does_as_well(place: Path, smoke: Path) -> None:
    sys.path.append(str(place))
    import own_rewards

    assert cudc_bench.relabel("walker/cudc-smoke-v0", reward=own_rewards.hop) == ["walker/hop/cudc-smoke-v0"]
    assert read_manifest("walker/hop/cudc-smoke-v0").reward.reference == "own_rewards:hop"
    with pytest.raises(UsageError, match="cannot be imported again, as evaluation needs it"):
        cudc_bench.relabel("walker/cudc-smoke-v0", reward=lambda measured: measured["torso_height"])


def test_the_recovered_environment_gives_the_same_rewards(place: Path, smoke: Path, python: Callable) -> None:
    cudc_bench.relabel("walker/cudc-smoke-v0", reward="own_rewards:hop")
    script = """
import minari, numpy as np, sys
sys.path.insert(0, "")
dataset = minari.load_dataset("walker/hop/cudc-smoke-v0")
environment, episode = dataset.recover_environment(), dataset[1]
environment.reset(seed=int(next(iter(dataset.storage.get_episode_metadata([1])))["seed"]))
rewards = [environment.step(action)[1] for action in episode.actions]
assert np.array(rewards, np.float32).tobytes() == episode.rewards.tobytes()
print(environment.spec.id, environment.spec.max_episode_steps)
"""
    assert python(script) == (0, "cudc_bench/walker-hop-v0 1000\n", "")


def test_policies_are_scored_by_it(place: Path, smoke: Path, cli: Callable) -> None:
    done = cli("evaluate", "--reward", "own_rewards:hop", "--output", "out", brief=True)
    assert done.code == 0, done.err
    assert "walker/hop/cudc-smoke-v0 missing: relabelling first" in done.err
    record = read_record(place / done.out.strip())
    assert (record.dataset.task, record.dataset.reward.reference) == ("hop", "own_rewards:hop")
    assert "reward: own_rewards:hop" in record.group
    assert cli(*record.command.split()[1:], "--output", "again", brief=True).code == 0
    (again,) = (place / "again").rglob("*.json")
    assert read_record(again).final == record.final
    # Replayed here: the returns are those of the function in the live environment.
    environment = gymnasium.make("cudc_bench/walker-v0", reward="own_rewards:hop")
    environment.reset(seed=0)
    _, reward, *_ = environment.step(np.zeros(6, np.float32))
    assert 0.0 < abs(reward) < 3.0
    assert all(0.0 < abs(value) < 3000.0 for value in record.final.returns)
    report = cli("leaderboard", "out")
    assert report.code == 0, report.err
    assert "hop" in report.out


def test_a_function_is_run_only_if_the_user_names_it(place: Path, smoke: Path, cli: Callable) -> None:
    cudc_bench.relabel("walker/cudc-smoke-v0", reward="own_rewards:hop")
    (place / "own_rewards.py").write_text("raise SystemExit('ran')\n")
    done = cli("evaluate", "--dataset-id", "walker/hop/cudc-smoke-v0")
    assert done.code == 2
    assert "is labelled by the function own_rewards:hop; to run it here, give --reward own_rewards:hop." in done.err
    done = cli("evaluate", "--dataset-id", "walker/walk/cudc-smoke-v0", "--reward", "broken_rewards:hop")
    assert done.code == 2
    assert "cannot import 'broken_rewards': ZeroDivisionError" in done.err


def test_a_function_that_was_changed_is_another_one(place: Path, smoke: Path, cli: Callable) -> None:
    cudc_bench.relabel("walker/cudc-smoke-v0", reward="own_rewards:hop")
    (place / "own_rewards.py").write_text(MODULE.replace("0.1 * effort", "0.2 * effort"))
    short = ("evaluate", "--algo", "bc", "--reward", "own_rewards:hop", "--steps", "2", "--no-policy")
    done = cli(*short)
    assert done.code == 1
    said = "'walker/hop/cudc-smoke-v0' was labelled by another text of the function own_rewards:hop; evaluate --overwrite labels it again"
    assert done.err.splitlines()[-1].startswith(f"cudc-bench: error: {said}")
    by_id = cli(*short, "--dataset-id", "walker/hop/cudc-smoke-v0")
    assert by_id.code == 1
    assert "cudc-bench relabel walker/cudc-smoke-v0 --reward own_rewards:hop --overwrite." in by_id.err


def test_one_command_goes_on_with_a_function_that_was_changed(place: Path, smoke: Path, cli: Callable) -> None:
    short = ("evaluate", "--algo", "bc", "--reward", "own_rewards:hop", "--steps", "2", "--no-policy", "--output", "out")
    (path,) = cli(*short, brief=True).out.split()
    before = read_record(place / path)
    for number, more in enumerate(((), ("--dataset-id", "walker/hop/cudc-smoke-v0"), ("--dataset-id", "walker/cudc-smoke-v0"))):
        (place / "own_rewards.py").write_text(MODULE.replace("0.1 * effort", f"0.{number + 2} * effort"))
        done = cli(*short, *more, "--overwrite", brief=True)
        assert (done.code, done.out.split()) == (0, [path]), done.err
        after = read_record(place / path)
        assert after.dataset.fingerprint != before.dataset.fingerprint
        assert after.dataset.fingerprint == read_manifest("walker/hop/cudc-smoke-v0").fingerprint
        assert "labelled by another text of the function own_rewards:hop: relabelling first" in done.err
        before = after
    # What has not changed is not made again.
    made = (smoke / "walker/hop/cudc-smoke-v0/data/metadata.json").stat().st_mtime_ns
    assert cli(*short, "--overwrite", brief=True).code == 0
    assert (smoke / "walker/hop/cudc-smoke-v0/data/metadata.json").stat().st_mtime_ns == made


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        ("own_rewards", "--reward takes module:function, not 'own_rewards'."),
        ("own_rewards:hopp", "'own_rewards' has no function 'hopp'; it has: "),
        ("own_rewards:constant", "'own_rewards' has no function 'constant'"),
        ("no_such_module:hop", "--reward cannot import 'no_such_module': No module named"),
        ("broken_rewards:hop", "--reward cannot import 'broken_rewards': ZeroDivisionError"),
        ("own_rewards:walk", "walker has a task 'walk' already; give the function own_rewards:walk another name."),
        ("own_rewards:Upper", "the function 'Upper' cannot name a task"),
        ("os;rm -rf:x", "--reward takes module:function"),
    ],
)
def test_what_is_no_reward_function_is_refused_in_one_line(reference: str, message: str, place: Path, smoke: Path, cli: Callable) -> None:
    before = sorted(smoke.rglob("*"))
    done = cli("relabel", "walker/cudc-smoke-v0", "--reward", reference)
    assert (done.code, done.out, len(done.err.splitlines())) == (2, "", 1), done.err
    assert message in done.err
    assert sorted(smoke.rglob("*")) == before


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("wrong_name", r"walker measures no 'torso_hight'; a reward sees: torso_height, .*, observation. Did you mean 'torso_height'\?"),
        ("wrong_shape", r"the reward function own_rewards:wrong_shape returned shape \(3,\) for \d+ steps"),
        ("not_a_number", r"own_rewards:not_a_number returned numbers that are not finite in float32; first at row 0 \(nan\)."),
        ("too_large", r"own_rewards:too_large returned numbers that are not finite in float32; first at row 7 \(1e\+300\)."),
        ("not_real", "own_rewards:not_real returned complex128; return real numbers."),
        ("fails", "own_rewards:fails failed: ZeroDivisionError: division by zero."),
    ],
)
def test_a_function_that_fails_is_one_line_and_leaves_nothing(name: str, message: str, place: Path, smoke: Path) -> None:
    with pytest.raises(RunError, match=message):
        cudc_bench.relabel("walker/cudc-smoke-v0", reward=f"own_rewards:{name}")
    assert not (smoke / "walker" / name).exists()


@pytest.mark.parametrize("name", DOMAINS)
def test_every_quantity_of_a_domain_is_measured_under_its_name(name: str) -> None:
    domain, (simulator,) = DOMAINS[name], make_simulators(name, 1)
    simulator.reset(0)
    quantities = np.empty(len(domain.quantities))
    simulator.quantities(quantities)
    measured = Measured(domain, quantities[None], np.zeros((1, 2)), np.zeros((1, 3)), np.zeros((1, 4)))
    assert list(measured) == [*domain.quantities, "physics", "action", "observation"]
    assert [float(measured[one][0]) for one in domain.quantities] == quantities.tolist()


def test_with_tasks_it_is_refused(smoke: Path, place: Path) -> None:
    with pytest.raises(UsageError, match="--reward makes a task of its own; leave out --tasks"):
        cudc_bench.relabel("walker/cudc-smoke-v0", ["walk"], reward="own_rewards:hop")
    with pytest.raises(UsageError, match="is labelled for walk, not by own_rewards:hop; leave out --reward"):
        cudc_bench.evaluate("td3", dataset_id="walker/walk/cudc-smoke-v0", reward="own_rewards:hop", profile="smoke")


def test_the_card_and_the_metadata_name_it(smoke: Path, place: Path) -> None:
    cudc_bench.relabel("walker/cudc-smoke-v0", reward="own_rewards:hop")
    metadata = json.loads((smoke / "walker/hop/cudc-smoke-v0/data/metadata.json").read_text())
    spec = json.loads(metadata["env_spec"])
    assert spec["kwargs"] == {"domain": "walker", "reward": "own_rewards:hop"}
    assert "own_rewards:hop" in metadata["description"]
