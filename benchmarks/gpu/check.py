"""Tries a machine with a GPU: ``python -m benchmarks.gpu.check``, or ``gpu-check.sh`` of the bundle (see ``make gpu-bundle``).

Each part is a process with a time limit and a log of its own. What fails does not end the others.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.cuda import CASES
from benchmarks.gpu.parts import ENGINES, SKIPPED, chosen
from cudc_bench.execution.parallel import cores
from cudc_bench.execution.progress import bars, echo

PROJECT = Path(__file__).resolve().parents[2]
SECONDS = {"cuda": 240, "cpu": 3600}  # in all
SLOWER = {"cuda": 1, "cpu": 15}  # so many times a part's limit
GRACE = 3  # seconds in which a part whose time is over may say what it has
SHARES = {"eager": 3, "graph": 3, "compiled": 4}  # processes among which the learners of a kind are cut up
_running: set[subprocess.Popen[bytes]] = set()


@dataclass(frozen=True)
class Part:
    """One thing to try.

    Attributes:
        name: of its row and its log.
        command: what Python is called with.
        limit: seconds.
        environment: beside this process's own.
    """

    name: str
    command: tuple[str, ...]
    limit: float
    environment: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Result:
    """What came of a part.

    Attributes:
        name: the part's.
        state: ``ok``, ``failed`` or ``skipped``.
        seconds: it took.
        said: its last line.
    """

    name: str
    state: str
    seconds: float
    said: str


def main() -> None:
    """Try all parts and leave with 1 if one of them failed."""
    parser = argparse.ArgumentParser(prog="gpu-check.sh", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda", help="cpu tries the same with small sizes")
    parser.add_argument("--output", type=Path, default=Path(os.environ.get("OUT", "gpu-check-results")), help="the folder of results")
    parser.add_argument("--seconds", type=float, help=f"in all; by default {SECONDS['cuda']}, and {SECONDS['cpu']} on a CPU")
    parser.add_argument("--only", help="parts whose names begin with one of these, with commas between them")
    given = parser.parse_args()
    output = given.output.resolve()
    output.mkdir(parents=True, exist_ok=True)
    together, alone = parts(given.device, output)
    if given.only:
        wanted = tuple(given.only.split(","))
        together, alone = ([part for part in some if part.name.startswith(wanted)] for some in (together, alone))
        if not together and not alone:
            parser.error(f"no part is called like {given.only}; see the table of a whole check")
    # As Ctrl-C does: parts end with this process.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    results = carry_out(together, alone, output, given.seconds or SECONDS[given.device])
    show(results, output)
    sys.exit(any(one.state == "failed" for one in results))


def parts(device: str, output: Path) -> tuple[list[Part], list[Part]]:
    """What can be done side by side, the longest first; and what has the GPU for itself, one after another."""
    slower, small = SLOWER[device], device == "cpu"
    one = ("-m", "benchmarks.gpu.parts")
    options = ("--device", device, *(("--small",) if small else ()))
    single = {"OMP_NUM_THREADS": "1"}
    together = [
        Part(f"compile {name} x {members}", (*one, "compile", name, str(members)), 100 * slower, single)
        for name, members in (CASES if device == "cuda" else ())
    ]
    pytest = ("-m", "pytest", "-p", "no:cacheprovider", "-n", "3", "-m", "cuda")
    together.append(Part("tests", (*pytest, *gpu_tests()), 120 * slower, single))
    for engine in reversed(ENGINES[device]):
        for kind in ("collectors", "evaluators"):
            names = chosen(kind, engine, small)
            shares = min(len(names), SHARES[engine])
            for share in range(shares):
                some = names[share::shares]
                command = (*one, "learners", kind, *some, "--engine", engine, *options)
                together.append(Part(f"{kind}, {engine}, {share + 1} of {shares}", command, 100 * slower, single))
    together += [Part(name, (*one, name, *options), 90 * slower, single) for name in ("resume", "repeat")]
    together.append(Part("doctor", ("-m", "cudc_bench.cli", "doctor"), 40 * slower))
    alone = [
        Part("speed", (*one, "speed", str(output / "speed.json")), 100 * slower),
        Part("paper", (*one, "paper", *options), 60 * slower),
    ]
    return together, alone


def gpu_tests() -> list[str]:
    """Files with tests that need a GPU."""
    found = [path for path in sorted(PROJECT.glob("tests/**/test_*.py")) if "pytest.mark.cuda" in path.read_text()]
    return [str(path.relative_to(PROJECT)) for path in found]


def carry_out(together: Iterable[Part], alone: Iterable[Part], output: Path, seconds: float) -> list[Result]:
    """The results in the order of the parts; what does not begin within so many seconds has failed."""
    together, alone = list(together), list(alone)
    end = time.monotonic() + seconds
    with tempfile.TemporaryDirectory() as work, bars([("gpu-check", len(together) + len(alone))], "parts") as (advance,):

        def do(part: Part) -> Result:
            result = attempt(part, output, Path(work), end - time.monotonic())
            echo(f"{result.state:<8} {result.seconds:4.0f} s  {result.name}: {result.said}")
            advance(1)
            return result

        with ThreadPoolExecutor(max(1, cores() - 2)) as pool:
            try:
                results = list(pool.map(do, together))
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                for one in list(_running):
                    _kill(one)
                raise
        return results + [do(part) for part in alone]


def attempt(part: Part, output: Path, work: Path, left: float) -> Result:
    """Carry out a part in a folder of its own within its limit, and within what is left of the time."""
    folder = work / part.name.replace(" ", "-").replace(",", "")
    folder.mkdir(parents=True)
    log = output / f"{folder.name}.log"
    own = {
        "MINARI_DATASETS_PATH": str(folder / "datasets"), "CUDC_BENCH_THRESHOLDS": str(folder / "thresholds.json"),
        "TORCHINDUCTOR_CACHE_DIR": str(work / "compiled"), "PYTHONUNBUFFERED": "1", "COLUMNS": "200",
        "PYTHONPATH": os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), str(PROJECT)])),
    }  # fmt: skip
    limit = min(part.limit, left)
    if limit <= 0:
        return Result(part.name, "failed", 0.0, "there was no time left")
    start = time.monotonic()
    at = PROJECT if "pytest" in part.command else folder
    with log.open("wb") as file:
        process = subprocess.Popen(
            [sys.executable, *part.command], cwd=at, env=os.environ | own | dict(part.environment), stdout=file, stderr=file,
            start_new_session=True,
        )  # fmt: skip
        _running.add(process)
        try:
            code: int | None = process.wait(limit)
        except subprocess.TimeoutExpired:
            code = None
            # As Ctrl-C does: what was measured until now is shown.
            process.send_signal(signal.SIGINT)
            with suppress(subprocess.TimeoutExpired):
                process.wait(GRACE)
        finally:
            _kill(process)
            _running.discard(process)
    return judge(part.name, code, time.monotonic() - start, log.read_text(errors="replace"))


def _kill(process: subprocess.Popen[bytes]) -> None:
    """End a part with all that it started."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def judge(name: str, code: int | None, seconds: float, text: str) -> Result:
    """What came of a part, by its exit code (None: its time was over) and its last line, in which pytest says that it left all out."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    said = lines[-1][:300] if lines else ""
    if code is None:
        return Result(name, "failed", seconds, f"not done in {seconds:.0f} s; so far: {said}")
    if code == SKIPPED or (code == 0 and "skipped" in said and "passed" not in said):
        return Result(name, "skipped", seconds, said)
    if code:
        return Result(name, "failed", seconds, said or f"exit code {code}")
    return Result(name, "ok", seconds, said)


def show(results: list[Result], output: Path) -> None:
    """Print the table, and keep it as ``summary.txt`` and ``summary.json``."""
    (output / "summary.json").write_text(json.dumps([asdict(one) for one in results], indent=1) + "\n")
    counts = {state: sum(one.state == state for one in results) for state in ("ok", "failed", "skipped")}
    table = Table(title=", ".join(f"{count} {state}" for state, count in counts.items()))
    for column in ("part", "result", "seconds", "its last line"):
        table.add_column(column)
    for one in results:
        table.add_row(one.name, one.state, f"{one.seconds:.0f}", one.said[:100])
    Console(width=160).print(table)
    with (output / "summary.txt").open("w") as file:
        Console(file=file, width=160).print(table)
    print(f"logs: {output}")


if __name__ == "__main__":
    main()
