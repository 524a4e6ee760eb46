"""Peak memory of a collection of a million steps with CUDC at the paper's size, beyond what importing torch takes."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator

from benchmarks.measure import Row

# getrusage would not do: what it calls the peak starts, in a new process, at the size of the process that started it.
_CODE = """
import re, torch
from pathlib import Path
def peak():
    return int(re.search(r"VmHWM:\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1])
torch.mm(torch.rand(64, 64), torch.rand(64, 64))
base = peak()
import cudc_bench
cudc_bench.collect("cudc", profile="paper", device="cpu", settings={"update_every": 100_000, "measure_every": 1})
print(base, peak())
"""


def run() -> Iterator[Row]:
    """All of the million steps are acted, simulated, stored and written; only most of the updates are left out, since they take hours
    on a CPU and need the same memory every time."""
    with tempfile.TemporaryDirectory() as root:
        environment = os.environ | {"MINARI_DATASETS_PATH": root}
        done = subprocess.run([sys.executable, "-c", _CODE], env=environment, stdout=subprocess.PIPE, text=True, check=True)
    base, most = (int(value) / 2**20 for value in done.stdout.split())
    beyond = most - base
    yield Row("peak memory, 1M steps of CUDC, E=1", f"{beyond:.2f} GiB", f"torch alone {base:.2f} GiB", "", "< 2 GiB", beyond < 2)
