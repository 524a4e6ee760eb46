"""The tests that every offline algorithm passes, third parties' included; the only module of this folder that needs pytest.

A package with an algorithm of its own runs them on it from its own tests::

    from cudc_bench.evaluators.contract import EvaluatorContract


    class TestMine(EvaluatorContract):
        algorithm = "mine"

(:class:`ZeroShotContract` for one that trains without rewards.)
They prove what the evaluation loop promises for an algorithm: sizes in every domain, actions in [-1, 1], repeatable runs, members that
never see each other, states that can be saved and restored, runs that end the same when they are stopped in their middle, and policies
that can be kept. Nothing is proved about an algorithm's mathematics: that takes an independent version of its losses, for which ``make``
and ``batch_for`` give small stacks and batches.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch

from cudc_bench import plugins
from cudc_bench.envs import DOMAINS, make_simulators, reward_function
from cudc_bench.envs.simulator import Float32
from cudc_bench.execution.checkpoints import Checkpoints, digest
from cudc_bench.learning.cpu_graphs import RecordedGraph
from cudc_bench.learning.cuda_graphs import WARM_UP, Graph, Updater
from cudc_bench.learning.networks import MemberRandom
from cudc_bench.learning.replay import Batch, Episodes
from cudc_bench.settings.evaluate_config import EvaluateConfig

from .running.loop import Arena, Outcome, run_evaluation
from .zero_shot import Labelled

SMALL = {"width": 16, "batch_size": 32, "learning_rate": 1e-3}
# What is proved about the loop is the same for episodes of any length.
BRIEF = replace(DOMAINS["walker"], episode_length=20)


def make(name: str = "td3", seeds: Sequence[int] = (1,), observation: int = 24, action: int = 6, **settings: Any) -> Any:
    """A registered algorithm at a small size.

    Args:
        name: under which it is registered.
        seeds: one for each member.
        observation, action: sizes; Walker's without them.
        settings: hyperparameters that differ from ``SMALL`` and the algorithm's defaults.
    """
    kind = plugins.load("evaluators", name)
    return kind(observation, action, kind.configure(SMALL, settings), list(seeds))


def batch_for(agent: Any, observation: int = 24, action: int = 6, size: int = 32, seed: int = 0, measure: bool = False) -> Batch:
    """Random labelled one-step transitions; every member gets other ones, member e those of ``seed + 1000 e``."""
    parts = []
    for member in range(len(agent.seeds)):
        g = torch.Generator().manual_seed(seed + 1000 * member)
        parts.append(
            (
                torch.randn(size, observation, generator=g),
                torch.rand(size, action, generator=g) * 2 - 1,
                torch.randn(size, observation, generator=g),
                torch.rand(size, generator=g),
                torch.rand(size, action, generator=g) * 2 - 1,
                torch.randn(size, observation, generator=g),
                torch.randn(size, observation, generator=g),
            )
        )
    s, a, following, r, a_next, later, other = (torch.stack(values) for values in zip(*parts, strict=True))
    return Batch(
        s, a, following, torch.ones(len(agent.seeds), dtype=torch.int64), r, measure, next_action=a_next, future_observation=later,
        other_observation=other,
    )  # fmt: skip


def labelled_for(agent: Any, tasks: int = 2, observation: int = 24, action: int = 6, size: int = 200, seed: int = 0) -> Labelled:
    """The transitions of :func:`batch_for` with random rewards, of which one in ten is not zero, in some tasks."""
    batch = batch_for(agent, observation, action, size, seed)
    g = torch.Generator().manual_seed(seed)
    draws = torch.rand(2, len(agent.seeds), tasks, size, generator=g)
    return Labelled(batch.observation, batch.action, batch.next_observation, draws[0] * (draws[1] < 0.1))


def rows_of(batch: Batch, first: int) -> Batch:
    """A batch of the members from ``first`` on alone."""
    own: dict[str, Any] = {key: value[first:] if isinstance(value, torch.Tensor) else value for key, value in vars(batch).items()}
    return Batch(**own | {"cache": {}})


def low_variety(batch: Batch, scale: float, kinds: int = 6) -> Batch:
    """A batch of a few transitions only, each many times; the first member's observations and rewards are ``scale`` times as large."""
    rows, factor = torch.arange(batch.observation.shape[1]) % kinds, torch.ones(len(batch.observation), 1, 1)
    factor[0] = scale
    few = copy.copy(batch)
    for name in ("observation", "next_observation", "future_observation", "other_observation"):
        setattr(few, name, getattr(batch, name)[:, rows] * factor)
    for name in ("action", "next_action"):
        setattr(few, name, getattr(batch, name)[:, rows])
    assert batch.reward is not None
    few.reward = batch.reward[:, rows] * factor[..., 0]
    return few


