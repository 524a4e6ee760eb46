"""What it costs to keep a run's state: one checkpoint against the minute of work after which the next one is due."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.measure import Row
from cudc_bench import plugins
from cudc_bench.collectors.running.dataset_sink import DatasetSink
from cudc_bench.collectors.running.loop import _Run as Collection
from cudc_bench.collectors.running.run_spec import resolve
from cudc_bench.envs import check_domain
from cudc_bench.evaluators.contract import batch_for
from cudc_bench.execution import CHECKPOINT_EVERY
from cudc_bench.execution.checkpoints import Checkpoints
from cudc_bench.execution.runlog import open_log
from cudc_bench.settings.profiles import PROFILES

PROFILES_MEASURED = ("cpu", "paper")
STEPS = 24_000  # almost a full shard of episodes that is not on the disk yet


def run() -> Iterator[Row]:
    """Collecting with CUDC and training TD3, at two profiles."""
    with tempfile.TemporaryDirectory() as folder:
        for profile in PROFILES_MEASURED:
            yield _collect(profile, Path(folder) / f"collect-{profile}")
            yield _evaluate(profile, Path(folder) / f"evaluate-{profile}")


def _collect(profile: str, folder: Path) -> Row:
    # A few updates fill the optimisers; more would change no size.
    setting = resolve("cudc", "walker", PROFILES[profile], {"update_every": 8_000})
    collector = setting.kind(setting.sizes, setting.config, [1])
    folder.mkdir()
    with open_log(None) as log:
        run = Collection(collector, setting.loop, check_domain("walker"), [DatasetSink(folder, log)], None)
        while run.steps < STEPS:
            run.step()
        return _row(f"collecting with CUDC, {profile}", folder, run.state)


def _evaluate(profile: str, folder: Path) -> Row:
    kind = plugins.load("evaluators", "td3")
    agent = kind(24, 6, kind.configure(PROFILES[profile].evaluate), [1])
    agent.update(batch_for(agent))
    outcomes = [[[(step * 1000, [100.0] * 10) for step in range(50)], [], [(step, {"critic_loss": 1.0}) for step in range(50)]]]
    return _row(f"training TD3, {profile}", folder, lambda: {"agent": agent.state_dict(), "outcomes": outcomes})


def _row(what: str, folder: Path, state: Any) -> Row:
    checkpoints = Checkpoints(folder / "checkpoints", {"what": what})
    start = time.perf_counter()
    checkpoints.save(1, state())
    seconds = time.perf_counter() - start
    size = sum(path.stat().st_size for path in (folder / "checkpoints").glob("*.pt")) / 1e6
    start = time.perf_counter()
    checkpoints.load(lambda step, state: None)
    loading = time.perf_counter() - start
    share = seconds / CHECKPOINT_EVERY
    measured = f"{seconds * 1e3:.0f} ms, {size:.1f} MB, read in {loading * 1e3:.0f} ms"
    return Row(f"a checkpoint, {what}", measured, f"{CHECKPOINT_EVERY:.0f} s", f"{share:.2%}", "≤ 2 %", share <= 0.02)
