"""What the doctor tries on CUDA, by the same function on a CPU."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from cudc_bench import plugins
from cudc_bench.cli import doctor
from cudc_bench.learning import engines
from cudc_bench.learning.cpu_graphs import RecordedGraph

LEARNERS = [("evaluators", "td3"), ("collectors", "cudc")]


class Falling(RecordedGraph):
    """A CUDA graph on a CPU, with updates one by one where it fails."""

    falls_back = True


class Failing(Falling):
    def capture(self, function: Any, random: Any) -> Any:
        raise RuntimeError("not today")


def graphs(monkeypatch: pytest.MonkeyPatch, graph: type) -> None:
    monkeypatch.setattr(engines, "CompiledGraph", graph)


@pytest.mark.parametrize(("kind", "name"), LEARNERS)
def test_updates_that_can_be_captured_are_well(kind: str, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    graphs(monkeypatch, Falling)
    assert doctor.try_updates(kind, name, "cpu", "compiled") == (True, f"updates of a small {name} are repeated without Python on CPU")


@pytest.mark.parametrize(("kind", "name"), LEARNERS)
def test_those_that_cannot_are_a_finding(kind: str, name: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    graphs(monkeypatch, Failing)
    found = doctor.try_updates(kind, name, "cpu", "compiled")
    assert found == (False, f"updates of a small {name} cannot be captured, and go one by one on CPU")
    assert "not today" in capfd.readouterr().err
    assert doctor.try_updates(kind, name, "cpu", "eager") == found


@pytest.mark.parametrize(("kind", "name"), LEARNERS)
def test_numbers_that_are_not_finite_are_a_finding(kind: str, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    graphs(monkeypatch, Falling)
    made = plugins.load(kind, name)
    learn = made.learn

    def broken(self: Any, batch: Any, plan: Any) -> Any:
        result = learn(self, batch, plan)
        with torch.no_grad():
            next(self.parameters()).fill_(torch.nan)
        return result

    monkeypatch.setattr(made, "learn", broken)
    good, how = doctor.try_updates(kind, name, "cpu", "compiled")
    assert not good
    assert how.endswith("are repeated without Python on CPU, with results that are not finite")


def test_with_cuda_both_are_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = []

    def one(kind: str, name: str, device: str) -> tuple[bool, str]:
        tried.append((kind, name, device))
        return name == "td3", f"{name}: so"

    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(doctor, "try_updates", one)
    good, said = doctor._updates()
    assert tried == [(*learner, "cuda") for learner in LEARNERS]
    assert not good
    assert said.startswith("long runs on a CPU are compiled")
    assert said.endswith("; td3: so; cudc: so")