@cache
def _random_walker(episodes: int) -> list[tuple[torch.Tensor, torch.Tensor, Float32]]:
    """Observations (T+1, S), actions (T, A) and the rewards of all tasks (T, N) of episodes of uniformly random actions on Walker."""
    simulator, rewards = make_simulators("walker", 1)[0], reward_function("walker")
    rng = np.random.default_rng(0)
    found = []
    for episode in range(episodes):
        observations = np.empty((1001, 24), np.float32)
        actions = rng.uniform(-1, 1, (1000, 6)).astype(np.float32)
        quantities = np.empty((1000, 4))
        simulator.reset(episode)
        simulator.observe(observations[0])
        for t, action in enumerate(actions):
            simulator.step(action)
            simulator.observe(observations[t + 1])
            simulator.quantities(quantities[t])
        found.append((torch.from_numpy(observations), torch.from_numpy(actions), rewards(quantities).astype(np.float32)))
    return found


def random_walker_data(episodes: int, task: str, seeds: Sequence[int]) -> Episodes:
    """Episodes of uniformly random actions on Walker, labelled with the live rewards of a task, for a stack of members."""
    data = Episodes(1, episodes, episodes * 1000, 24, 6, MemberRandom(seeds, "replay"), [0] * len(seeds))
    labels, column = [], DOMAINS["walker"].tasks.index(task)
    for observations, actions, rewards in _random_walker(episodes):
        data.add(0, observations, actions)
        labels.append(torch.from_numpy(rewards[:, column]))
    data.rewards = torch.cat(labels).expand(len(seeds), -1).contiguous()
    return data


def _differs(key: str, step: int) -> Callable[[str], str]:
    """What is wrong with a metric that is another one in a stack of two than alone."""
    return lambda text: (
        f"update {step} measured another '{key}' in a stack of two than alone: what is computed for a member must come from that member's "
        f"rows (reduce over dimension 1 of (E, B), never over dimension 0). {text}"
    )


# What the failures of several tests say that was expected.
STATE = (
    "an algorithm's state that changes in update must be a registered buffer or parameter, or lie in self.optimisers or self.random, from "
    "where all random numbers must come, so that state_dict holds it"
)
IN_PLACE = (
    "a tensor of the algorithm was replaced by a new one in update; change it in place (copy_, add_), as a graph would use the old one"
)
REPLAYED = (
    "as a graph, the update does something else than as it is written: what Python decides (counts, branches) belongs in prepare, "
    "all else must follow from tensors that are changed in place; or say replayable = False"
)


class Stopped(Exception):
    """Ends a run in its middle."""


