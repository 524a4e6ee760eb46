"""Training on a task itself: what is stored is what the environment did, the actions are the policy's with noise, and it learns."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

from cudc_bench.data.writer import Episode, EpisodeShards
from cudc_bench.envs import DOMAINS, Domain
from cudc_bench.evaluators.running import loop, online
from cudc_bench.evaluators.running.loop import Arena, Outcome
from cudc_bench.evaluators.running.online import run_online
from cudc_bench.execution import interrupts
from cudc_bench.execution.checkpoints import Checkpoints, digest
from cudc_bench.learning.replay import Batch
from cudc_bench.runs import interaction
from cudc_bench.settings.evaluate_config import OnlineConfig

from .helpers import make

WALKER = DOMAINS["walker"]


class Kept:
    """Keeps the episodes of one member."""

    def __init__(self) -> None:
        self.all: list[Episode] = []

    def add(self, episode: Episode) -> None:
        infos = {name: array.copy() for name, array in episode.infos.items()}
        assert episode.rewards is not None
        self.all.append(Episode(episode.seed, episode.observations.copy(), episode.actions.copy(), infos, episode.rewards.copy()))


def short(**changes: Any) -> OnlineConfig:
    values = {"steps": 2300, "seed_steps": 900, "update_every": 100, "evaluations": 2, "evaluation_episodes": 1, "final_episodes": 1}
    return OnlineConfig(**values | changes)


def train(agent: Any, tasks: list[str], config: OnlineConfig) -> tuple[list[Outcome], list[Kept]]:
    sinks = [Kept() for _ in tasks]
    told: list[int] = []
    outcomes = run_online(agent, config, WALKER, tasks, Arena(WALKER, tasks), told.append, sinks)
    assert sum(told) == config.steps
    return outcomes, sinks


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def test_episodes_are_what_the_tasks_environment_does_with_their_actions() -> None:
    """Each member's rewards are those of its own task, as Gymnasium's environment gives them."""
    tasks = ["stand", "run"]
    _, sinks = train(make("td3", (1, 2)), tasks, short())
    for task, sink in zip(tasks, sinks, strict=True):
        assert [len(episode.actions) for episode in sink.all] == [1000, 1000, 300]
        env = gymnasium.make(f"cudc_bench/walker-{task}-v0")
        for episode in sink.all:
            first, _ = env.reset(seed=episode.seed)
            assert np.array_equal(first, episode.observations[0])
            assert episode.infos["physics"].shape == (len(episode.actions) + 1, WALKER.physics_size)
            for t, action in enumerate(episode.actions[:300]):
                observation, reward, *_ = env.step(action)
                assert np.array_equal(observation, episode.observations[t + 1])
                assert np.float32(reward) == episode.rewards[t]


def test_it_learns_from_transitions_of_whole_episodes_one_step_long() -> None:
    agent = make("td3", (1, 2))
    batches: list[Batch] = []
    update = agent.update
    agent.update = lambda batch: (batches.append(batch), update(batch))[1]
    _, sinks = train(agent, ["stand", "walk"], short())
    # From the end of the first episode on, an update at every hundredth step.
    assert len(batches) == 13
    for member, sink in enumerate(sinks):
        there: dict[bytes, tuple[bytes, bytes, float]] = {}
        for episode in sink.all[:2]:
            for t, action in enumerate(episode.actions):
                seen, following = episode.observations[t], episode.observations[t + 1]
                there[seen.tobytes()] = (action.tobytes(), following.tobytes(), float(episode.rewards[t]))
        for batch in batches:
            for row in range(batch.action.shape[1]):
                found = there[batch.observation[member, row].numpy().tobytes()]
                drawn = (batch.action[member, row].numpy().tobytes(), batch.next_observation[member, row].numpy().tobytes())
                assert (*drawn, float(batch.reward[member, row])) == found


def test_it_acts_at_random_first_and_then_as_its_policy_does_with_gaussian_noise() -> None:
    agent = make("td3", (5,))
    # No episode is whole before the end, so that the policy stays what it is.
    _, (sink,) = train(agent, ["stand"], short(steps=1000, seed_steps=400))
    actions = sink.all[0].actions
    for quantile in (0.1, 0.5, 0.9):
        assert np.quantile(actions[:400], quantile) == pytest.approx(2 * quantile - 1, abs=0.06)
    with torch.no_grad():
        means = agent.policy(torch.from_numpy(sink.all[0].observations[400:1000])[None])[0].numpy()
    assert np.abs(actions[400:]).max() <= 1 - 1e-6 + 1e-9
    # Where the clamp is far away, which leaves the noise as it is.
    noise = (actions[400:] - means)[np.abs(means) < 0.1]
    assert len(noise) > 500
    assert noise.mean() == pytest.approx(0, abs=0.025)
    assert noise.std() == pytest.approx(0.2, abs=0.015)
    _, (still,) = train(make("td3", (5,)), ["stand"], short(steps=1000, seed_steps=400, exploration_std=0.0))
    with torch.no_grad():
        means = agent.policy(torch.from_numpy(still.all[0].observations[400:1000])[None])[0].numpy()
    np.testing.assert_allclose(still.all[0].actions[400:], means.clip(-1 + 1e-6, 1 - 1e-6), atol=1e-6)


class PointMass:
    """A point on a square, moved by at most 0.05 a step; a walk at random hardly leaves the middle."""

    def reset(self, seed: int) -> None:
        self.place = np.zeros(2)

    def step(self, action: np.ndarray) -> None:
        self.place = np.clip(self.place + 0.05 * action, -1, 1)

    def observe(self, out: np.ndarray) -> None:
        out[:] = self.place

    def state(self, out: np.ndarray) -> None:
        out[:] = self.place

    def quantities(self, out: np.ndarray) -> None:
        out[:] = self.place


def corner(quantities: np.ndarray) -> np.ndarray:
    """The reward of being near one corner."""
    return np.exp(-4 * np.square(quantities - 0.7).sum(-1))[..., None]


@pytest.fixture
def square(monkeypatch: pytest.MonkeyPatch) -> Domain:
    """A domain of such points, whose one task is to be near a corner; its episodes have 50 steps."""
    make_points: Callable[[str, int], list[PointMass]] = lambda domain, count: [PointMass() for _ in range(count)]  # noqa: E731
    for module in (interaction, loop):
        monkeypatch.setattr(module, "make_simulators", make_points)
    for module in (online, loop):
        monkeypatch.setattr(module, "reward_function", lambda domain: corner)
    return Domain("square", ("corner",), 2, 2, 2, 50, 50.0, ("x", "y"), "", "", "")


def test_it_is_evaluated_at_equal_distances_and_says_what_the_last_update_measured(square: Domain) -> None:
    config = short(steps=230, seed_steps=90, update_every=10, evaluations=3, evaluation_episodes=2, final_episodes=3)
    (outcome,) = run_online(make("td3", (1,), 2, 2), config, square, ["corner"], Arena(square, ["corner"]), lambda n: None)
    assert [step for step, _ in outcome.curve] == [0, 76, 153, 230]
    assert all(len(returns) == 2 for _, returns in outcome.curve)
    assert [(step, len(returns)) for step, returns in outcome.finals] == [(230, 3)]
    # At 76 nothing had been learnt yet.
    assert [step for step, _ in outcome.metrics] == [153, 230]
    assert {"critic_loss", "actor_loss", "q"} <= set(outcome.metrics[0][1])


class Storing(EpisodeShards):
    """Shards that ask the process to leave when they get an episode of some number."""

    ask_at = 0

    def add(self, episode: Episode) -> None:
        super().add(episode)
        Storing.ask_at -= 1
        if Storing.ask_at == 0:
            interrupts.request_stop()


def resumable(folder: Path, square: Domain) -> tuple[str, list[Outcome], str]:
    """A run in a folder: hashes of its agent and of all its episodes, and what came out."""
    agent, tasks = make("td3", (3, 4), 2, 2), ["corner", "corner"]
    stores = [Storing(folder / f"{member}") for member in range(2)]
    config = short(steps=220, seed_steps=60, update_every=5)
    with interrupts.leaving_gracefully():
        outcomes = run_online(
            agent, config, square, tasks, Arena(square, tasks), lambda n: None, stores, (), Checkpoints(folder, {}, every=0.0)
        )
    episodes = [[(one.seed, one.observations.tobytes(), one.actions.tobytes(), one.rewards.tobytes()) for one in store] for store in stores]
    assert [len(member) for member in episodes] == [5, 5]
    return digest(agent.state_dict()), outcomes, digest(episodes)


# Before and after there is something to learn from, at the end of an episode, in an evaluation on the way, and in the final one.
@pytest.mark.parametrize(
    ("what", "at", "said"), [("step", 45, 45), ("step", 178, 178), ("step", 100, 100), ("try", 75, 110), ("try", 160, 220)]
)
def test_a_run_that_was_interrupted_ends_as_if_it_had_not_been(
    what: str, at: int, said: int, tmp_path: Path, square: Domain, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = resumable(tmp_path / "whole", square)
    count = [0]

    def asking(method: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            count[0] += 1
            if count[0] == at:
                interrupts.request_stop()
            return method(*arguments)

        return call

    with monkeypatch.context() as patch:
        if what == "step":
            patch.setattr(online._Run, "step", asking(online._Run.step))
        else:
            patch.setattr(loop, "check_actions", asking(loop.check_actions))
        with pytest.raises(interrupts.Interrupted, match=f"at step {said:,} of 220"):
            resumable(tmp_path / "stopped", square)
    assert resumable(tmp_path / "stopped", square) == whole


@pytest.mark.parametrize("damaged", ["checkpoint", "shard", "all"])
def test_a_run_whose_newest_state_is_damaged_goes_on_from_one_before(
    damaged: str, tmp_path: Path, square: Domain, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = resumable(tmp_path / "whole", square)
    folder = tmp_path / "stopped"
    Storing.ask_at = 6  # at the end of the third episode of the second member
    with pytest.raises(interrupts.Interrupted, match="at step 150 of 220"):
        resumable(folder, square)
    kept = sorted(folder.glob("*.pt"))
    assert [int(path.stem) for path in kept] == [100, 150]
    # Without its first shard the second member cannot go back to any state; the first one could.
    hit = {"checkpoint": kept[-1], "shard": max((folder / "0").iterdir()), "all": min((folder / "1").iterdir())}[damaged]
    hit.write_bytes(hit.read_bytes()[:-100])
    capsys.readouterr()
    assert resumable(folder, square) == whole
    assert ("the run starts over" in capsys.readouterr().err) == (damaged == "all")


def test_td3_finds_a_corner_that_it_is_rewarded_for(square: Domain) -> None:
    config = OnlineConfig(steps=2_000, seed_steps=500, update_every=2, evaluations=1, evaluation_episodes=1, final_episodes=1)
    agent = make("td3", (1,), 2, 2, width=32, batch_size=64, learning_rate=3e-3, discount=0.9)
    (outcome,) = run_online(agent, config, square, ["corner"], Arena(square, ["corner"]), lambda n: None)
    # Straight there and then at rest it would get about 38 of 50; at rest in the middle 1.
    assert outcome.curve[0][1][0] < 5
    assert outcome.finals[0][1][0] > 20
