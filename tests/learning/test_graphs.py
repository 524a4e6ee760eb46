"""Updates as graphs: what a replay repeats, what it refuses, and on a GPU that it equals running step by step and never waits."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor

from cudc_bench import plugins
from cudc_bench.collectors.base import Sizes
from cudc_bench.learning.cpu_graphs import RecordedGraph
from cudc_bench.learning.cuda_graphs import WARM_UP, ActionRunner, Graph, Updater
from cudc_bench.learning.engines import graphs_for
from cudc_bench.learning.learner import Learner
from cudc_bench.learning.networks import MemberRandom, mlp
from cudc_bench.learning.recording import WaitsForDeviceError
from cudc_bench.learning.replay import Batch, Episodes


class Regression(Learner):
    """Predicts an action from an observation; every third update does so with half the weight."""

    def __init__(self, device: str = "cpu") -> None:
        super().__init__(None, [1], device)
        self.random["noise"] = MemberRandom([1], "noise", device)
        self.network = mlp(MemberRandom([1], "weights", device), 3, 8, 2)
        self.add_optimiser("network", [self.network], 1e-2)
        self.register_buffer("total", torch.zeros(1, device=device))
        self.updates = 0

    total: Tensor

    def prepare(self) -> float:
        self.updates += 1
        self.set_learning_rate("network", 1e-2 / self.updates)
        return 0.5 if self.updates % 3 == 0 else 1.0

    def learn(self, batch: Batch, plan: float) -> dict[str, Tensor]:
        noise = self.random["noise"].normal(*batch.action.shape[1:])
        loss = plan * (self.network(batch.observation) - batch.action + 0.1 * noise).square().mean((1, 2))
        self.minimise("network", loss)
        self.total += loss.detach()
        return {"loss": loss.detach()} if batch.measure else {}


def data(device: str = "cpu") -> tuple[Episodes, MemberRandom]:
    random = MemberRandom([1], "replay", device)
    episodes = Episodes(1, 2, 80, 3, 2, random)
    g = torch.Generator().manual_seed(0)
    for _ in range(2):
        episodes.add(0, torch.randn(41, 3, generator=g), torch.rand(40, 2, generator=g))
    return episodes, random


def updates_of(learner: Any, make: Callable[[], Graph] | None, device: str = "cpu") -> Updater:
    episodes, random = data(device)
    horizon = torch.ones(1, dtype=torch.int64, device=device)
    return Updater(learner, lambda measure: episodes.sample(16, horizon, measure), random, make)


class Counting(RecordedGraph):
    """Counts replays."""

    replays = 0

    def replay(self) -> None:
        Counting.replays += 1
        super().replay()


def test_replays_equal_updates_one_by_one() -> None:
    """The host's learning rates among them, which are tensors."""
    plain, graphed = Regression(), Regression()
    Counting.replays = 0
    runs = [updates_of(plain, None), updates_of(graphed, Counting)]
    for step in range(20):
        measured = [run(step == 10)[0] for run in runs]
        assert measured[0].keys() == measured[1].keys() == ({"loss"} if step == 10 else set())
        assert all(torch.equal(value, measured[1][key]) for key, value in measured[0].items())
        assert torch.equal(plain.total, graphed.total), step
    assert all(torch.equal(a, b) for a, b in zip(plain.parameters(), graphed.parameters(), strict=True))
    # Two plans are warmed up apart, and what is measured is not replayed: 20 - 1 - 2 * WARM_UP.
    assert Counting.replays == 19 - 2 * WARM_UP


def test_what_python_decides_is_not_seen_by_a_replay() -> None:
    """The oracle itself: a learner that breaks the rules comes out differently."""

    class Stale(Regression):
        def learn(self, batch: Batch, plan: float) -> dict[str, Tensor]:
            self.total = self.total + self.updates
            return super().learn(batch, 1.0)

    plain, graphed = Stale(), Stale()
    runs = [updates_of(plain, None), updates_of(graphed, RecordedGraph)]
    for _ in range(12):
        for run in runs:
            run(False)
    assert not torch.equal(plain.total, graphed.total)


