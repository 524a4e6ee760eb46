"""Whole runs: what share of a collection is updates and physics, how far an evaluation is from updates alone, and what acting takes."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch

from benchmarks.measure import Row, fastest
from cudc_bench import plugins
from cudc_bench.collectors.base import Sizes
from cudc_bench.collectors.running.dataset_sink import DatasetSink
from cudc_bench.collectors.running.loop import _Run as Collection
from cudc_bench.collectors.running.run_spec import resolve
from cudc_bench.envs import DOMAINS, check_domain
from cudc_bench.evaluators.contract import random_walker_data
from cudc_bench.evaluators.running.loop import Arena, run_evaluation
from cudc_bench.execution.parallel import cores
from cudc_bench.execution.runlog import open_log
from cudc_bench.settings.evaluate_config import EvaluateConfig
from cudc_bench.settings.profiles import PROFILES

STEPS = {"cpu": 8_000, "paper": 60}  # measured, after the random ones
ACT_US = 60


def run() -> Iterator[Row]:
    """Collecting with CUDC and training TD3 at two profiles, and one action of the 256-wide policy."""
    yield _acting()
    with tempfile.TemporaryDirectory() as folder:
        for profile in STEPS:
            torch.set_num_threads(PROFILES[profile].threads or cores())
            yield _collection(profile, Path(folder) / profile)
    for profile, steps in (("cpu", 1_000), ("paper", 10)):
        torch.set_num_threads(PROFILES[profile].threads or cores())
        yield _evaluation(profile, steps)


def _acting() -> Row:
    torch.set_num_threads(1)
    kind = plugins.load("collectors", "cudc")
    agent = kind(Sizes("walker", 24, 6, 1000, 4000, 2), kind.configure("walker", {"width": 256, "batch_size": 128}), [1])
    observation = torch.rand(1, 24)

    def many() -> None:
        for _ in range(200):
            agent.act(observation)

    with torch.no_grad():
        plain = fastest(lambda: [agent.actor(observation[:, None]) for _ in range(200)], 20) / 200 * 1e6
    found = fastest(many, 20) / 200 * 1e6
    return Row("one exploring action, width 256", f"{found:.0f} µs", f"network alone {plain:.0f} µs", "", f"≤ {ACT_US} µs", found <= ACT_US)


def _collection(profile: str, folder: Path) -> Row:
    setting = resolve("cudc", "walker", PROFILES[profile])
    collector = setting.kind(setting.sizes, setting.config, [1])
    spent = {"learn": 0.0, "simulate": 0.0}
    folder.mkdir()
    with open_log(None) as log:
        run = Collection(collector, setting.loop, check_domain("walker"), [DatasetSink(folder, log)], None)
        while run.steps < setting.loop.seed_steps:
            run.step()
        for name in spent:
            _timed(run, f"_{name}", name, spent)
        start, first = time.perf_counter(), run.steps
        while run.steps < first + STEPS[profile]:
            run.step()
        seconds = time.perf_counter() - start
    share, rate = sum(spent.values()) / seconds, STEPS[profile] / seconds
    parts = f"updates {spent['learn'] / seconds:.1%}, physics {spent['simulate'] / seconds:.1%}"
    return Row(f"collect, CUDC, {profile}: updates and physics", f"{rate:,.0f} steps/s", parts, f"{share:.1%}", "≥ 90 %", share >= 0.9)


def _timed(run: Any, method: str, name: str, spent: dict[str, float]) -> None:
    inner: Callable[[int], None] = getattr(run, method)

    def timed(step: int) -> None:
        start = time.perf_counter()
        inner(step)
        spent[name] += time.perf_counter() - start

    setattr(run, method, timed)


def _evaluation(profile: str, steps: int) -> Row:
    """As often evaluated as in the profile: once in so many gradient steps, by so many episodes."""
    kind = plugins.load("evaluators", "td3")
    agent = kind(24, 6, kind.configure(PROFILES[profile].evaluate), [1])
    data = random_walker_data(5, "walk", [1])
    horizon = torch.ones(1, dtype=torch.int64)
    for _ in range(5):
        agent.update(data.sample(agent.config.batch_size, horizon))
    start = time.perf_counter()
    for _ in range(steps):
        agent.update(data.sample(agent.config.batch_size, horizon))
    alone = (time.perf_counter() - start) / steps
    plain = PROFILES[profile].evaluate
    episodes, every = plain.get("evaluation_episodes", 10), plain.get("evaluate_every", 10_000)
    config = EvaluateConfig(gradient_steps=1, evaluate_every=1, evaluation_episodes=episodes, final_episodes=1, milestones=(1,))
    start = time.perf_counter()
    run_evaluation(agent, data, config, Arena(DOMAINS["walker"], ["walk"]), lambda n: None)
    evaluation = (time.perf_counter() - start - alone) * 2 * episodes / (2 * episodes + 1) / 2
    rate = 1 / (alone + evaluation / every)
    share = alone * rate
    what = f"an evaluation of {episodes} episodes {evaluation:.1f} s"
    return Row(f"evaluate, TD3, {profile}: updates", f"{rate:,.0f} gradient steps/s", what, f"{share:.1%}", "", True)