class EvaluatorContract:
    """One battery for one registered algorithm: subclass it under a name that starts with Test, and say its ``algorithm``.

    Class attributes:
        algorithm: the name under which it is registered.
    """

    algorithm: ClassVar[str]

    @pytest.fixture
    def name(self) -> str:
        """The registered name of the algorithm under test."""
        return self.algorithm

    @pytest.fixture(autouse=True)
    def one_thread(self) -> Iterator[None]:
        """Matrices this small take many times as long on several threads, which wait for each other."""
        before = torch.get_num_threads()
        torch.set_num_threads(1)
        yield
        torch.set_num_threads(before)

    @pytest.mark.parametrize("domain", list(DOMAINS))
    @pytest.mark.parametrize("members", [1, 3])
    def test_builds_updates_and_acts_in_every_domain(self, name: str, domain: str, members: int) -> None:
        sizes = (DOMAINS[domain].observation_size, DOMAINS[domain].action_size)
        agent = make(name, range(members), *sizes)
        # Some move their actors in every second update only.
        metrics = agent.update(batch_for(agent, *sizes, measure=True)) | agent.update(batch_for(agent, *sizes, measure=True))
        assert metrics, "update must measure something when batch.measure is set"
        for key, value in metrics.items():
            assert value.shape == (members,), f"'{key}' has shape {tuple(value.shape)}; a metric is a number for each member, ({members},)"
            assert torch.isfinite(value).all(), f"'{key}' is {value.tolist()}; metrics must be finite"
        found = agent.update(batch_for(agent, *sizes))
        assert found == {}, f"update measured {', '.join(found)} though batch.measure is not set, and would wait for the device each time"
        actions = agent.act(torch.randn(members, 5, sizes[0]) * 3)
        expected = (members, 5, sizes[1])
        assert actions.shape == expected, (
            f"act gives {tuple(actions.shape)}; an action for each of 5 observations of each member is {expected}"
        )
        assert actions.abs().max() <= 1, f"act gives {actions.abs().max():.3g}; actions must be within [-1, 1] (tanh, clamp)"

    def test_says_what_it_is(self, name: str) -> None:
        kind = plugins.load("evaluators", name)
        for attribute in ("citation", "summary"):
            assert isinstance(getattr(kind, attribute, None), str), f"the class must say its {attribute}, a text, for lists and tables"
        parameters = getattr(kind.config_class, "__dataclass_params__", None)
        # A record states the hyperparameters, so nothing may change them on the way.
        assert parameters is not None and parameters.frozen, "config_class must be a dataclass(frozen=True)"  # noqa: PT018

    def test_acts_deterministically_and_as_its_policy_does(self, name: str) -> None:
        agent = make(name, (1, 2))
        observation = torch.randn(2, 4, 24)
        first, second, own = agent.act(observation), agent.act(observation), agent.policy(observation)
        assert torch.equal(first, second), "act gave two answers to one observation; it must be deterministic"
        assert torch.equal(first, own), "act and policy give other actions; what is evaluated must be what is kept"
        # One member's part of every parameter is that member's policy.
        weights = {key: value[1:] for key, value in agent.policy.state_dict().items()}
        alone = copy.deepcopy(make(name, (7,)).policy)
        alone.load_state_dict(weights)
        torch.testing.assert_close(alone(observation[1:]), agent.act(observation)[1:])

    def test_a_restored_state_continues_identically(self, name: str) -> None:
        first = make(name, (1, 2))
        for step in range(3):
            first.update(batch_for(first, seed=step))
        second = make(name, (1, 2))
        second.load_state_dict(copy.deepcopy(first.state_dict()))
        for step in range(3, 6):
            metrics = [agent.update(batch_for(agent, seed=step, measure=True)) for agent in (first, second)]
            for key, value in metrics[0].items():
                assert torch.equal(value, metrics[1][key]), f"restored, an update measured another '{key}': {STATE}"
        observation = torch.randn(2, 4, 24)
        assert torch.equal(first.act(observation), second.act(observation)), f"restored, it acts otherwise: {STATE}"

    def test_members_learn_together_as_they_do_alone(self, name: str) -> None:
        """In what they measure (their own losses) at every update, and in how they act; first on plain data, then on data of little
        variety, on which what one member has in common with another is most of what there is."""
        together, alone = make(name, (5, 6)), make(name, (6,))
        for step in range(14):
            batch = batch_for(together, seed=step, measure=True)
            if step >= 6:
                # What is drawn from all members, such as a maximum or a mean, is now the first one's, or the second one's.
                batch = low_variety(batch, (0.1, 10.0)[step % 2])
            metrics = together.update(batch)
            for key, value in alone.update(rows_of(batch, 1)).items():
                torch.testing.assert_close(
                    metrics[key][1:], value, atol=2e-4, rtol=2e-3,
                    msg=_differs(key, step),
                )  # fmt: skip
            if step == 5:
                self._check_same_actions(together, alone)

    def _check_same_actions(self, together: Any, alone: Any) -> None:
        observation = torch.randn(1, 4, 24)
        pair = together.act(observation.expand(2, -1, -1))
        torch.testing.assert_close(
            pair[1:], alone.act(observation), atol=1e-4, rtol=1e-4,
            msg=lambda text: f"a member of a stack of two acts otherwise than alone: members must never see each other. {text}",
        )  # fmt: skip
        assert not torch.allclose(pair[0], pair[1]), "members with different seeds act the same: each must draw from its own seed's streams"

    @pytest.mark.parametrize("action", [6, 1])
    def test_a_member_of_an_exact_stack_is_the_same_to_the_last_bit_as_alone(self, name: str, action: int) -> None:
        """At a size that is used: small matrices are the work of other kernels."""
        if not plugins.load("evaluators", name).stacks_exactly:
            pytest.skip("its members are alone on a CPU")
        sizes = {"action": action, "width": 128, "batch_size": 128}
        together, alone = make(name, (5, 6, 7), **sizes), make(name, (7,), **sizes)
        for step in range(6):
            batch = batch_for(together, action=action, size=128, seed=step)
            together.update(batch)
            alone.update(rows_of(batch, 2))
        state = alone.state_dict()
        for key, value in together.state_dict()["networks"].items():
            same = torch.equal(value.chunk(3)[2], state["networks"][key])
            assert same, f"{key} is not what it is alone: use the layers and optimisers of cudc_bench.learning, or stacks_exactly = False"
        for rows in (4, 1):
            observation = torch.randn(3, rows, 24)
            assert torch.equal(together.act(observation)[2:], alone.act(observation[2:]))

    def test_a_graph_of_its_update_does_what_the_update_does(self, name: str) -> None:
        """As on CUDA: nothing but tensors that stay where they are decides what an update does, and it waits for none of them."""
        if not getattr(make(name), "replayable", False):
            pytest.skip("its updates are not replayed")

        def run(graph: type[Graph] | None) -> tuple[str, list[str]]:
            agent = make(name, (1, 2))
            random = MemberRandom((1, 2), "replay")
            data = Episodes(1, 3, 120, 24, 6, random, [0, 0])
            g = torch.Generator().manual_seed(0)
            for _ in range(3):
                data.add(0, torch.randn(41, 24, generator=g), torch.rand(40, 6, generator=g))
            data.rewards = torch.rand(2, 120, generator=g)
            horizon = torch.ones(2, dtype=torch.int64)
            updates = Updater(
                agent, lambda m: data.sample(32, horizon, m, next_action=agent.wants_next_action, future=agent.wants_future), random, graph
            )
            seen: list[str] = []
            places: list[list[int]] = []
            # Some move their actors in every second update only: two plans.
            for step in range(2 * WARM_UP + 8):
                metrics, batch = updates(measure=step == 2 * WARM_UP + 4)
                # A tensor that was replaced would be the old one to a graph, whether its value has changed by now or not.
                places.append([tensor.data_ptr() for tensor in (*agent.parameters(), *agent.buffers())])
                seen.append(digest([batch.observation.clone(), agent.act(torch.ones(2, 1, 24)), *metrics.values()]))
            assert all(one == places[0] for one in places), IN_PLACE
            return digest(agent.state_dict()), seen

        assert run(RecordedGraph) == run(None), REPLAYED

    def test_the_loop_evaluates_at_zero_at_every_interval_and_at_the_end(self, name: str) -> None:
        agent = make(name, (1, 2))
        config = EvaluateConfig(gradient_steps=25, evaluate_every=10, evaluation_episodes=2, final_episodes=3, milestones=(10, 25))
        data = random_walker_data(1, "stand", (1, 2))
        told: list[int] = []
        outcomes = run_evaluation(agent, data, config, Arena(BRIEF, ["stand", "walk"]), told.append)
        assert sum(told) == 25
        for outcome in outcomes:
            assert [step for step, _ in outcome.curve] == [0, 10, 20, 25]
            assert all(len(returns) == 2 for _, returns in outcome.curve)
            assert [(step, len(returns)) for step, returns in outcome.finals] == [(10, 3), (20, 3), (25, 3)]
            assert [step for step, _ in outcome.metrics] == [10, 20, 25]
        # Standing is part of walking: at the same states the walk's reward is never larger.
        assert outcomes[0].curve != outcomes[1].curve

    def test_a_run_is_repeated_exactly(self, name: str) -> None:
        config = EvaluateConfig(gradient_steps=20, evaluate_every=10, evaluation_episodes=1, final_episodes=1, milestones=(10, 20))
        data = [random_walker_data(1, "stand", (3,)) for _ in range(2)]
        first, second = (run_evaluation(make(name, (3,)), d, config, Arena(BRIEF, ["stand"]), lambda n: None) for d in data)
        assert first == second, f"two runs with one seed ended otherwise: {STATE}"

    def test_a_run_that_was_stopped_ends_as_if_it_had_not_been(self, name: str, tmp_path: Path) -> None:
        config = EvaluateConfig(gradient_steps=15, evaluate_every=6, evaluation_episodes=1, final_episodes=2, milestones=(6, 15))

        arena = Arena(BRIEF, ["stand", "walk"])

        def run(checkpoints: Checkpoints | None, agent: Any) -> list[Outcome]:
            return run_evaluation(agent, random_walker_data(1, "stand", (3, 4)), config, arena, lambda n: None, (), checkpoints)

        whole = run(None, make(name, (3, 4)))
        for stop in (5, 12):
            agent = make(name, (3, 4))
            update, count = agent.update, [0]

            def stopping(
                batch: Batch, update: Callable[[Batch], dict[str, torch.Tensor]] = update, count: list[int] = count, stop: int = stop
            ) -> dict[str, torch.Tensor]:
                if count[0] == stop:
                    raise Stopped
                count[0] += 1
                return update(batch)

            agent.update = stopping
            folder = tmp_path / str(stop)
            with pytest.raises(Stopped):
                run(Checkpoints(folder, {"name": name}, every=0.0), agent)
            again = Checkpoints(folder, {"name": name}, every=0.0)
            assert again.load(lambda step, state: None) == stop
            assert run(again, make(name, (3, 4))) == whole, f"a run that was stopped and continued ended otherwise: {STATE}"