@pytest.mark.parametrize(
    "wait",
    [
        lambda x: x.sum().item(),
        lambda x: bool((x > 0).any()),
        lambda x: x[x > 0],
        lambda x: x.nonzero(),
        lambda x: x * torch.tensor(0.5),
        lambda x: x + torch.as_tensor(0.5),
    ],
    ids=["item", "branch", "mask", "nonzero", "tensor of a number", "number as a tensor"],
)
def test_an_update_that_waits_for_the_device_is_refused(wait: Callable[[Tensor], object]) -> None:
    class Waiting(Regression):
        def learn(self, batch: Batch, plan: float) -> dict[str, Tensor]:
            wait(batch.action)
            return super().learn(batch, plan)

    run = updates_of(Waiting(), RecordedGraph)
    # The plan of every third update is another one.
    for _ in range(WARM_UP + 1):
        run(False)
    with pytest.raises(WaitsForDeviceError, match="has the host wait for the device"):
        run(False)


def test_only_what_offers_it_is_replayed_and_only_on_cuda() -> None:
    class Own(Regression):
        def update(self, batch: Batch) -> dict[str, Tensor]:
            return {}

    cuda, cpu = torch.device("cuda"), torch.device("cpu")
    assert graphs_for(Regression(), cuda) is not None
    assert graphs_for(Regression(), cpu) is None
    assert graphs_for(Own(), cuda) is None
    assert graphs_for(object(), cuda) is None


def test_actions_are_those_of_the_observation_given() -> None:
    network = mlp(MemberRandom([1, 2], "weights"), 3, 8, 2)
    random = [MemberRandom([1, 2], "act") for _ in range(2)]

    def act(stream: MemberRandom) -> Callable[[Tensor], Tensor]:
        return lambda seen: network(seen[:, None])[:, 0] + stream.normal(2)

    with torch.no_grad():
        plain = ActionRunner(act(random[0]), [random[0]], torch.device("cpu"), None)
        graphed = ActionRunner(act(random[1]), [random[1]], torch.device("cpu"), RecordedGraph)
        for step in range(WARM_UP + 5):
            observation = torch.full((2, 3), float(step))
            assert torch.equal(plain(observation), graphed(observation))


@contextmanager
def no_waiting() -> Iterator[None]:
    torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


LEARNERS = [
    (kind, name)
    for kind in ("collectors", "evaluators")
    for name in plugins.names(kind)
    if getattr(plugins.load(kind, name), "learns", True)
]


def made(kind: str, name: str, device: str) -> Any:
    """A small learner with two members."""
    small = {"width": 32, "batch_size": 64, "feature_dim": 16, "learning_rate": 1e-3}
    learner = plugins.load(kind, name)
    if kind == "evaluators":
        return learner(24, 6, learner.configure(small), [1, 2], device)
    config = learner.configure("walker", small)
    if (threshold := learner.measured_by_pilot(config)) is not None:
        config = learner.configure("walker", small, {threshold: 0.5})
    return learner(Sizes("walker", 24, 6, 1000, 0, 2), config, [1, 2], device)


@pytest.mark.cuda
@pytest.mark.parametrize(("kind", "name"), LEARNERS)
def test_on_a_gpu_graphs_equal_single_steps_and_nothing_waits(kind: str, name: str) -> None:
    found = []
    for graphed in (False, True):
        learner = made(kind, name, "cuda")
        skill = getattr(learner, "skill_size", 0)
        random = MemberRandom([1, 2], "replay", "cuda")
        episodes = Episodes(2, 2, 160, 24, 6, random, skill=skill)
        g = torch.Generator().manual_seed(0)
        for member in (0, 1):
            for _ in range(2):
                skills = torch.rand(80, skill, generator=g) if skill else None
                episodes.add(member, torch.randn(81, 24, generator=g), torch.rand(80, 6, generator=g), skills)
        episodes.rewards = torch.rand(2, 160, generator=g).cuda()

        def draw(measure: bool, episodes: Episodes = episodes, learner: Any = learner) -> Batch:
            horizon = getattr(learner, "horizon", torch.ones(2, dtype=torch.int64, device="cuda"))
            following = getattr(learner, "wants_next_action", False)
            return episodes.sample(64, horizon, measure, getattr(learner, "min_horizon", None), following, learner.wants_future)

        updates = Updater(learner, draw, random, graphs_for(learner, learner.device) if graphed else None)
        for _ in range(2 * WARM_UP + 2):
            updates(False)
        with no_waiting():
            for _ in range(20):
                updates(False)
        found.append({key: value.cpu() for key, value in torch.nn.Module.state_dict(learner).items()})
    for key, value in found[0].items():
        torch.testing.assert_close(found[1][key], value, atol=1e-4, rtol=1e-3, msg=lambda m, key=key: f"{key}: {m}")
