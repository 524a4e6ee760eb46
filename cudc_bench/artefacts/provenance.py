"""Where a result came from: versions, commit and machine, as every manifest and record states them."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import shlex
import subprocess
from collections.abc import Mapping
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

PACKAGES = ("cudc-bench", "torch", "mujoco", "dm-control", "gymnasium", "minari", "numpy", "h5py")
_ORDINARY = re.compile(r"cudc-bench(?: [a-zA-Z0-9@%+=:,./_-]+)*")  # a command of words that no shell reads anything else from


@cache
def versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on; "missing" for one that is not installed."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "missing"
    return found


@cache
def commit() -> tuple[str | None, bool]:
    """The commit of the checkout that this package runs from, and whether it has local changes; (None, False) outside one."""
    folder = Path(__file__).resolve().parents[2]
    if not (folder / ".git").exists():
        return None, False
    try:
        head = _git(folder, "rev-parse", "HEAD")
        return head, bool(_git(folder, "status", "--porcelain", "--untracked-files=no"))
    except (OSError, subprocess.SubprocessError):
        return None, False


def knows_commit(name: str) -> bool:
    """Whether the checkout that this package runs from has a commit of that full name; False outside one."""
    folder = Path(__file__).resolve().parents[2]
    if re.fullmatch("[0-9a-f]{40}", name) is None or not (folder / ".git").exists():
        return False
    try:
        _git(folder, "cat-file", "-e", f"{name}^{{commit}}")
    except (OSError, subprocess.SubprocessError):
        return False
    return True


def _git(folder: Path, *arguments: str) -> str:
    # Variables such as GIT_DIR, which a hook has for one, would make it speak of another repository.
    env = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    done = subprocess.run(["git", "-C", str(folder), *arguments], env=env, capture_output=True, text=True, check=True, timeout=10)
    return done.stdout.strip()


@cache
def processor() -> str:
    """The processor's name as the system gives it."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


@cache
def instructions() -> str:
    """Those of the processor's instruction sets by which mathematical libraries choose among their versions: ``"avx avx2 fma"``."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return ""
    flags = next((line.partition(":")[2].split() for line in lines if line.startswith("flags")), [])
    return " ".join(name for name in ("avx", "avx2", "avx512f", "fma") if name in flags)


def same_arithmetic(made_with: Mapping[str, str], made_on: Mapping[str, Any]) -> bool:
    """Whether a simulation that was made elsewhere has the same bits here: by the same packages on the same kind of machine.

    Args:
        made_with: versions, as in a manifest.
        made_on: the machine, as in a manifest; what an old one does not name is taken for the same.
    """
    here = machine("cpu", 1)
    same = all(made_with.get(name) == versions()[name] for name in ("mujoco", "dm-control", "numpy"))
    named = {"processor": None} | {name: here[name] for name in ("system", "libc", "instructions")} | dict(made_on)
    return same and all(named[name] == here[name] for name in ("system", "processor", "libc", "instructions"))


def command_line(command: str, options: Mapping[str, str], overrides: Mapping[str, Any], *flags: str) -> str:
    """The command that makes something again, quoted for a shell.

    Args:
        command: the sub-command, with its arguments.
        options: name to value, as ``{"--seed": "1"}``.
        overrides: hyperparameters for ``--set``.
        flags: options without a value.
    """
    words = ["cudc-bench", *command.split(), *(word for option in options.items() for word in option)]
    for name, value in overrides.items():
        words += ["--set", f"{name}={json.dumps(value) if isinstance(value, list) else value}"]
    return shlex.join([*words, *flags])


def is_own_command(text: str) -> bool:
    """Whether a command line, which people may copy from somebody else's record, is one of ours and nothing else to any shell."""
    if _ORDINARY.fullmatch(text):
        return True  # Splitting and joining it would change nothing, and take seconds for ten thousand.
    try:
        words = shlex.split(text)
    except ValueError:
        return False
    return words[:1] == ["cudc-bench"] and shlex.join(words) == text and text.isprintable()


def stamp(
    seconds: float, device: str = "cpu", threads: int = 1, packages: Mapping[str, str] | None = None, engine: str | None = None
) -> dict[str, Any]:
    """The fields of a manifest that say what it was made with, on what and when, apart from the command.

    Args:
        seconds: of work.
        device, threads: used for it.
        packages: versions of others that the result depends on, such as the package of a plug-in.
        engine: how updates were carried out, where there were any.
    """
    head, dirty = commit()
    return {
        "versions": versions() | dict(packages or {}),
        "commit": head,
        "dirty": dirty,
        "machine": machine(device, threads, engine),
        "seconds": round(seconds, 1),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def origin(packages: Mapping[str, str]) -> dict[str, Any]:
    """The code that a run's result depends on: a run that was interrupted goes on with the same, or not at all.

    Args:
        packages: as in :func:`stamp`.
    """
    return {"versions": versions() | dict(packages), "commit": commit()[0]}


def machine(device: str, threads: int, engine: str | None = None) -> dict[str, Any]:
    """What a run ran on: what decides how it rounds, cores, device and threads used, and the engine of updates where there were any."""
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "libc": " ".join(platform.libc_ver()).strip(),
        "processor": processor(),
        "instructions": instructions(),
        "cores": os.cpu_count(),
        "device": device,
        "threads": threads,
    } | ({} if engine is None else {"engine": engine})


@cache
def source(endings: frozenset[str] = frozenset({".py", ".json"})) -> str:
    """A hash of this package's own files, by the endings of their names, which tells apart what no commit does: local changes."""
    spec = find_spec("cudc_bench")
    folders = [Path(place) for place in (spec.submodule_search_locations if spec else None) or ()]
    for stage in ("collectors", "relabelers", "evaluators", "leaderboard"):
        inner = find_spec(f"cudc_bench.{stage}")
        folders += [Path(place) for place in (inner.submodule_search_locations if inner else None) or ()]
    found = hashlib.sha256()
    for path in sorted({path for folder in folders for path in folder.rglob("*") if path.suffix in endings}):
        found.update(f"{path.name} {hashlib.sha256(path.read_bytes()).hexdigest()}\n".encode())
    return found.hexdigest()
