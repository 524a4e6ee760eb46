"""Evaluating episodes side by side, and training twenty members in one stack, against one after the other."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch

import cudc_bench
from benchmarks.measure import Row, fastest_interleaved
from cudc_bench import plugins
from cudc_bench.envs import DOMAINS
from cudc_bench.evaluators.running.loop import Arena
from cudc_bench.execution.parallel import cores

EPISODES, TASKS, SEEDS = 10, ("stand", "walk", "run", "flip"), (1, 2, 3, 4, 5)
# Gradient steps of the comparison, and steps of each dataset; a dataset of the cpu profile has 400,000.
SIZES = {"smoke": (2_000, 3_000), "cpu": (1_000, 400_000)}

# One process for all twenty: as on CUDA, where the product stacks by itself.
_STACKED = """
import sys
import torch
from pathlib import Path
from cudc_bench.artefacts.manifest import read_manifest
from cudc_bench.evaluators.running.evaluate import evaluate_members
from cudc_bench.evaluators.running.plans import make_plans
from cudc_bench.evaluators.running.runs import Run, Stack
from cudc_bench.runs.execution import Execution
from cudc_bench.settings.profiles import PROFILES
profile, steps, *ids = sys.argv[1:]
torch.set_num_threads(%d)
settings = {"evaluate_every": steps, "milestones": f"[{steps}]", "evaluation_episodes": 1, "final_episodes": 1}
(plan,) = make_plans(["td3"], PROFILES[profile], settings, int(steps))
runs = [Run(plan, one, there, None, there.seed, Path("stacked")) for one, there in ((one, read_manifest(one)) for one in ids)]
execution = Execution(checkpoint_every=1e9, overwrite=True)
evaluate_members(lambda n: None, stack=Stack("cpu", runs), execution=execution, reward=None, policies=False)
"""


def run() -> Iterator[Row]:
    """Evaluation at two sizes, and stacks at two profiles."""
    for width in (1024, 128):
        yield _evaluation(width)
    with tempfile.TemporaryDirectory() as folder:
        for profile in SIZES:
            yield from _stack(profile, Path(folder))


def _evaluation(width: int) -> Row:
    torch.set_num_threads(cores())
    kind = plugins.load("evaluators", "td3")
    agent = kind(24, 6, kind.configure(settings={"width": width}), [1])
    together, alone = Arena(DOMAINS["walker"], ["walk"]), Arena(DOMAINS["walker"], ["walk"])
    seeds = list(range(EPISODES))
    side, turns = fastest_interleaved(
        [lambda: together.returns(agent, [seeds]), lambda: [alone.returns(agent, [[seed]]) for seed in seeds]], rounds=2
    )
    what = f"evaluating {EPISODES} episodes, width {width}"
    return Row(what, f"{side:.2f} s", f"one by one {turns:.2f} s", f"{turns / side:.1f}x", "≥ 2x", turns / side >= 2)


def _stack(profile: str, folder: Path) -> Iterator[Row]:
    steps, size = SIZES[profile]
    root = folder / profile
    environment = os.environ | {"MINARI_DATASETS_PATH": str(root / "datasets"), "OMP_NUM_THREADS": ""}
    before = os.environ.get("MINARI_DATASETS_PATH")
    os.environ["MINARI_DATASETS_PATH"] = environment["MINARI_DATASETS_PATH"]
    try:
        bases = cudc_bench.collect("random", seeds=SEEDS, profile=profile, settings={"steps": size}, workers=None)
        ids = [one for base in bases for one in cudc_bench.relabel(base)]
    finally:
        if before is None:
            del os.environ["MINARI_DATASETS_PATH"]
        else:
            os.environ["MINARI_DATASETS_PATH"] = before
    environment.pop("OMP_NUM_THREADS")
    settings = ["evaluate_every", "milestones", "evaluation_episodes", "final_episodes"]
    values = [steps, f"[{steps}]", 1, 1]
    command = [
        sys.executable,
        "-m",
        "cudc_bench.cli.app",
        "evaluate",
        "--dataset-id",
        ",".join(ids),
        "--profile",
        profile,
        "--steps",
        str(steps),
    ]
    command += ["--no-policy", *(word for name, value in zip(settings, values, strict=True) for word in ("--set", f"{name}={value}"))]
    separate = _measured(command, environment, root)
    stacked = _measured([sys.executable, "-c", _STACKED % cores(), profile, str(steps), *ids], environment, root)
    what = f"TD3, 4 tasks x 5 seeds, {profile}, {steps:,} steps of {size:,}"
    against = f"20 runs, {cores()} at once: {separate[0]:.1f} s"
    yield Row(f"{what}, one stack", f"{stacked[0]:.1f} s", against, f"{separate[0] / stacked[0]:.2f}x", "", True)
    yield Row(
        f"{what}, memory",
        f"{stacked[1]:.2f} GiB",
        f"{cores()} at once: {separate[1]:.2f} GiB",
        f"{separate[1] / stacked[1]:.2f}x",
        "",
        True,
    )


def _measured(command: Sequence[str], environment: dict[str, str], folder: Path) -> tuple[float, float]:
    """Seconds of a command, and the most memory (GiB) that it and its children held together."""
    start = time.perf_counter()
    process = subprocess.Popen(
        command, env=environment, cwd=folder, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    most = [0]
    callback = threading.Thread(target=_watch, args=(process, most))
    callback.start()
    _, said = process.communicate()
    seconds = time.perf_counter() - start
    callback.join()
    if process.returncode:
        raise RuntimeError(said.decode())
    return seconds, most[0] / 2**20


def _watch(process: subprocess.Popen[bytes], most: list[int]) -> None:
    """Proportional memory (kB) of all processes of a session, as long as its first one lives."""
    while process.poll() is None:
        total = 0
        for entry in Path("/proc").iterdir():
            if not entry.name.isdigit():
                continue
            try:
                if int((entry / "stat").read_text().rpartition(")")[2].split()[3]) == process.pid:
                    rollup = (entry / "smaps_rollup").read_text()
                    total += int(next(line for line in rollup.splitlines() if line.startswith("Pss:")).split()[1])
            except (OSError, StopIteration):
                continue
        most[0] = max(most[0], total)
        time.sleep(0.05)
