"""What ``gpu-check.sh`` tries, one process a part: ``python -m benchmarks.gpu.parts PART …``, in an empty folder with a root of its own.

Names of methods come from the registry. A part ends with 0, with 1 if something is wrong, or with SKIPPED; its last line says what came
out.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

SKIPPED = 77
ENGINES = {"cuda": ("eager", "graph", "compiled"), "cpu": ("eager", "compiled")}
LONGER = {"steps": 5_000, "seed_steps": 1_000, "update_every": 10}  # of a collection that is interrupted in its middle
SHORT = {"evaluate_every": 200, "milestones": [200, 400], "evaluation_episodes": 1, "final_episodes": 1}


def main() -> None:
    """Do one part."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu.parts")
    parser.add_argument("part", choices=("learners", "repeat", "resume", "paper", "compile", "speed"))
    parser.add_argument("names", nargs="*", help="learners: a kind and names; compile: a name and members; speed: a file")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--engine", default="eager")
    parser.add_argument("--small", action="store_true", help="so little that a CPU can do it")
    given = parser.parse_args()
    # Also where a shell started all of this in the background.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if given.part == "learners":
        kind, *names = given.names
        end(learners(kind, names, given.device, given.engine))
    elif given.part == "compile":
        compile_updates(given.names[0], int(given.names[1]))
    elif given.part == "speed":
        end(speed(given.names[0]))
    else:
        end({"repeat": repeat, "resume": resume, "paper": lambda device: paper(device, given.small)}[given.part](given.device))


def end(wrong: list[str]) -> None:
    """Leave with what was wrong, if anything was."""
    if wrong:
        sys.exit("; ".join(wrong))


def chosen(kind: str, engine: str, small: bool) -> list[str]:
    """The names to try: all, or for an engine whose code takes long to make, one for each class and no variants.

    Args:
        kind: ``collectors`` or ``evaluators``.
        engine: with which.
        small: only the first that learns where it takes long.
    """
    from cudc_bench import plugins
    from cudc_bench.collectors import variants

    names = plugins.names(kind)
    if engine != "compiled":
        return names
    classes = {plugins.load(kind, name): name for name in reversed(names)}
    own = [name for made, name in classes.items() if getattr(made, "learns", True) and made.__module__ != variants.__name__]
    return sorted(own)[: 1 if small else None]


def learners(kind: str, names: list[str], device: str, engine: str) -> list[str]:
    """Collect with methods, or train algorithms, at the smoke profile with two members; what went wrong, each in a line.

    Each must have been carried out by the engine that was asked for.
    """
    import cudc_bench
    from cudc_bench import plugins
    from cudc_bench.artefacts.manifest import read_manifest
    from cudc_bench.artefacts.records import read_record
    from cudc_bench.learning.learner import Learner

    options: dict[str, Any] = {"profile": "smoke", "device": device, "engine": "auto" if engine == "graph" else engine, "seeds": (1, 2)}
    wrong = []
    for name in names:
        start = time.perf_counter()
        try:
            if kind == "collectors":
                made = [read_manifest(one).machine for one in cudc_bench.collect(name, **options)]
            else:
                made = [read_record(path).machine for path in cudc_bench.evaluate(name, methods=["random"], output="results", **options)]
            used = {one.get("engine") for one in made}
            learner = plugins.load(kind, name)
            expected = (engine if issubclass(learner, Learner) and learner.replayable else "eager") if _learns(learner) else None
            if used != {expected}:
                raise RuntimeError(f"carried out as {used}, not as {expected}")
            print(f"ok      {name} {engine} {time.perf_counter() - start:.1f} s", flush=True)
        except Exception as error:  # whatever it is, the others are tried
            wrong.append(f"{name}: {(str(error).splitlines() or [type(error).__name__])[0][:160]}")
            print(f"failed  {wrong[-1]}", flush=True)
    print(f"{len(names) - len(wrong)} of {len(names)}")
    return wrong


def _learns(learner: Any) -> bool:
    return bool(getattr(learner, "learns", True))


def repeat(device: str) -> list[str]:
    """The same seed twice gives the same data and the same returns."""
    found = []
    for turn in ("first", "second"):
        with in_folder(turn):
            found.append(_collected(device, {}) + _trained(device))
    print(f"data {found[0][0][:12]}, twice")
    return [] if found[0] == found[1] else [f"the second time came out differently: {found}"]


