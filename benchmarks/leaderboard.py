"""What a leaderboard of ten thousand records costs: made from nothing, made again, and with one record changed."""

from __future__ import annotations

import json
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import Row
from cudc_bench.artefacts.records import read_record, record_path, to_json
from cudc_bench.envs.domains import DOMAINS
from cudc_bench.leaderboard.api import make_leaderboard
from cudc_bench.leaderboard.intake.load import load_records
from cudc_bench.leaderboard.numbers.overall import build_overall
from cudc_bench.leaderboard.numbers.table import build_tables
from cudc_bench.settings.config import config_hash
from cudc_bench.settings.evaluate_config import EvaluateConfig

RECORDS = 10_000
ALGORITHMS = ("td3", "td3-bc", "cql", "iql", "rebrac")
METHODS = (
    "random", "icm", "apt", "proto", "aps", "cudc", "rnd", "disagreement", "diayn", "smm", "cic", "be", "cudc-reach", "cudc-no-vary",
    "cudc-no-reach", "cudc-literal", "apt-k6",
)  # fmt: skip
SEEDS = range(1, 11)
VALUES = {"width": 1024, "final_evaluations": EvaluateConfig().final_evaluations}


def make_records(results: Path, count: int) -> None:
    """Write that many records of the paper profile's size: of every algorithm, method, seed and task, until there are enough.

    A dataset is better or worse for all of its tasks, and curves rise to what its method reaches, so that statistics find something.
    """
    runs = [(a, m, s, d.name, t) for a in ALGORITHMS for m in METHODS for s in SEEDS for d in DOMAINS.values() for t in d.tasks][:count]
    draw = np.random.default_rng(1)
    skill = {method: draw.uniform(0.1, 0.7) for method in METHODS}
    luck = {(method, seed, domain): draw.normal(0, 0.07) for method in METHODS for seed in SEEDS for domain in DOMAINS}
    for algorithm, method, seed, domain, task in runs:
        score = np.clip(skill[method] + luck[method, seed, domain] + draw.normal(0, 0.05), 0, 1)
        record = _record(draw, algorithm, method, seed, domain, task, float(score))
        path = record_path(results, record["dataset"]["id"], algorithm, seed, "paper")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(record, indent=1))


def _record(draw: np.random.Generator, algorithm: str, method: str, seed: int, domain: str, task: str, score: float) -> dict[str, Any]:
    largest = DOMAINS[domain].max_return
    loop = EvaluateConfig()
    steps = np.arange(0, loop.gradient_steps + 1, loop.evaluate_every)
    shape = (len(steps), loop.evaluation_episodes)
    means = score * (1 - np.exp(-steps / loop.milestones[0]))
    returns = np.clip(means[:, None] + draw.normal(0, 0.03, shape), 0, 1) * largest
    finals = np.clip(means[-1] + draw.normal(0, 0.03, (loop.final_evaluations, loop.final_episodes)), 0, 1) * largest
    late = zip(loop.final_points, finals, strict=True)
    metrics = draw.normal(0, 1, (len(steps) - 1, 5))
    names = ("critic_loss", "actor_loss", "q_mean", "target_mean", "reward_mean")
    return {
        "schema_version": 1,
        "dataset": {
            "id": f"{domain}/{task}/{method}-seed{seed}-v0", "fingerprint": "0" * 64, "domain": domain, "task": task, "method": method,
            "seed": seed, "steps": 1_000_000, "profile": "paper",
        },
        "algorithm": algorithm, "profile": "paper", "seed": seed, "hyperparameters": VALUES,
        "hyperparameters_hash": config_hash(VALUES), "milestones": list(loop.milestones),
        "curve": [{"step": int(step), "returns": row.tolist()} for step, row in zip(steps, returns, strict=True)],
        "late": [{"step": step, "returns": row.tolist()} for step, row in list(late)[:-1]],
        "final": {"step": loop.gradient_steps, "returns": finals[-1].tolist()},
        "metrics": [
            {"step": int(step), "values": dict(zip(names, row.tolist(), strict=True))} for step, row in zip(steps[1:], metrics, strict=True)
        ],
        "seconds": 1.0, "versions": {}, "machine": {}, "created": "2026-01-01T00:00:00+00:00",
        "command": f"cudc-bench evaluate --algo {algorithm} --domain {domain} --method {method} --seed {seed} --task {task}",
    }  # fmt: skip


def run() -> Iterator[Row]:
    """Its parts by themselves, then the whole."""
    with tempfile.TemporaryDirectory() as folder:
        results, report = Path(folder) / "results", Path(folder) / "report"
        make_records(results, RECORDS)

        def make() -> object:
            return make_leaderboard(results, report)

        loaded, reading = _timed(lambda: load_records([results]).records)
        tables, tabulating = _timed(lambda: build_tables(loaded)[0])
        _, statistics = _timed(lambda: build_overall(tables))
        _, cold = _timed(make)
        for what, seconds in (("reading", reading), ("tables", tabulating), ("statistics", statistics)):
            yield Row(
                f"leaderboard of {RECORDS:,}: {what}", f"{seconds:.1f} s", f"the whole {cold:.1f} s", f"{seconds / cold:.0%}", "", True
            )
        yield Row(f"leaderboard of {RECORDS:,}: from nothing", f"{cold:.1f} s", "", "", "≤ 20 s", cold <= 20)
        _, unchanged = _timed(make)
        yield _again("unchanged", unchanged, cold)
        path = next(results.rglob("*.json"))
        record = read_record(path)
        path.write_text(to_json(record.model_copy(update={"final": record.final.model_copy(update={"returns": [1.0] * 50})})))
        _, changed = _timed(make)
        yield _again("one record changed", changed, cold)
        shutil.rmtree(report)


def _again(what: str, seconds: float, cold: float) -> Row:
    return Row(f"leaderboard of {RECORDS:,}: {what}", f"{seconds:.1f} s", f"from nothing {cold:.1f} s", f"{cold / seconds:.1f}x", "", True)


def _timed(function: Callable[[], Any]) -> tuple[Any, float]:
    start = time.perf_counter()
    found = function()
    return found, time.perf_counter() - start
