"""The tests that every collector passes, third parties' included; the only module of this folder that needs pytest.

A package with a collector of its own runs them on it from its own tests::

    from cudc_bench.collectors.contract import CollectorContract


    class TestRE3(CollectorContract):
        method = "re3"

They prove what the collection loop and the manifest promise for a method: sizes in every domain, actions in [-1, 1], repeatable runs,
members that never see each other, states that can be saved and restored, no use of any reward of the environment, skills stored
beside the actions that followed them, and a representation that does not collapse. Methods with skills are expected to be ``DDPG``s.
Nothing is proved about a method's mathematics: that takes an independent version of its losses and rewards, for which ``make`` and
``batch_for`` give small stacks and batches.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from torch import Tensor

from cudc_bench import plugins
from cudc_bench.data.diagnostics import DIAGNOSTICS
from cudc_bench.envs import DOMAINS
from cudc_bench.envs.simulator import Float32, Float64
from cudc_bench.execution import interrupts
from cudc_bench.execution.checkpoints import Checkpoints, digest
from cudc_bench.execution.runlog import open_log
from cudc_bench.learning.cpu_graphs import RecordedGraph
from cudc_bench.learning.cuda_graphs import WARM_UP, Graph, Updater
from cudc_bench.learning.networks import MemberRandom
from cudc_bench.learning.replay import Batch, Episodes
from cudc_bench.settings.collect_config import CollectConfig
from cudc_bench.settings.described import CATEGORIES

from .base import Collector, Sizes
from .ddpg import DDPG
from .representation import effective_rank, spread
from .running.dataset_sink import DatasetSink
from .running.loop import run_collection

_FUTURES = ("future_observation", "other_observation")
SMALL = {"width": 16, "batch_size": 32, "feature_dim": 12, "learning_rate": 1e-3}
SPACES = {
    name: Sizes(name, domain.observation_size, domain.action_size, domain.episode_length, seed_steps=4000, update_every=2)
    for name, domain in DOMAINS.items()
}
# What is proved about the loop is the same for episodes of any length in which skills change.
BRIEF = replace(DOMAINS["walker"], episode_length=250)
_BRIEF_SIZES = replace(SPACES["walker"], episode_length=BRIEF.episode_length)


def make(name: str = "cudc", seeds: Sequence[int] = (1,), sizes: Sizes | None = None, **settings: Any) -> Any:
    """A registered collector at a small size.

    Args:
        name: under which it is registered.
        seeds: one for each member.
        sizes: what it is built for; Walker without it.
        settings: hyperparameters that differ from ``SMALL`` and the method's defaults.
    """
    kind = plugins.load("collectors", name)
    sizes = sizes or SPACES["walker"]
    config = kind.configure(sizes.domain, SMALL, settings)
    if (threshold := kind.measured_by_pilot(config)) is not None and getattr(config, threshold) is None:
        config = kind.configure(sizes.domain, SMALL, {threshold: 0.5, **settings})
    return kind(sizes, config, list(seeds))


def batch_for(collector: Any, size: int = 32, seed: int = 0, measure: bool = False) -> Batch:
    """Random transitions of a collector's sizes; every member gets other ones, member e those of ``seed + 1000 e``."""
    members = range(len(collector.seeds))
    parts = []
    for member in members:
        generator = torch.Generator().manual_seed(seed + 1000 * member)
        parts.append(
            (
                torch.randn(size, collector.sizes.observation, generator=generator),
                torch.rand(size, collector.sizes.action, generator=generator) * 2 - 1,
                *(torch.randn(size, collector.sizes.observation, generator=generator) for _ in range(3)),
            )
        )
    observation, action, following, future, other = (torch.stack(values) for values in zip(*parts, strict=True))
    batch = Batch(observation, action, following, collector.horizon, measure=measure)
    if collector.min_horizon is not None:
        batch.nearer_observation = (observation + following) / 2
        batch.nearer_horizon = collector.min_horizon + torch.arange(size) % (collector.horizon[:, None] - collector.min_horizon + 1)
    if collector.wants_future:
        batch.future_observation, batch.other_observation = future, other
    if collector.skill_size:
        # Of actions all along an episode.
        times = [row * collector.sizes.episode_length // size for row in range(size)]
        drawn = [MemberRandom([seed + 1000 * member + 100_000 * row for member in members], "rows") for row in range(size)]
        batch.skill = torch.stack([collector.sample_skills(random, t) for random, t in zip(drawn, times, strict=True)], dim=1)
    return batch


def low_variety(batch: Batch, scale: float, kinds: int = 6) -> Batch:
    """A batch of a few transitions only, each many times; the first member's observations are ``scale`` times as large as the others'."""
    few = copy.copy(batch)
    size = batch.observation.shape[1]
    rows, factor = torch.arange(size) % kinds, torch.ones(len(batch.observation), 1, 1)
    factor[0] = scale
    few.observation, few.action, few.next_observation = (
        batch.observation[:, rows] * factor,
        batch.action[:, rows],
        batch.next_observation[:, rows] * factor,
    )
    few.skill = None if batch.skill is None else batch.skill[:, rows]
    if batch.nearer_observation is not None:
        few.nearer_observation = (few.observation + few.next_observation) / 2
    for name in _FUTURES:
        if (states := getattr(batch, name)) is not None:
            setattr(few, name, states[:, rows] * factor)
    return few


def of_member(batch: Batch, member: int, horizon: Tensor) -> Batch:
    """One member's part of a batch, for a stack of that one, whose horizon (1,) it gets."""
    own = slice(member, member + 1)
    skill = None if batch.skill is None else batch.skill[own]
    one = Batch(batch.observation[own], batch.action[own], batch.next_observation[own], horizon, skill=skill, measure=batch.measure)
    if batch.nearer_observation is not None and batch.nearer_horizon is not None:
        one.nearer_observation, one.nearer_horizon = batch.nearer_observation[own], batch.nearer_horizon[own]
    for name in _FUTURES:
        if (states := getattr(batch, name)) is not None:
            setattr(one, name, states[own])
    return one


def lawful_batch(collector: Any, seed: int, size: int = 64) -> Batch:
    """Transitions of a small world, one member's: four causes, which turn, fade, and are moved by the actions, seen through a nonlinear
    mixture with a little noise."""
    laws, drawn = torch.Generator().manual_seed(7), torch.Generator().manual_seed(seed)
    sizes = collector.sizes
    mixture, pushes = torch.randn(4, sizes.observation, generator=laws), torch.randn(sizes.action, 4, generator=laws)
    turn = torch.linalg.qr(torch.randn(4, 4, generator=laws)).Q
    causes, action = torch.randn(1, size, 4, generator=drawn), torch.rand(1, size, sizes.action, generator=drawn) * 2 - 1
    following = 0.95 * causes @ turn + 0.5 * action @ pushes

    def seen(causes: Tensor) -> Tensor:
        return torch.tanh(0.5 * causes @ mixture) + 0.02 * torch.randn(1, size, sizes.observation, generator=drawn)

    batch = Batch(seen(causes), action, seen(following), collector.horizon)
    if collector.min_horizon is not None:
        batch.nearer_observation, batch.nearer_horizon = seen((causes + following) / 2), torch.full((1, size), collector.min_horizon)
    if collector.wants_future:
        batch.future_observation, batch.other_observation = seen(0.95 * following @ turn), batch.observation.flip(1)
    if collector.skill_size:
        batch.skill = collector.sample_skills(MemberRandom([seed * size + row for row in range(size)], "rows"), 0)[None]
    return batch


def _differs(key: str, step: int) -> Callable[[str], str]:
    """What is wrong with a metric that is another one in a stack of two than alone."""
    return lambda text: (
        f"update {step} measured another '{key}' in a stack of two than alone: what is computed for a member must come from that member's "
        f"rows (reduce over dimension 1 of (E, B), never over dimension 0). {text}"
    )


# What the failures of several tests say that was expected.
STATE = (
    "a method's state that changes in update must be a registered buffer or parameter, or lie in self.optimisers or self.random, whence "
    "all random numbers must come, so that state_dict holds it"
)
IN_PLACE = (
    "a tensor of the method was replaced by a new one in update; change it in place (copy_, add_), as a graph would go on with the old one"
)
REPLAYED = (
    "as a graph, the update does something else than as it is written: what Python decides (counts, branches) belongs in prepare, "
    "all else must follow from tensors that are changed in place; or say replayable = False"
)
MEASURED = "what is measured for diagnostics alone changed what was collected; a method must not read the simulator's quantities"


class _Memory:
    """Keeps what one member collects."""

    def __init__(self) -> None:
        self.episodes: list[tuple[int, Float32, Float32, Float32 | Float64]] = []
        self.rows: list[dict[str, Any]] = []
        self.skills: list[Float32 | Float64 | None] = []

    def add_episode(self, seed: int, observations: Float32, actions: Float32, infos: dict[str, Float32 | Float64]) -> None:
        self.episodes.append((seed, observations.copy(), actions.copy(), infos["physics"].copy()))
        self.skills.append(infos["skill"].copy() if "skill" in infos else None)

    def add_diagnostics(self, row: dict[str, Any], steps_per_second: float) -> None:
        assert steps_per_second > 0
        self.rows.append(row)


def _run(collector: Collector, steps: int = 450, seed_steps: int = 250, update_every: int = 15) -> list[_Memory]:
    sinks = [_Memory() for _ in collector.seeds]
    config = CollectConfig(steps=steps, seed_steps=seed_steps, update_every=update_every, measure_every=5)
    run_collection(collector, config, BRIEF, sinks, lambda n: None)
    return sinks


class CollectorContract:
    """One battery for one registered collector: subclass it under a name that starts with Test, and say its ``method``.

    Class attributes:
        method: the name under which the collector is registered.
    """

    method: ClassVar[str]

    @pytest.fixture
    def name(self) -> str:
        """The registered name of the collector under test."""
        return self.method

    @pytest.fixture(autouse=True)
    def one_thread(self) -> Iterator[None]:
        """Matrices this small take many times as long on several threads, which wait for each other."""
        before = torch.get_num_threads()
        torch.set_num_threads(1)
        yield
        torch.set_num_threads(before)

    def test_the_representation_does_not_collapse(self, name: str) -> None:
        """On states whose few causes move with the actions; what has no ``represent`` cannot tell."""
        collector = make(name, width=32, feature_dim=16, batch_size=64, learning_rate=3e-3)
        probe = lawful_batch(collector, 10**6).observation
        with torch.no_grad():
            before = collector.represent(probe)
        if before is None:
            return
        for step in range(100):
            collector.update(lawful_batch(collector, step))
        with torch.no_grad():
            after = collector.represent(probe)
        kept = float(spread(after) / spread(before))
        assert kept > 0.15, f"states differ {kept:.1%} as much as at the start"
        assert (rank := float(effective_rank(after))) > 3, f"states differ in {rank:.2f} directions, and have four causes"

    @pytest.mark.parametrize("domain", SPACES)
    @pytest.mark.parametrize("members", [1, 3])
    def test_builds_updates_and_acts_in_every_domain(self, name: str, domain: str, members: int) -> None:
        sizes = SPACES[domain]
        collector = make(name, range(members), sizes)
        metrics = collector.update(batch_for(collector, measure=True))
        for key, value in metrics.items():
            assert value.shape == (members,), f"'{key}' has shape {tuple(value.shape)}; a metric is a number for each member, ({members},)"
            assert torch.isfinite(value).all(), f"'{key}' is {value.tolist()}; metrics must be finite"
        assert bool(metrics) == collector.learns, "update must measure something when batch.measure is set, or the class say learns = False"
        action = collector.act(torch.randn(members, sizes.observation))
        expected = (members, sizes.action)
        assert action.shape == expected, f"act gives {tuple(action.shape)}; one action for each member is {expected}"
        assert action.abs().max() <= 1, f"act gives {action.abs().max():.3g}; actions must be within [-1, 1] (tanh, clamp)"
        horizon = collector.horizon
        assert (horizon.shape, horizon.dtype) == ((members,), torch.int64), f"horizon is {horizon}; it must be (E,) of int64"
        assert 1 <= int(horizon.max()) <= collector.max_horizon <= sizes.episode_length, "1 <= horizon <= max_horizon <= episode length"
        assert len(collector.summary()) == members, "summary() gives a dictionary for each member"

    def test_says_what_it_is(self, name: str) -> None:
        kind = plugins.load("collectors", name)
        for attribute in ("family", "citation"):
            assert isinstance(getattr(kind, attribute, None), str), f"the class must say its {attribute}, a text, for lists and tables"
        assert kind.category in CATEGORIES, f"category is {kind.category!r}; allowed: {', '.join(CATEGORIES)}"
        parameters = getattr(kind.config_class, "__dataclass_params__", None)
        # A manifest states the hyperparameters, so nothing may change them on the way.
        assert parameters is not None and parameters.frozen, "config_class must be a dataclass(frozen=True)"  # noqa: PT018

    def test_acts_deterministically_when_told_and_explores_otherwise(self, name: str) -> None:
        collector = make(name, (1, 2))
        observation = torch.randn(2, 24) * 5
        calm = collector.act(observation, explore=False)
        again = collector.act(observation, explore=False)
        assert torch.equal(calm, again), "act(explore=False) gave two answers to one observation; it must be deterministic"
        tries = torch.stack([collector.act(observation) for _ in range(20)])
        assert tries.abs().max() <= 1, f"act gives {tries.abs().max():.3g}; actions must be within [-1, 1], noise included"
        assert tries.std(0).min() > 0, "act(explore=True) gave the same action twenty times; it must explore"

    def test_a_restored_state_continues_identically(self, name: str) -> None:
        first = make(name, (1, 2))
        for step in range(3):
            first.update(batch_for(first, seed=step))
        state = copy.deepcopy(first.state_dict())
        second = make(name, (1, 2))
        second.load_state_dict(state)
        for step in range(3, 6):
            metrics = [c.update(batch_for(c, seed=step, measure=True)) for c in (first, second)]
            for key, value in metrics[0].items():
                assert torch.equal(value, metrics[1][key]), f"restored, an update measured another '{key}': {STATE}"
        observation = torch.randn(2, 24)
        assert torch.equal(first.act(observation), second.act(observation)), f"restored, it acts otherwise: {STATE}"
        assert digest(first.state_dict()) == digest(second.state_dict()), f"restored, it ended in another state: {STATE}"

    def test_members_learn_together_as_they_do_alone(self, name: str) -> None:
        """In what they measure (their own rewards and losses) at every update, and in how they act; first on plain data, then on data of
        little variety, on which what one member has in common with another is most of what there is."""
        together, alone = make(name, (5, 6)), make(name, (6,))
        for step in range(14):
            batch = batch_for(together, seed=step, measure=True)
            if step >= 6:
                # What is drawn from all members, such as a maximum or a mean, is now the first one's, or the second one's.
                batch = low_variety(batch, (0.1, 10.0)[step % 2])
            metrics = together.update(batch)
            for key, value in alone.update(of_member(batch, 1, alone.horizon)).items():
                torch.testing.assert_close(
                    metrics[key][1:], value, atol=2e-4, rtol=2e-3,
                    msg=_differs(key, step),
                )  # fmt: skip
            if step == 5:
                self._check_same_actions(together, alone)

    def _check_same_actions(self, together: Any, alone: Any) -> None:
        observation = torch.randn(1, 24)
        pair = together.act(observation.expand(2, -1), explore=False)
        torch.testing.assert_close(
            pair[1:], alone.act(observation, explore=False), atol=1e-4, rtol=1e-4,
            msg=lambda text: f"a member of a stack of two acts otherwise than alone: members must never see each other. {text}",
        )  # fmt: skip
        if alone.learns:
            assert not torch.allclose(pair[0], pair[1]), (
                "members with different seeds act the same: each must draw from its own seed's streams"
            )

    def test_collected_together_equals_collected_alone(self, name: str) -> None:
        # One update, at step 270; rounding has not had time to grow through the chaos of the simulation.
        pair, (alone,) = (_run(make(name, seeds, _BRIEF_SIZES), steps=290, seed_steps=200, update_every=90) for seeds in ((5, 6), (6,)))
        for together, single in zip(pair[1].episodes, alone.episodes, strict=True):
            assert together[0] == single[0], "a member's episodes must be reset with its own seeds, in a stack as alone"
            torch.testing.assert_close(
                torch.from_numpy(together[2]), torch.from_numpy(single[2]), atol=1e-3, rtol=0,
                msg=lambda text: f"a member of a stack collected other actions than alone: members must never see each other. {text}",
            )  # fmt: skip
        first = pair[0].episodes[0][2] == pair[1].episodes[0][2]
        assert not first.all(), "members with different seeds collected the same actions: each must draw from its own seed's streams"

    def test_a_run_that_was_interrupted_ends_as_if_it_had_not_been(self, name: str, tmp_path: Path) -> None:
        """Nor does anything but its seed decide how a run ends."""
        config = CollectConfig(steps=500, seed_steps=250, update_every=15, measure_every=5)

        def run(folder: Path, stop: int = 10_000) -> tuple[str, str, str]:
            collector, told = make(name, (3,), _BRIEF_SIZES), [0]

            def advance(steps: int) -> None:
                told[0] += steps
                if told[0] >= stop:
                    interrupts.request_stop()

            folder.mkdir(exist_ok=True)
            with interrupts.leaving_gracefully(), open_log(None) as log:
                journal = DatasetSink(folder, log)
                run_collection(collector, config, BRIEF, [journal], advance, Checkpoints(folder / "checkpoints", {"name": name}))
            journal.close()
            episodes = [array.tobytes() for episode in journal.episodes() for array in episode.fields().values()]
            # Digests: pytest would take minutes to say in what megabytes of bytes differ.
            return digest(collector.state_dict()), digest(str((folder / DIAGNOSTICS).read_bytes())), digest([str(one) for one in episodes])

        with pytest.raises(interrupts.Interrupted, match=r"at step 400 of 500"):
            run(tmp_path / "stopped", 400)
        stopped, whole = run(tmp_path / "stopped"), run(tmp_path / "whole")
        for what, one, other in zip(("the final state", "the diagnostics", "an episode"), stopped, whole, strict=True):
            assert one == other, f"a run that was interrupted and continued ended with another {what.split(' ', 1)[1]}: {STATE}"

    def test_steps_make_valid_episodes_the_last_of_them_short_without_any_reward(self, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
        def poisoned(quantities: Any) -> None:
            raise AssertionError("a collector asked for the environment's reward")

        monkeypatch.setattr("cudc_bench.envs.walker.walker_rewards", poisoned)
        collector = make(name, sizes=_BRIEF_SIZES)
        seen: list[Tensor | None] = []
        update = collector.update

        def remember(batch: Batch) -> dict[str, Tensor]:
            seen.append(batch.reward)
            return update(batch)

        collector.update = remember
        sink = _run(collector, steps=575, seed_steps=300, update_every=10)[0]
        lengths = [len(actions) for _, _, actions, _ in sink.episodes]
        assert lengths == [250, 250, 75], f"575 steps made episodes of {lengths}; with at most 250 each they are 250, 250 and 75"
        for length, (_, observations, actions, physics) in zip(lengths, sink.episodes, strict=True):
            assert observations.shape == (length + 1, 24)
            assert actions.shape == (length, 6)
            assert physics.shape == (length + 1, 18)
            assert all(np.isfinite(x).all() for x in (observations, actions, physics))
            assert abs(actions).max() <= 1, "actions must be within [-1, 1]"
        assert all(reward is None for reward in seen), "an update was given a reward of the environment"
        # Exactly one update on every tenth step from the first after the random ones.
        expected = 28 if collector.learns else 0
        assert len(seen) == expected, f"{len(seen)} updates; a method that learns has {expected} here, another one says learns = False"

    def test_what_is_measured_for_diagnostics_never_reaches_the_method(self, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
        """Physical quantities are read for coverage; other quantities must leave every byte and every metric as it was."""
        true = _run(make(name, sizes=_BRIEF_SIZES))[0]
        noise = np.random.default_rng(0)
        monkeypatch.setattr("cudc_bench.envs.walker.Walker.quantities", lambda self, out: noise.random(out=out))
        other = _run(make(name, sizes=_BRIEF_SIZES))[0]
        covered = [[(row.pop("coverage_cells"), row.pop("coverage_entropy")) for row in sink.rows] for sink in (true, other)]
        assert covered[0] != covered[1]
        assert true.rows == other.rows, MEASURED
        for a, b in zip(true.episodes, other.episodes, strict=True):
            assert a[0] == b[0], MEASURED
            assert all(np.array_equal(x, y) for x, y in zip(a[1:], b[1:], strict=True)), MEASURED

    def test_poisoned_rewards_never_reach_an_update(self, name: str) -> None:
        collectors = [make(name), make(name)]
        for step in range(3):
            clean, poisoned = (batch_for(c, seed=step, measure=True) for c in collectors)
            poisoned.reward = torch.full(poisoned.action.shape[:2], math.nan)
            metrics = [c.update(batch) for c, batch in zip(collectors, (clean, poisoned), strict=True)]
            for key, value in metrics[0].items():
                assert torch.equal(value, metrics[1][key]), f"'{key}' depends on batch.reward; a collector explores without any reward"

    def test_a_graph_of_its_update_does_what_the_update_does(self, name: str) -> None:
        """As on CUDA: nothing but tensors that stay where they are decides what an update does, and it waits for none of them."""
        if not getattr(make(name), "replayable", False):
            pytest.skip("its updates are not replayed")

        def run(graph: type[Graph] | None) -> tuple[str, list[str]]:
            collector = make(name, (1, 2))
            random = MemberRandom((1, 2), "replay")
            replay = Episodes(2, 6, 6 * 40, 24, 6, random, skill=collector.skill_size)

            def draw(measure: bool) -> Batch:
                return replay.sample(32, collector.horizon, measure, collector.min_horizon, future=collector.wants_future)

            updates = Updater(collector, draw, random, graph)
            seen: list[str] = []
            places: list[list[int]] = []
            for step in range(WARM_UP + 9):
                if step % 3 == 0 and step < 18:
                    for member in (0, 1):
                        g = torch.Generator().manual_seed(10 * step + member)
                        skills = torch.rand(40, collector.skill_size, generator=g) if collector.skill_size else None
                        replay.add(member, torch.randn(41, 24, generator=g), torch.rand(40, 6, generator=g), skills)
                metrics, batch = updates(measure=step == WARM_UP + 5)
                # A tensor that was replaced would be the old one to a graph, whether its value has changed by now or not.
                places.append([tensor.data_ptr() for tensor in (*collector.parameters(), *collector.buffers())])
                seen.append(digest([batch.observation.clone(), collector.act(torch.ones(2, 24)), *metrics.values()]))
            assert all(one == places[0] for one in places), IN_PLACE
            return digest(collector.state_dict()), seen

        assert run(RecordedGraph) == run(None), REPLAYED

    def test_learns_from_transitions_of_other_lengths(self, name: str) -> None:
        """The k of a method may be set, and the value of s' counts γ^k."""
        config = make(name).config
        if not hasattr(config, "horizon"):
            pytest.skip("it looks no number of steps ahead")
        for k in (1, 5):
            collector = make(name, horizon=k, **({"k_max": max(k, config.k_max)} if hasattr(config, "k_max") else {}))
            assert collector.horizon.tolist() == [k]
            batch = batch_for(collector, measure=True)
            metrics = collector.update(batch)
            for key, value in metrics.items():
                assert torch.isfinite(value).all(), f"with k = {k}, '{key}' is {value.tolist()}; metrics must be finite"
            if isinstance(collector, DDPG):
                assert collector.bootstrap(batch).flatten().tolist() == pytest.approx([collector.config.discount**k])

    def test_metrics_are_costly_only_when_measured(self, name: str) -> None:
        collector = make(name)
        found = collector.update(batch_for(collector))
        assert found == {}, f"update measured {', '.join(found)} though batch.measure is not set, and would wait for the device each time"

    def test_skills_are_stored_as_the_actions_followed_them(self, name: str) -> None:
        collector = make(name, sizes=_BRIEF_SIZES)
        given: list[Any] = []
        act = collector.act

        def remember(observation: Tensor, explore: bool = True) -> Tensor:
            given.append(collector.skill.clone() if collector.skill_size else None)
            return act(observation, explore)

        collector.act = remember
        sink = _run(collector, steps=325, seed_steps=0, update_every=25)[0]
        if not collector.skill_size:
            assert sink.skills == [None, None]
            return
        lengths = [250, 75]
        skills = [torch.from_numpy(skill) for skill in sink.skills if skill is not None]
        assert [skill.shape for skill in skills] == [(length + 1, collector.skill_size) for length in lengths]
        for rows, start in zip(skills, (0, 250), strict=True):
            # pytest shows the rows; what is stored at t is the skill that action t followed.
            assert torch.equal(rows[:-1], torch.cat(given[start : start + len(rows) - 1]))
            assert torch.equal(rows[-1], rows[-2])
            changes = (rows[1:-1] != rows[:-2]).any(1).nonzero()[:, 0] + 1
            every_steps = collector.skill_steps
            assert not every_steps or (changes % every_steps == 0).all()
            assert bool(len(changes)) == bool(every_steps)
        assert len(skills[0].unique(dim=0)) > 1 or not collector.skill_steps

    def test_actions_and_values_depend_on_the_skill(self, name: str) -> None:
        collector = make(name)
        if not collector.skill_size:
            return
        batch = batch_for(collector)
        assert batch.skill is not None
        other = torch.roll(batch.skill, 1, dims=1)
        different = (other != batch.skill).any(-1)[0]
        with torch.no_grad():
            mean = [collector.actor(collector.with_skill(batch.observation, skill)) for skill in (batch.skill, other)]
            value = [collector.value(collector.critic, batch.observation, skill, batch.action) for skill in (batch.skill, other)]
        for first, second in (mean, value):
            assert (first != second).any(-1)[0][different].all(), "actor and critic must take the skill (with_skill): another gave the same"
            torch.testing.assert_close(first[0][~different], second[0][~different])
