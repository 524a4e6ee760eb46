"""``--precision``: what becomes coarser and what stays float32, who may ask for it, and that it is written down."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

import cudc_bench
from cudc_bench.artefacts.manifest import read_manifest
from cudc_bench.artefacts.records import read_record
from cudc_bench.cli.options import with_precision
from cudc_bench.collectors.contract import batch_for, make
from cudc_bench.errors import UsageError
from cudc_bench.evaluators.bc import BCConfig
from cudc_bench.learning import bf16, networks
from cudc_bench.learning.learner import Learner, set_precision
from cudc_bench.learning.networks import Linear, MemberRandom, bf16_products


def test_wide_products_are_rounded_and_narrow_ones_are_not() -> None:
    torch.manual_seed(0)
    for inputs, outputs, coarse in ((64, 64, True), (128, 256, True), (24, 256, False), (256, 6, False)):
        layer = Linear(MemberRandom([1, 2], "weights"), inputs, outputs)
        torch.nn.init.normal_(layer.bias)
        x = torch.randn(2, 32, inputs)
        exact = layer(x)
        with bf16_products():
            found = layer(x)
        assert found.dtype == torch.float32
        # What bfloat16 itself gives: factors of 8 bits, the product's too.
        rounded = torch.bmm(x.bfloat16().double(), layer.weight.bfloat16().double())
        if coarse:
            assert not torch.equal(found, exact)
            torch.testing.assert_close((found - layer.bias).double(), rounded, atol=1e-3, rtol=2**-7)
        else:
            assert torch.equal(found, exact)
    assert torch.equal(layer(x), exact)


def test_gradients_are_float32_and_close_to_the_exact_ones() -> None:
    layer = Linear(MemberRandom([1], "weights"), 128, 128)
    x = torch.randn(1, 64, 128, generator=torch.Generator().manual_seed(0), requires_grad=True)
    found = []
    for coarse in (False, True):
        layer.zero_grad()
        x.grad = None
        if coarse:
            with bf16_products():
                layer(x).square().sum().backward()
        else:
            layer(x).square().sum().backward()
        assert layer.weight.grad is not None
        assert x.grad is not None
        found.append((layer.weight.grad.clone(), x.grad.clone()))
    for exact, near in zip(*found, strict=True):
        assert near.dtype == torch.float32
        assert not torch.equal(exact, near)
        # Errors of 2^-8 in each factor, averaged over many terms.
        assert float((near - exact).norm() / exact.norm()) < 0.01


@pytest.mark.parametrize("name", ["cudc", "aps", "td3", "cql"])
def test_updates_are_coarser_and_acting_is_not(name: str) -> None:
    from cudc_bench.evaluators import contract

    def build() -> tuple[Any, Any]:
        if name in ("cudc", "aps"):
            learner = make(name, width=64, **({"feature_dim": 64} if name == "cudc" else {}))
            return learner, batch_for(learner, measure=True)
        learner = contract.make(name, width=64)
        return learner, contract.batch_for(learner, measure=True)

    metrics, acts = [], []
    for precision in ("float32", "bf16"):
        learner, batch = build()
        set_precision(learner, precision)  # type: ignore[arg-type]
        assert isinstance(learner, Learner)
        observation = torch.ones(1, 24) if name in ("cudc", "aps") else torch.ones(1, 70, 24)
        acts.append(learner.act(observation, False) if name in ("cudc", "aps") else learner.act(observation))  # type: ignore[operator]
        metrics.append(learner.update(batch))
        assert all(parameter.dtype == torch.float32 for parameter in learner.parameters())
        assert all(
            value.dtype in (torch.float32, torch.int64)
            for optimiser in learner.optimisers.values()
            for state in optimiser.state.values()
            for value in state.values()
        )
    assert torch.equal(*acts)
    losses = [key for key in metrics[0] if "loss" in key]
    assert any(not torch.equal(metrics[0][key], metrics[1][key]) for key in losses)
    for key in losses:
        torch.testing.assert_close(metrics[1][key], metrics[0][key], atol=0.02, rtol=0.02)


def test_it_is_an_override_that_is_written_down_and_never_the_default(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # So narrow a learner has no coarse products, and is not timed; here it is.
    monkeypatch.setattr(networks, "WIDE", 16)
    monkeypatch.setattr(bf16, "slowdown", lambda rows, width, rounded: 2.06)
    bf16._echo_if_slower.cache_clear()
    (plain,) = cudc_bench.collect("icm", profile="smoke")
    assert "bf16" not in capsys.readouterr().err
    (coarse,) = cudc_bench.collect("icm", profile="smoke", settings={"precision": "bf16"}, dataset_id="walker/coarse-v0")
    assert "precision" not in read_manifest(plain).hyperparameters
    manifest = read_manifest(coarse)
    assert manifest.overrides == {"precision": "bf16"}
    assert manifest.hyperparameters["precision"] == "bf16"
    assert manifest.hyperparameters_hash != read_manifest(plain).hyperparameters_hash
    assert "--set precision=bf16" in manifest.command
    paths = cudc_bench.evaluate(
        "td3", methods=["icm"], tasks=["walk"], profile="smoke", settings={"precision": "bf16"}, output=tmp_path, policies=False
    )
    record = read_record(paths[0])
    assert record.group == 'smoke (evaluate: precision="bf16")'
    assert "--set precision=bf16" in record.command
    line = "bf16 products take 2.1x as long as float32's on this processor at batch 32 and width 16, with the rounding of their factors; "
    assert capsys.readouterr().err.count(f"{line}float32 is the faster choice here\n") == 1, "once a process, not for each command"


@pytest.mark.parametrize(
    ("precision", "engine", "device", "width", "said"),
    [
        ("bf16", "eager", "cpu", 128, [(128, 128, False)]),
        ("bf16", "compiled", "cpu", 1024, [(256, 1024, True)]),
        ("bf16", "eager", "cpu", 32, []),
        ("bf16", "graph", "cuda", 128, []),
        ("float32", "eager", "cpu", 128, []),
    ],
)
def test_a_product_is_timed_where_one_is_coarse_and_only_then(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    precision: Any,
    engine: str,
    device: str,
    width: int,
    said: list[Any],
) -> None:
    timed: list[tuple[int, int, bool]] = []

    def slowdown(rows: int, width: int, rounded: bool) -> float:
        timed.append((rows, width, rounded))
        return 2.0 if rounded else 0.5

    monkeypatch.setattr(bf16, "slowdown", slowdown)
    bf16._echo_if_slower.cache_clear()
    for _ in range(2):
        bf16.echo_if_slower(precision, BCConfig(batch_size=width, width=width), engine, device)
    bf16._echo_if_slower.cache_clear()
    assert timed == said
    assert ("float32 is the faster choice" in capsys.readouterr().err) == (said == [(256, 1024, True)]), "the slower one is named, only it"


@pytest.mark.parametrize("rounded", [False, True])
def test_timing_leaves_nothing_behind(rounded: bool) -> None:
    before, threads = torch.get_rng_state(), torch.get_num_threads()
    # Whichever is faster here, they do the same arithmetic: a few rows and many stay within what processors can differ by.
    assert 0.1 < bf16.slowdown(64, 64, rounded) < 1000
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.get_num_threads() == threads


def test_what_is_very_slow_is_not_timed_at_length(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[int] = []

    def slow(rows: int, width: int, rounded: bool) -> tuple[float, float]:
        tried.append(rows)
        return 90.0, 0.03

    monkeypatch.setattr(bf16, "_slowdown", slow)
    assert bf16.slowdown(256, 1024) == 90.0
    assert tried == [8]


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(UsageError, match=r"precision=tf32 is for CUDA; on a CPU choose float32 or bf16\."):
        cudc_bench.collect("icm", profile="smoke", device="cpu", settings={"precision": "tf32"})
    with pytest.raises(UsageError, match=r"'precision' cannot be 'half'.*'float32', 'tf32' or 'bf16'"):
        cudc_bench.evaluate("td3", profile="smoke", settings={"precision": "half"})
    with pytest.raises(UsageError, match="say the same"):
        with_precision({"precision": "bf16"}, "bf16")
    assert with_precision({"steps": "3"}, "bf16") == {"steps": "3", "precision": "bf16"}