def resume(device: str) -> list[str]:
    """A collection and a training that are interrupted in their middle and continued give what they give uninterrupted."""
    with in_folder("whole"):
        whole = _collected(device, LONGER) + _trained(device)
    with in_folder("interrupted"):
        for work in (lambda: _collected(device, LONGER), lambda: _trained(device)):
            if not _interrupt(work):
                return ["it could not be interrupted"]
        continued = _collected(device, LONGER) + _trained(device)
    print(f"data {whole[0][:12]}, interrupted and not")
    return [] if continued == whole else [f"the interrupted run came out differently: {whole}, {continued}"]


def _collected(device: str, settings: dict[str, Any]) -> list[Any]:
    import cudc_bench
    from cudc_bench.artefacts.manifest import read_manifest

    ids = cudc_bench.collect("cudc", profile="smoke", device=device, seeds=(1, 2), settings=settings, checkpoint_every=0)
    return [read_manifest(one).fingerprint for one in ids]


def _trained(device: str) -> list[Any]:
    import cudc_bench
    from cudc_bench.artefacts.records import read_record

    paths = cudc_bench.evaluate(
        "td3", methods=["random"], tasks=["walk", "run"], profile="smoke", device=device, steps=400, settings=SHORT, output="results"
    )
    return [[one.returns for one in read_record(path).curve] for path in paths]


def _interrupt(work: Callable[[], object]) -> bool:
    """Ask this process to leave in the middle of its work, which is that of the first member where they work one after another; whether it
    left."""
    from cudc_bench.execution.interrupts import Interrupted
    from cudc_bench.execution.progress import listening

    asked = False

    def ask(done: int, total: int) -> None:
        nonlocal asked
        # Datasets of the untrained are made on the way, and not interrupted.
        if not asked and total in (2 * LONGER["steps"], LONGER["steps"], 400, 800) and done >= 0.3 * total:
            asked = True
            os.kill(os.getpid(), signal.SIGTERM)

    try:
        with listening(ask):
            work()
    except Interrupted:
        return True
    return False


@contextmanager
def in_folder(name: str) -> Iterator[None]:
    """Within this context everything is made in a folder of its own."""
    before, root = Path.cwd(), os.environ.get("MINARI_DATASETS_PATH")
    folder = before / name
    folder.mkdir()
    os.chdir(folder)
    os.environ["MINARI_DATASETS_PATH"] = str(folder / "datasets")
    try:
        yield
    finally:
        os.chdir(before)
        os.environ.pop("MINARI_DATASETS_PATH")
        if root is not None:
            os.environ["MINARI_DATASETS_PATH"] = root


def paper(device: str, small: bool) -> list[str]:
    """Some thousand steps of CUDC and of TD3 on four tasks at the paper's sizes."""
    import cudc_bench

    precision = {"precision": "tf32"} if device == "cuda" else {}
    steps, updates = (1_200, 2) if small else (12_000, 2_000)
    collecting: dict[str, Any] = {"steps": steps} | ({"seed_steps": 1_000, "update_every": 100} if small else {})
    start = time.perf_counter()
    ids = cudc_bench.collect("cudc", profile="paper", device=device, settings={**collecting, **precision})
    collected = time.perf_counter()
    cudc_bench.relabel(*ids)
    labelled = time.perf_counter()
    settings = {"evaluate_every": updates, "evaluation_episodes": 1, "final_episodes": 1 if small else 5, **precision}
    cudc_bench.evaluate("td3", dataset_id=ids, profile="paper", device=device, steps=updates, settings=settings, output="results")
    seconds = time.perf_counter() - labelled
    print(f"{steps:,} steps collected in {collected - start:.0f} s, {updates:,} gradient steps of four members in {seconds:.0f} s")
    return []


def compile_updates(name: str, members: int) -> None:
    """Have the updates compiled that the benchmark will measure."""
    from benchmarks.cuda import PRECISIONS, updates_on_card
    from cudc_bench.learning.cuda_graphs import rehearse

    for precision in PRECISIONS:
        start = time.perf_counter()
        rehearse(updates_on_card(name, members, precision, "compiled")[1])
        print(f"{name} x {members} {precision}: {time.perf_counter() - start:.0f} s", flush=True)


def speed(file: str) -> list[str]:
    """The benchmark of updates, with the table in the log and its rows in a file; what failed, which no missed target is."""
    import torch

    from benchmarks.__main__ import main as benchmark

    if not torch.cuda.is_available():
        print("not measured: PyTorch finds no CUDA here")
        sys.exit(SKIPPED)
    rows = benchmark(["cuda", "--json", file])
    aimed = [row for row in rows if row.target]
    print(f"{sum(row.met for row in aimed)} of {len(aimed)} targets met")
    return [f"{row.what}: {row.measured}" for row in rows if "failed" in row.measured]


if __name__ == "__main__":
    main()
