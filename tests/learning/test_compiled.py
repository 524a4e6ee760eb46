"""Compiled updates: they equal updates one by one, whatever is learnt, and what cannot be compiled goes on one by one."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import cudc_bench
from cudc_bench import plugins
from cudc_bench.artefacts.manifest import read_manifest
from cudc_bench.artefacts.records import read_record
from cudc_bench.collectors import variants
from cudc_bench.collectors.base import Sizes
from cudc_bench.errors import UsageError
from cudc_bench.evaluators.contract import BRIEF, random_walker_data
from cudc_bench.evaluators.running.loop import Arena, run_evaluation
from cudc_bench.execution import interrupts
from cudc_bench.execution.checkpoints import Checkpoints
from cudc_bench.learning import compiled, engines
from cudc_bench.learning.compiled import CannotCompileError, functional, missing_compiler
from cudc_bench.learning.cuda_graphs import Graph, Updater
from cudc_bench.learning.engines import WORTH_COMPILING, graphs_for, resolve_engine, set_engine
from cudc_bench.learning.learner import Learner
from cudc_bench.learning.networks import MemberRandom, mlp
from cudc_bench.learning.recording import NotRepeatableError, Recording, WaitsForDeviceError
from cudc_bench.learning.replay import Batch, Episodes
from cudc_bench.settings.evaluate_config import EvaluateConfig

from .precision import in_precision

SMALL = {"width": 16, "batch_size": 24, "feature_dim": 12, "learning_rate": 1e-3}
SHORT = {"prototypes": 12, "queue_size": 24, "neighbours": 3, "projection_hidden": 12}


@pytest.fixture
def own_cache(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(compiled, "_here", {})


class FunctionalGraph(Graph):
    """What a compiler is given, carried out as it stands: the formula without its code."""

    warm_up = 0
    draws = False
    falls_back = False

    def capture(self, function: Callable[[], Any], random: Any) -> Any:
        from torch._subclasses.fake_tensor import FakeTensorMode

        self._recording, result = Recording.of(function, random)
        self._graph = functional(self._recording, FakeTensorMode())[0]
        return result

    def replay(self) -> None:
        self._recording.draw()
        with torch.no_grad():
            self._graph(*self._recording.inputs)


def names() -> Iterator[tuple[str, str]]:
    # Of several names for one class the first is kept; variants of CUDC are other settings of it.
    for kind in ("evaluators", "collectors"):
        seen: dict[type, str] = {}
        for name in plugins.names(kind):
            made = plugins.load(kind, name)
            if getattr(made, "learns", True) and made.__module__ != variants.__name__:
                seen.setdefault(made, name)
        yield from ((kind, name) for name in seen.values())


def make(kind: str, name: str, seeds: tuple[int, ...] = (1, 2), double: bool = False, **values: Any) -> Any:
    """A small learner; in double precision rounding cannot hide a wrong formula."""
    made = plugins.load(kind, name)
    fields = made.config_class.__dataclass_fields__
    settings = {key: value for key, value in {**SMALL, **SHORT, **values}.items() if key in fields}
    if kind == "evaluators":
        learner = made(24, 6, made.configure(settings), seeds)
    else:
        config = made.configure("walker", settings)
        if (threshold := made.measured_by_pilot(config)) is not None:
            config = made.configure("walker", settings, {threshold: 0.5})
        learner = made(Sizes("walker", 24, 6, 1000, 0, 2), config, seeds)
    return in_precision(learner, torch.float64) if double else learner


def updates_of(learner: Any, graph: Callable[[], Graph] | None, double: bool = False) -> Updater:
    members = len(learner.seeds)
    random = MemberRandom(learner.seeds, "replay")
    skill = getattr(learner, "skill_size", 0)
    data = Episodes(members, 3, 120, 24, 6, random, skill=skill, rewards=True)
    g = torch.Generator().manual_seed(0)
    for _ in range(3):
        for member in range(members):
            skills = torch.rand(40, skill, generator=g) if skill else None
            data.add(member, torch.randn(41, 24, generator=g), torch.rand(40, 6, generator=g), skills, torch.rand(40, generator=g))
    if double:
        for field in ("observations", "actions", "skills", "rewards"):
            if getattr(data, field) is not None:
                setattr(data, field, getattr(data, field).double())
    one = torch.ones(members, dtype=torch.int64)

    def draw(measure: bool) -> Batch:
        horizon, following = getattr(learner, "horizon", one), getattr(learner, "wants_next_action", False)
        nearest = getattr(learner, "min_horizon", None)
        return data.sample(learner.config.batch_size, horizon, measure, nearest, following, learner.wants_future)

    return Updater(learner, draw, random, graph)


@pytest.mark.parametrize(("kind", "name"), list(names()))
def test_the_function_that_is_compiled_is_the_update(kind: str, name: str) -> None:
    """To the last digits of double precision, random draws among them, over several updates and both plans of delayed actors."""
    learners = [make(kind, name, double=True) for _ in range(2)]
    runs = [updates_of(learners[0], None, True), updates_of(learners[1], FunctionalGraph, True)]
    for _ in range(4):
        batches = [run(False)[1] for run in runs]
    for field in ("observation", "action", "next_observation", "reward", "signal"):
        first, second = (getattr(batch, field) for batch in batches)
        assert (first is None) == (second is None), field
        if first is not None:
            torch.testing.assert_close(second, first, rtol=1e-7, atol=1e-9, msg=lambda m, field=field: f"{field}: {m}")
    for learner in learners:
        assert learner.engine == "auto"
    states = [learner.state_dict() for learner in learners]
    for key, value in states[0]["networks"].items():
        torch.testing.assert_close(states[1]["networks"][key], value, rtol=1e-7, atol=1e-9, msg=lambda m, key=key: f"{key}: {m}")
    for random in states[0]["random"]:
        assert all(torch.equal(a, b) for a, b in zip(states[0]["random"][random], states[1]["random"][random], strict=True))
    counts = [[float(s["step"]) for o in learner.optimisers.values() for s in o.state.values()] for learner in learners]
    assert counts[0] == counts[1]


@cache
def _compiler() -> str | None:
    return missing_compiler()


needs_compiler = pytest.mark.skipif(_compiler() is not None, reason="needs a C++ compiler")


@needs_compiler
def test_a_compiled_update_is_the_update(
    own_cache: None, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The compiler's code itself, of the smallest learner, with two members; and what people hear."""
    learners = [make("evaluators", "bc") for _ in range(2)]
    set_engine(learners[1], "compiled")
    runs = [updates_of(learner, graphs_for(learner, torch.device("cpu"))) for learner in learners]
    for step in range(8):
        measured = [run(step == 5)[0] for run in runs]
        assert measured[0].keys() == measured[1].keys()
    assert learners[1].engine == "compiled"
    for (key, first), second in zip(
        learners[0].state_dict()["networks"].items(), learners[1].state_dict()["networks"].values(), strict=True
    ):
        torch.testing.assert_close(second, first, rtol=1e-4, atol=1e-6, msg=lambda m, key=key: f"{key}: {m}")
    said = capfd.readouterr().err
    assert said.count("compiling an update") == said.count("compiled in") == 1

    # A run that goes on has the same numbers as one that never stopped, and nothing is compiled again.
    state, draws = deepcopy(learners[1].state_dict()), runs[1]._random.state_dict()

    def go_on() -> Any:
        again = make("evaluators", "bc")
        set_engine(again, "compiled")
        continued = updates_of(again, graphs_for(again, torch.device("cpu")))
        again.load_state_dict(deepcopy(state))
        continued._random.load_state_dict(draws)
        for _ in range(3):
            continued(False)
        assert again.engine == "compiled"
        return again

    for _ in range(3):
        runs[1](False)

    def same(again: Any) -> bool:
        return all(torch.equal(a, b) for a, b in zip(learners[1].parameters(), again.parameters(), strict=True))

    assert same(go_on())
    # Nor does another process ask the compiler, or import it.
    with monkeypatch.context() as patch:
        patch.setattr(compiled, "_here", {})
        for module in ("torch._inductor", "torch._dynamo", "torch._subclasses.fake_tensor"):
            patch.setitem(sys.modules, module, None)
        assert same(go_on())
    assert "compil" not in capfd.readouterr().err

    # What was damaged is compiled again, and kept again.
    (file,) = (tmp_path / "known").iterdir()
    content = file.read_bytes()
    # A new file, since this process has the old one in its memory.
    file.unlink()
    file.write_bytes(content[: len(content) // 2])
    monkeypatch.setattr(compiled, "_here", {})
    assert same(go_on())
    assert "compiled in" in capfd.readouterr().err
    assert file.read_bytes() == content


class Own(Learner):
    """Learns with one network, in a way that a test gives."""

    def __init__(self, what: Callable[[Own, Batch], None]) -> None:
        super().__init__(None, [1])
        self.what = what
        self.random["noise"] = MemberRandom([1], "noise")
        self.network = mlp(MemberRandom([1], "weights"), 24, 8, 6)
        self.add_optimiser("network", [self.network], 1e-2)
        self.register_buffer("total", torch.zeros(3))
        self.count = 0

    total: Tensor
    config: Any = type("Config", (), {"batch_size": 16})()

    def learn(self, batch: Batch, plan: Any) -> dict[str, Tensor]:
        self.what(self, batch)
        self.minimise("network", (self.network(batch.observation) - batch.action).square().mean((1, 2)))
        return {}

    def __setattr__(self, name: str, value: Any) -> None:
        if name != "config":
            super().__setattr__(name, value)

    def state_dict(self) -> dict[str, Any]:  # type: ignore[override]
        return super().state_dict() | {"count": self.count}

    def load_state_dict(self, state: dict[str, Any]) -> None:  # type: ignore[override]
        super().load_state_dict(state)
        self.count = state["count"]


def _rebind(self: Own, batch: Batch) -> None:
    self.total = self.total + 1.0


def _count(self: Own, batch: Batch) -> None:
    self.count += 1


def _global(self: Own, batch: Batch) -> None:
    self.total += torch.rand(3)


def _onto_zeros(self: Own, batch: Batch) -> None:
    self.total += torch.zeros(3).normal_(generator=self.random["noise"].generators[0])


def _wait(self: Own, batch: Batch) -> None:
    self.total += float(batch.action.sum())


def _overlap(self: Own, batch: Batch) -> None:
    self.first.add_(1.0)
    self.total.mul_(2.0)


@pytest.mark.parametrize(
    ("what", "why"),
    [
        (_rebind, "changes something else than tensors in place"),
        (_count, "changes something else than tensors in place"),
        (_global, "random numbers from a stream that is not one of the learner's"),
        (_onto_zeros, "draw them with MemberRandom"),
        (_wait, "has the host wait for the device"),
        (_overlap, "also reads a part that was taken before"),
    ],
    ids=["rebinds", "counts", "global stream", "draws onto numbers", "waits", "overlaps"],
)
def test_what_cannot_be_repeated_goes_on_one_by_one(
    what: Any, why: str, own_cache: None, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With one line that says why, and the same result as if nobody had tried."""
    # The code is not needed: every one of them is found before it, or after it by what changed.
    monkeypatch.setattr(compiled, "compile_recording", lambda recording: lambda: None)
    found = []
    for engine in ("eager", "compiled"):
        torch.manual_seed(0)
        learner = Own(what)
        learner.first = learner.total[:2]
        set_engine(learner, engine)
        run = updates_of(learner, graphs_for(learner, torch.device("cpu")))
        for _ in range(4):
            run(False)
        assert learner.engine == "eager"
        found.append(learner)
    assert torch.equal(found[0].total, found[1].total)
    assert found[0].count == found[1].count
    assert all(torch.equal(a, b) for a, b in zip(found[0].network.parameters(), found[1].network.parameters(), strict=True))
    (line,) = [line for line in capfd.readouterr().err.splitlines() if "one by one" in line]
    assert why in line


def test_a_broken_compiler_costs_a_line_and_nothing_else(
    own_cache: None, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(recording: Recording) -> Any:
        raise OSError("no space left")

    monkeypatch.setattr(compiled, "compile_anew", fail)
    learners = [make("evaluators", "bc") for _ in range(2)]
    set_engine(learners[1], "compiled")
    runs = [updates_of(learner, graphs_for(learner, torch.device("cpu"))) for learner in learners]
    for _ in range(3):
        for run in runs:
            run(False)
    assert learners[1].engine == "eager"
    assert all(torch.equal(a, b) for a, b in zip(learners[0].parameters(), learners[1].parameters(), strict=True))
    assert "OSError: no space left" in capfd.readouterr().err
    with pytest.raises(CannotCompileError, match="no space left"):
        compiled.compile_recording(Recording.of(lambda: torch.ones(3).add_(1.0), [])[0])


def test_recording_takes_back_what_it_did() -> None:
    learner = make("evaluators", "cql")
    before = {key: value.clone() for key, value in learner.state_dict()["networks"].items()}
    draws = learner.random["noise"].state_dict()
    run = updates_of(learner, None)
    recording, batch = Recording.of(
        lambda: (learner.learn(run._draw(False), learner.prepare()), run._draw(False))[1], [*learner.random.values(), run._random]
    )
    assert all(torch.equal(value, before[key]) for key, value in learner.state_dict()["networks"].items())
    assert all(torch.equal(a, b) for a, b in zip(draws, learner.random["noise"].state_dict(), strict=True))
    assert batch.observation.shape == (2, 24, 24)
    assert recording.operations > 300

    def fail() -> None:
        learner.log_multiplier.data.add_(1.0)
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        Recording.of(fail, learner.random.values())
    assert torch.equal(learner.log_multiplier, before["log_multiplier"])


def test_the_hyperbolic_tangent_is_as_exact_as_its_type() -> None:
    x = torch.cat([torch.linspace(-12.0, 12.0, 200_001), torch.logspace(-30, 2, 10_001), -torch.logspace(-30, 2, 10_001)])
    exact = torch.tanh(x.double())
    assert ((compiled._tanh(x).double() - exact) / exact).nan_to_num().abs().max() < 3e-7
    special = torch.tensor([0.0, torch.inf, -torch.inf, torch.nan, 1e-45, 3e38])
    torch.testing.assert_close(compiled._tanh(special), torch.tanh(special), rtol=0.0, atol=0.0, equal_nan=True)
    assert torch.equal(compiled._tanh(x.double()), exact)


@pytest.mark.parametrize("outputs", [1, 3])
@pytest.mark.parametrize("scale", [{}, {"alpha": -2.0}, {"beta": 0.5, "alpha": 3.0}], ids=str)
def test_products_are_taken_apart_into_the_same_numbers(outputs: int, scale: dict[str, float]) -> None:
    g = torch.Generator().manual_seed(0)
    left, right, bias = (torch.randn(shape, generator=g).double() for shape in ((2, 5, 7), (2, 7, outputs), (2, 1, outputs)))
    torch.testing.assert_close(compiled._product(left, right), torch.bmm(left, right))
    torch.testing.assert_close(compiled._layer(bias, left, right, **scale), torch.baddbmm(bias, left, right, **scale))


def test_other_optimisers_are_refused_with_what_to_take() -> None:
    from torch._subclasses.fake_tensor import FakeTensorMode

    weight = torch.nn.Parameter(torch.ones(3))
    optimiser = torch.optim.SGD([weight], lr=0.1, foreach=True)

    def update() -> None:
        optimiser.zero_grad(set_to_none=True)
        weight.square().sum().backward()
        optimiser.step()

    with pytest.raises(NotRepeatableError, match=r"use the optimisers of cudc_bench\.learning\.networks"):
        functional(Recording.of(update, [])[0], FakeTensorMode())
    with pytest.raises(WaitsForDeviceError):
        Recording.of(lambda: weight.sum().item(), [])


def test_auto_compiles_long_runs_where_there_is_a_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    td3, random = plugins.load("evaluators", "td3"), plugins.load("collectors", "random")

    class Owned(td3):  # type: ignore[misc, valid-type]
        def update(self, batch: Batch) -> dict[str, Tensor]:
            return {}

    monkeypatch.setattr("cudc_bench.learning.engines.missing_compiler", lambda: None)
    assert resolve_engine("auto", td3, "cpu", WORTH_COMPILING) == "compiled"
    assert resolve_engine("auto", td3, "cpu", WORTH_COMPILING - 1) == "eager"
    assert resolve_engine("compiled", td3, "cpu", 1) == "compiled"
    assert resolve_engine("eager", td3, "cpu", WORTH_COMPILING) == "eager"
    assert resolve_engine("compiled", random, "cpu", WORTH_COMPILING) == "eager"
    assert resolve_engine("compiled", Owned, "cpu", WORTH_COMPILING) == "eager"
    assert [resolve_engine(asked, td3, "cuda", 1) for asked in ("auto", "eager", "compiled")] == ["graph", "eager", "compiled"]
    monkeypatch.setattr("cudc_bench.learning.engines.missing_compiler", lambda: "there is none")
    assert resolve_engine("compiled", td3, "cpu", WORTH_COMPILING) == "eager"


def test_what_keeps_a_machine_from_compiling_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, why in (("no-such-compiler", "there is no C++ compiler 'no-such-compiler'"), ("false", "'false' knows no C++17")):
        monkeypatch.setenv("CXX", name)
        missing_compiler.cache_clear()
        found = missing_compiler()
        assert found is not None
        assert why in found
    missing_compiler.cache_clear()


class Falling(FunctionalGraph):
    falls_back = True


@pytest.fixture
def as_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """The engine ``compiled`` without waiting for a compiler."""
    monkeypatch.setattr(engines, "CompiledGraph", Falling)
    monkeypatch.setattr(engines, "missing_compiler", lambda: None)


def test_records_and_manifests_name_their_engine(as_compiled: None, smoke: Path, tmp_path: Path) -> None:
    curves = {}
    for engine in ("eager", "compiled", "auto"):
        options: dict[str, Any] = {"profile": "smoke", "engine": engine, "device": "cpu"}
        (path,) = cudc_bench.evaluate("td3", tasks=["walk"], output=tmp_path / engine, **options)
        record = read_record(path)
        # The run is too short for auto.
        assert record.machine["engine"] == ("eager" if engine == "auto" else engine)
        # Who repeats it is to have the same one.
        assert (f"--engine {engine}" in record.command) == (engine != "auto")
        curves[engine] = [one.returns for one in record.curve]
        for method in ("icm", "random"):
            cudc_bench.collect(method, dataset_id=f"walker/{method}-{engine}-v0", settings={"steps": 1500}, **options)
    assert curves["eager"] == curves["auto"]
    assert curves["compiled"][0] == curves["eager"][0]
    for first, second in zip(curves["eager"], curves["compiled"], strict=True):
        assert second == pytest.approx(first, rel=0.05)
    assert read_manifest("walker/icm-compiled-v0").machine["engine"] == "compiled"
    assert read_manifest("walker/icm-eager-v0").fingerprint == read_manifest("walker/icm-auto-v0").fingerprint
    assert "engine" not in read_manifest("walker/random-compiled-v0").machine


def test_an_engine_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--engine"):
        cudc_bench.evaluate("td3", profile="smoke", output=tmp_path, engine="turbo")


class Stopping(Arena):
    """Stops a run at its evaluation after so many updates."""

    def __init__(self, stop: int) -> None:
        super().__init__(BRIEF, ["stand", "walk"])
        self.stop = stop

    def evaluate(self, agent: Any, seeds: Any, purpose: str, step: int, episodes: int) -> Any:
        if step == self.stop:
            raise interrupts.interrupted("")
        return super().evaluate(agent, seeds, purpose, step, episodes)


@pytest.mark.parametrize("works", [True, False], ids=["compiled", "fell back"])
def test_a_run_goes_on_with_the_engine_that_it_had(works: bool, as_compiled: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    config = EvaluateConfig(gradient_steps=25, evaluate_every=10, evaluation_episodes=1, final_episodes=1, milestones=(10, 25))

    def fail(*_: Any) -> Any:
        raise NotRepeatableError("not today")

    def run(stop: int, checkpoints: Checkpoints | None) -> tuple[Any, str]:
        agent = make("evaluators", "td3", (3, 4))
        set_engine(agent, "compiled")
        outcomes = run_evaluation(agent, random_walker_data(1, "stand", (3, 4)), config, Stopping(stop), lambda n: None, (), checkpoints)
        return outcomes, agent.engine

    with monkeypatch.context() as broken:
        if not works:
            broken.setattr(Falling, "capture", fail)
        whole = run(-1, None)
        with pytest.raises(interrupts.Interrupted):
            run(20, Checkpoints(tmp_path, {}, every=0.0))
    assert whole[1] == ("compiled" if works else "eager")
    # The compiler works by now; a run that did without it goes on so.
    assert run(-1, Checkpoints(tmp_path, {}, every=0.0)) == whole
