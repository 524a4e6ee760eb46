"""What the benchmark of updates on a GPU computes itself, without one: operations, targets, and its table."""

from __future__ import annotations

from functools import partial

import pytest

from benchmarks.cuda import BF16, CASES, ENGINES, TARGETS, Measured, make, row, run, target_of
from benchmarks.updates import drawing_updates, operations_of


def measured(**values: object) -> Measured:
    given = {
        "name": "td3", "members": 4, "precision": "tf32", "operations": 4e9, "peak": 1e13, "kernels": {"graph": 215.0}, "failed": {},
        "milliseconds": {"eager": 6.0, "graph": 2.0, "compiled": 1.0},
    }  # fmt: skip
    return Measured(**(given | values))  # type: ignore[arg-type]


def test_the_fastest_engine_is_compared_with_the_target_and_with_what_its_arithmetic_needs() -> None:
    found = row(measured())
    assert found.what == "td3 x 4, tf32"
    assert found.measured == "eager 6.000 ms; graph 2.000 ms (215 kernels); compiled 1.000 ms"
    assert found.against == "4.0 GFLOP, 0.400 ms at 10 TFLOP/s"
    assert (found.ratio, found.target, found.met) == ("40%", "≤ 1.2 ms", True)
    missed = row(measured(milliseconds={"graph": 1.3}))
    assert (missed.ratio, missed.met) == ("31%", False)


def test_an_engine_that_does_not_work_is_no_success_however_fast_the_others_are() -> None:
    found = row(measured(milliseconds={"graph": 0.5}, failed={"compiled": "no Triton"}))
    assert found.measured.endswith("; compiled failed: no Triton")
    assert not found.met
    nothing = row(measured(milliseconds={}, kernels={}, failed=dict.fromkeys(ENGINES, "out of memory")))
    assert (nothing.ratio, nothing.met) == ("0%", False)


def test_bfloat16_is_to_take_a_third_less_and_float32_has_no_target() -> None:
    assert set(TARGETS) <= set(CASES)
    for (name, members), target in TARGETS.items():
        assert target_of(name, members, "tf32") == target
        assert target_of(name, members, "bf16") == pytest.approx(target * BF16)
        assert target_of(name, members, "float32") is None
    assert target_of("cql", 4, "tf32") is None


def test_operations_are_those_of_the_products_and_proportional_to_members() -> None:
    """Behaviour cloning by hand: three products forwards, and backwards two for each but the first, whose input needs no gradient."""
    batch, width = 10, 7
    for members in (1, 3):
        learner = make("bc", members, "cpu", {"width": width, "batch_size": batch})
        layers = [24 * width, width * width, width * 6]
        expected = members * 2 * batch * (3 * sum(layers) - layers[0])
        assert operations_of(partial(drawing_updates(learner, "eager", 1), False)) == expected


def test_without_cuda_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    (line,) = run()
    assert (line.measured, line.against) == ("", "not measured: PyTorch finds no CUDA here")
