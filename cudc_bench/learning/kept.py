"""Compiled functions on the disk: what was compiled here before is loaded as it is, without PyTorch's compiler, whose import and tracing
take seconds in every process.

On a CPU a compiled function is a library with one entry that takes tensors and changes them in place. A file here is that library and,
after it, where the system's loader does not look, a hash of it and of its key: half of a file, one that was damaged, and one of another
key are never loaded.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from importlib.machinery import ExtensionFileLoader
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from cudc_bench.files import write_atomically

_ENTRY = "inductor_entry_cpp"  # of the libraries that PyTorch's compiler makes; the name of their module, too
_HASH = hashlib.sha256().digest_size
_VARIABLES = ("TORCHINDUCTOR_", "TORCH_", "ATEN_", "ONEDNN_", "DNNL_")
_ADDRESS = "_TORCHINDUCTOR_PYOBJECT_TENSOR_DATA_PTR"

Function = Callable[[list[Tensor]], Any]


@cache
def compiler() -> str:
    """The path of the C++ compiler and what it says about itself; empty where there is none."""
    if (path := shutil.which(os.environ.get("CXX", "g++"))) is None:
        return ""
    try:
        said = subprocess.run([path, "--version"], capture_output=True, text=True, timeout=60, check=False).stdout
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return f"{path} {said.partition(chr(10))[0]}"


@cache
def machine() -> str:
    """What compiled code depends on beside the update: the builds of Python, PyTorch and the C library, the compiler, and the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    of_processor = sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))})
    return "\n".join(
        [
            sys.version, platform.machine(), " ".join(platform.libc_ver()), torch.__version__, str(torch.version.git_version),
            torch.backends.cpu.get_cpu_capability(), compiler(), *of_processor,
        ]
    )  # fmt: skip


def settings(but: str) -> str:
    """What people can set that compiled code depends on: PyTorch's modes, and variables of it and of its libraries but for one."""
    own = sorted((name, value) for name, value in os.environ.items() if name.startswith(_VARIABLES) and name != but)
    modes = torch.get_num_threads(), torch.are_deterministic_algorithms_enabled(), torch.get_float32_matmul_precision()
    return f"{modes} {own}"


def library_of(compiled: Any) -> Path | None:
    """The library that the compiler made of a function for a CPU; None if that is not all there is to it."""
    names = getattr(getattr(compiled, "current_callable", None), "__globals__", {})
    entry = names.get("inductor_entry")
    path = getattr(getattr(entry, "__self__", None), "__file__", None)
    # Constants would be arguments more, which the library does not hold.
    return None if path is None or getattr(compiled, "constants", None) else Path(path)


def keep(path: Path, library: Path) -> None:
    """Copy a library to where it will be looked for.

    Args:
        path: its name is the key.
        library: as the compiler made it.

    Raises:
        OSError: it cannot be read or written.
    """
    content = library.read_bytes()
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, content + _hash(path, content))


def whole(path: Path) -> bool:
    """Whether a file is there as it was written, under the key for which it was."""
    try:
        content = path.read_bytes()
    except OSError:
        return False
    return content[-_HASH:] == _hash(path, content[:-_HASH])


def kept(path: Path) -> Function | None:
    """The function in a file; None where there is none, or nothing that may be loaded."""
    if not whole(path):
        return None
    try:
        return load(path)
    except (ImportError, AttributeError, KeyError):
        # Whole, but made for a system whose libraries are not here.
        return None


def load(library: Path) -> Function:
    """The function in a library, as the compiler's own Python calls it.

    Raises:
        ImportError: it cannot be loaded.
        AttributeError: it has no such entry.
        KeyError: this PyTorch has other ones.
    """
    os.environ[_ADDRESS] = str(vars(torch._C._dynamo.guards)["_torchinductor_pyobject_tensor_data_ptr"])
    loader = ExtensionFileLoader(_ENTRY, str(library))
    spec = importlib.util.spec_from_file_location(_ENTRY, library, loader=loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    entry, handles = getattr(module, _ENTRY), torch._C._aoti.unsafe_alloc_void_ptrs_from_tensors

    def call(tensors: list[Tensor]) -> None:
        entry(handles(tensors))

    return call


def _hash(path: Path, content: bytes) -> bytes:
    return hashlib.sha256(path.name.encode() + b"\0" + content).digest()
