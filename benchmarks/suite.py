"""What suites cost beside their work: two workers against one, and the time in which a worker has nothing to do."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from datetime import datetime
from itertools import pairwise
from pathlib import Path

from benchmarks.measure import Row

# 36 datasets and 72 records: about two minutes of work for one core, so that the start of PyTorch in each process is a small part.
MANY = ("main", "--profile", "smoke", "--seeds", "1-2", "--tasks", "stand,walk,reach_top_left,reach_top_right")
_LINES = re.compile(r"^# (\S+), process \d+: .*$(?:.*?)^# done after ([0-9.]+) s$", re.MULTILINE | re.DOTALL)


def run() -> Iterator[Row]:
    """As processes, in folders of their own."""
    with tempfile.TemporaryDirectory() as folder:
        one, two = (_seconds(Path(folder) / str(workers), workers) for workers in (1, 2))
        yield Row(
            "suite main at smoke sizes, 72 records: two workers", f"{two:.0f} s", f"one {one:.0f} s", f"{one / two:.2f}x", "≥ 1.7x",
            one / two >= 1.7,
        )  # fmt: skip
        spans = sorted(_spans(Path(folder) / "1"))
        work = sum(end - start for start, end in spans)
        gaps = sum(later[0] - earlier[1] for earlier, later in pairwise(spans))
        each = f"{1e3 * gaps / len(spans):.0f} ms for each of {len(spans)} jobs"
        yield Row(
            "scheduling: between the jobs of one worker", each, f"work {work:.0f} s", f"{gaps / work:.2%}", "≤ 2 %", gaps <= 0.02 * work
        )
        yield Row("start of command and worker, leaderboard", f"{one - work - gaps:.1f} s", "once a suite", "", "", True)


def _seconds(place: Path, workers: int) -> float:
    """Wall time of a suite from nothing."""
    place.mkdir()
    environment = os.environ | {"MINARI_DATASETS_PATH": str(place / "datasets"), "CUDC_BENCH_THRESHOLDS": str(place / "thresholds.json")}
    command = [sys.executable, "-m", "cudc_bench.cli", "run", *MANY, "--workers", str(workers)]
    start = time.perf_counter()
    subprocess.run(command, cwd=place, env=environment, capture_output=True, check=True)
    return time.perf_counter() - start


def _spans(place: Path) -> Iterator[tuple[float, float]]:
    """When each job started and ended, from its log."""
    for log in (place / "results" / ".suite" / "logs").glob("*.log"):
        for when, seconds in _LINES.findall(log.read_text()):
            start = datetime.fromisoformat(when).timestamp()
            yield start, start + float(seconds)