class ZeroShotContract(EvaluatorContract):
    """The battery for an algorithm that trains without rewards (:class:`~cudc_bench.evaluators.zero_shot.ZeroShotLearner`): the one of
    every algorithm, and what the evaluation promises of tasks."""

    def trained(self, name: str, seeds: Sequence[int] = (5, 6)) -> Any:
        """A small stack after a few updates."""
        agent = make(name, seeds)
        for step in range(3):
            agent.update(batch_for(agent, seed=step))
        return agent

    def test_says_how_it_infers(self, name: str) -> None:
        rule = getattr(plugins.load("evaluators", name), "rule", None)
        assert isinstance(rule, str), "the class must say its rule, how z follows from labelled transitions, for records"

    def test_trains_without_rewards(self, name: str) -> None:
        agents = [make(name, (1, 2)) for _ in range(2)]
        batches = [batch_for(agent) for agent in agents]
        batches[1].reward = None
        for agent, batch in zip(agents, batches, strict=True):
            agent.update(batch)
        first, second = (digest(agent.state_dict()) for agent in agents)
        assert first == second, "an update read rewards; those of a task are for infer alone"

    def test_infers_the_vectors_of_tasks(self, name: str) -> None:
        agent = self.trained(name)
        labelled = labelled_for(agent, tasks=3)
        before = digest(agent.state_dict())
        z = agent.infer(labelled)
        assert digest(agent.state_dict()) == before, "infer changed the algorithm's state; evaluations must leave no trace"
        assert not z.requires_grad, "infer must not keep gradients"
        d = agent.config.z_dim
        assert z.shape == (2, 3, d), f"infer gives {tuple(z.shape)}; a vector for each of 3 tasks of 2 members is (2, 3, {d})"
        torch.testing.assert_close(z.norm(dim=-1), torch.full((2, 3), d**0.5), msg=lambda text: f"z must have the length √d. {text}")
        assert torch.equal(z, agent.infer(labelled)), "infer gave two answers to one question; it must be deterministic"
        assert not torch.allclose(z[:, 0], z[:, 1]), "tasks with different rewards have the same z"

    def test_a_task_without_any_reward_is_the_zero_vector(self, name: str) -> None:
        agent = self.trained(name)
        labelled = labelled_for(agent)
        labelled.reward[:, 1] = 0.0
        z = agent.infer(labelled)
        assert torch.equal(z[:, 1], torch.zeros_like(z[:, 1])), "z of rewards that are all zero must be zero, and no division by its length"
        assert torch.isfinite(z).all()

    def test_a_task_follows_from_its_own_rewards_alone(self, name: str) -> None:
        agent = self.trained(name)
        labelled = labelled_for(agent, tasks=3)
        whole = agent.infer(labelled)
        for task in range(3):
            alone = agent.infer(replace(labelled, reward=labelled.reward[:, task : task + 1]))
            torch.testing.assert_close(
                whole[:, task : task + 1], alone, atol=1e-3, rtol=1e-3,
                msg=lambda text: f"z of a task beside others is not what it is alone. {text}",
            )  # fmt: skip

    def test_members_infer_together_as_they_do_alone(self, name: str) -> None:
        agent, alone = make(name, (5, 6)), make(name, (6,))
        labelled = labelled_for(agent)
        labelled.observation[0] *= 10.0
        labelled.next_observation[0] *= 10.0
        labelled.reward[0] *= 10.0
        own = Labelled(**{key: value[1:] for key, value in vars(labelled).items()})
        torch.testing.assert_close(
            agent.infer(labelled)[1:], alone.infer(own), atol=1e-3, rtol=1e-3,
            msg=lambda text: f"a member of a stack of two infers another z than alone: members must never see each other. {text}",
        )  # fmt: skip

    def test_a_tasks_policy_is_what_acts_for_it(self, name: str) -> None:
        agent = self.trained(name)
        z, observation = agent.infer(labelled_for(agent)), torch.randn(2, 5, 24)
        actions = []
        for task in (0, 1):
            policy = agent.policy_for(z[:, task])
            with torch.no_grad():
                own = policy(observation)
            expected = agent.act_for(observation, z[:, task, None].expand(-1, 5, -1))
            assert torch.equal(own, expected), "act_for and policy_for give other actions; what is evaluated must be what is kept"
            # The file of a task holds all that its policy is.
            other = self.trained(name, (8, 9)).policy
            other.load_state_dict(policy.state_dict())
            with torch.no_grad():
                assert torch.equal(other(observation), own), "the state of policy_for does not restore it; z must be one of its buffers"
            actions.append(own)
        assert actions[0].abs().max() <= 1
        assert not torch.equal(*actions), "it acts the same whatever z is"
        nothing = agent.policy_for(torch.zeros_like(z[:, 0]))
        assert torch.equal(nothing(observation), agent.act(observation)), "policy must be the one of the zero vector"
