"""Everything that a machine with a GPU and without a network needs beside its PyTorch: ``make gpu-bundle``.

What is needed follows from the metadata of this project and of what is installed here; versions are those of ``constraints.txt``. Wheels
lose what nothing here uses, and lie in the bundle without compression of their own, so that the archive compresses all of them at once.
"""

from __future__ import annotations

import argparse
import lzma
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import tomllib
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib import metadata
from io import BytesIO
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from cudc_bench.execution.parallel import cores
from cudc_bench.execution.progress import bar_if_long, bars

ROOT = Path(__file__).resolve().parents[2]
NAME = "cudc-bench-gpu"
LIMIT = 60 * 2**20  # bytes of the archive
# What is not needed there, and what is needed for its sake alone.
LEFT_OUT = {
    "torch": "that machine's own: with CUDA it is far larger than all else",
    "pandas": "tables of the leaderboard, which are made where the records go",
    "matplotlib": "figures of the leaderboard",
    "labmaze": "mazes of dm_control's locomotion",
    "setuptools": "PyTorch has it beside itself",
}
TESTING = ("pytest", "pytest-xdist", "hypothesis")  # of what development needs
# Folders and files of packages that nothing here imports, by their beginnings; tests of all packages go as well.
UNUSED = {
    "dm_control": ("locomotion/", "suite/dog_assets/", "suite/all_domains.png", "viewer/", "blender/", "mjcf/test_assets/"),
    "mujoco": ("experimental/", "_render_filament", "include/", "mjx/", "sysid/"),
}
CARRIED = ("tests", "benchmarks", "examples", "pyproject.toml", "constraints.txt", "README.md")  # of the project, beside its wheel
AT_TOP = ("install.py", "gpu-check.sh")  # of this folder
_BLOCK = 32 * 2**20  # bytes that are compressed as one


class BundleError(Exception):
    """There can be no bundle; the message says why."""


def main() -> None:
    """Make the bundle: a folder, and an archive of it."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu.bundle", description=str(__doc__).partition("\n")[0])
    here = f"{sys.version_info.major}.{sys.version_info.minor}"
    parser.add_argument("--python", default=here, metavar="VERSION", help="of the machine with the GPU; by default this one's")
    parser.add_argument("--output", type=Path, default=ROOT / "build" / "gpu-bundle", help="the folder to make it in")
    arguments = parser.parse_args()
    try:
        archive, size = make(arguments.python, arguments.output)
    except (BundleError, OSError) as error:
        sys.exit(f"gpu-bundle: {error}")
    print(f"{archive}   {size / 2**20:.1f} MiB; there: tar xf {archive.name} && bash {NAME}/gpu-check.sh")


def make(python: str, output: Path) -> tuple[Path, int]:
    """The archive's path and size.

    Args:
        python: the version of Python that it is for, such as ``3.12``.
        output: a folder.

    Raises:
        BundleError: something cannot be had, or it would be too large.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    check_python(python, project["requires-python"])
    wanted = pinned(needed(asked_for(project), LEFT_OUT, python), read_constraints(ROOT / "constraints.txt"))
    folder = output / NAME
    shutil.rmtree(folder, ignore_errors=True)
    wheels = folder / "wheels"
    wheels.mkdir(parents=True)
    with tempfile.TemporaryDirectory() as temporary:
        found = [own_wheel(Path(temporary)), *download(wanted, python, Path(temporary) / "downloaded")]
        with bar_if_long("trimming wheels", len(found), "wheels") as advance:
            for wheel in found:
                trim(wheel, wheels / wheel.name)
                advance(1)
    for name in project_files(CARRIED):
        (folder / "project" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, folder / "project" / name)
    for name in AT_TOP:
        shutil.copyfile(Path(__file__).with_name(name), folder / name)
    (folder / "python").write_text(f"{python}\n")
    archive = output / f"{NAME}-python{python}.tar.xz"
    archive.unlink(missing_ok=True)
    size = compress(folder, archive)
    try:
        check_size(size, folder)
    except BundleError:
        archive.unlink()
        raise
    return archive, size


# What is needed


def check_python(version: str, allowed: str) -> None:
    """Refuse a Python that the project does not run on.

    Raises:
        BundleError: the message says which ones it does.
    """
    from packaging.specifiers import SpecifierSet
    from packaging.version import InvalidVersion

    try:
        good = version.count(".") == 1 and version in SpecifierSet(allowed)
    except InvalidVersion:
        good = False
    if not good:
        raise BundleError(f"PYTHON_VERSION={version} cannot be; the project runs on {allowed}: name one such as 3.12.")


def asked_for(project: Mapping[str, Any]) -> list[Requirement]:
    """What the project itself asks for to run and to be tested, from the table ``project`` of its ``pyproject.toml``."""
    testing = [Requirement(one) for one in project["optional-dependencies"]["dev"]]
    return [Requirement(one) for one in project["dependencies"]] + [one for one in testing if one.name in TESTING]


def needed(
    asked: Iterable[Requirement], left_out: Iterable[str], python: str, requires: Callable[[str], Sequence[str] | None] = metadata.requires
) -> list[str]:
    """The names of all packages that some requirements lead to on Linux.

    Args:
        asked: where to start.
        left_out: packages that are not needed, nor what they ask for.
        python: the version there, whose packages may ask for others than here.
        requires: what a package asks for.

    Raises:
        BundleError: a package is not installed here, so that nobody can say what it asks for.
    """
    there = {
        "python_version": python, "python_full_version": f"{python}.0", "sys_platform": "linux", "platform_system": "Linux",
        "os_name": "posix", "platform_machine": "x86_64", "implementation_name": "cpython", "platform_python_implementation": "CPython",
    }  # fmt: skip
    todo, skipped = list(asked), set(map(canonicalize_name, left_out))
    extras: dict[str, set[str]] = {}  # of each package those that were looked at
    while todo:
        one = todo.pop()
        name = canonicalize_name(one.name)
        if name in skipped:
            continue
        new = {"", *one.extras} - extras.setdefault(name, set())
        extras[name] |= new
        try:
            requirements = [Requirement(text) for text in requires(name) or ()]
        except metadata.PackageNotFoundError:
            raise BundleError(f"{name} is needed there and not installed here; run make setup first.") from None
        for extra in new:
            todo += [other for other in requirements if other.marker is None or other.marker.evaluate({**there, "extra": extra})]
    return sorted(extras)


def read_constraints(path: Path) -> dict[str, Requirement]:
    """The versions that are tested, by package."""
    lines = [line.partition("#")[0].strip() for line in path.read_text().splitlines()]
    return {canonicalize_name(one.name): one for one in map(Requirement, filter(None, lines))}


def pinned(names: Iterable[str], constraints: Mapping[str, Requirement]) -> list[str]:
    """Packages with their tested versions.

    Raises:
        BundleError: one has none.
    """
    names = list(names)
    if missing := [name for name in names if name not in constraints]:
        raise BundleError(f"constraints.txt has no version of {', '.join(missing)}; add one, or leave it out in benchmarks/gpu/bundle.py.")
    return [str(constraints[name]) for name in names]


# Wheels


def download(wanted: Sequence[str], python: str, folder: Path) -> list[Path]:
    """Wheels for Linux on x86-64.

    Raises:
        BundleError: pip cannot get one.
    """
    generations = ("2_28", "2_27", "2_26", "2_24", "2_17", "2_12", "2_5")
    platforms = [word for one in generations for word in ("--platform", f"manylinux_{one}_x86_64")]
    options = ["--no-deps", "--only-binary=:all:", "--implementation", "cp", "--python-version", python, *platforms]
    # Each by a call of its own, since pip does not say how far it is.
    with bars([(f"downloading for Python {python}", len(wanted))], "wheels") as (advance,), ThreadPoolExecutor(4) as pool:
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", *options, "--dest", str(folder)]
        for done in pool.map(lambda one: subprocess.run([*command, one], capture_output=True, text=True, check=False), wanted):
            if done.returncode:
                raise BundleError(f"pip: {(done.stderr.strip().splitlines() or ['it failed'])[-1]}")
            advance(1)
    return sorted(folder.glob("*.whl"))


def own_wheel(folder: Path) -> Path:
    """The project's, from a copy of what git knows or would add: an old ``build/`` would put into it what is no more.

    Raises:
        BundleError: it cannot be built.
    """
    source = folder / "source"
    for name in project_files(()):
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, source / name)
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--disable-pip-version-check", "--no-deps", "--wheel-dir", str(folder)]
    done = subprocess.run([*command, str(source)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise BundleError(f"pip: {(done.stderr.strip().splitlines() or ['it failed'])[-1]}")
    return next(folder.glob("*.whl"))


def project_files(below: Sequence[str]) -> list[str]:
    """Files of the working tree that git does not ignore, in some places or everywhere; what was removed is not there."""
    command = ["git", "-C", str(ROOT), "ls-files", "--cached", "--others", "--exclude-standard", "-z", "--", *below]
    listed = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split("\0")
    return [name for name in listed if name and (ROOT / name).is_file()]


def trim(wheel: Path, to: Path) -> None:
    """Write a wheel without what nothing uses, its list of files included, and without compression."""
    package = wheel.name.partition("-")[0].lower()
    with zipfile.ZipFile(wheel) as old, zipfile.ZipFile(to, "w", zipfile.ZIP_STORED) as new:
        for one in old.infolist():
            if one.is_dir() or is_unused(package, one.filename):
                continue
            data = old.read(one)
            if one.filename.endswith(".dist-info/RECORD"):
                lines = data.decode().splitlines(keepends=True)
                data = "".join(line for line in lines if not is_unused(package, line.rpartition(",sha256")[0] or line)).encode()
            entry = zipfile.ZipInfo(one.filename, one.date_time)
            entry.external_attr = one.external_attr
            new.writestr(entry, data)


def is_unused(package: str, name: str) -> bool:
    """Whether nothing here needs a file of a wheel: tests of others' packages, and what UNUSED names."""
    top, _, rest = name.partition("/")
    if top.endswith((".dist-info", ".data")):
        return False
    return rest.startswith(UNUSED.get(package, ())) or "tests" in rest.split("/")[:-1]


# The archive


def compress(folder: Path, archive: Path) -> int:
    """Pack a folder into a ``.tar.xz``; its size. Blocks are compressed side by side, one after another in the file, as xz allows."""
    plain = BytesIO()
    with tarfile.open(fileobj=plain, mode="w") as tar:
        tar.add(folder, arcname=folder.name, filter=_anonymous)
    blocks = [plain.getbuffer()[start : start + _BLOCK] for start in range(0, plain.getbuffer().nbytes, _BLOCK)]
    with bar_if_long("compressing", len(blocks), "blocks") as advance, archive.open("wb") as file, ThreadPoolExecutor(cores()) as pool:
        for compressed in pool.map(lzma.compress, blocks):
            file.write(compressed)
            advance(1)
    return archive.stat().st_size


def _anonymous(entry: tarfile.TarInfo) -> tarfile.TarInfo:
    entry.uid = entry.gid = 0
    entry.uname = entry.gname = ""
    return entry


def check_size(size: int, folder: Path, limit: int = LIMIT) -> None:
    """Refuse an archive that is too large for what carries it.

    Raises:
        BundleError: the message names the largest files.
    """
    if size > limit:
        largest = sorted(contents(folder), key=lambda one: -one[1])[:8]
        listed = ", ".join(f"{name} {count / 2**20:.1f}" for name, count in largest)
        raise BundleError(
            f"{size / 2**20:.1f} MiB are more than {limit / 2**20:.0f}; the largest files, in MiB before compression: {listed}."
            " Leave some out in benchmarks/gpu/bundle.py."
        )


def contents(folder: Path) -> Iterator[tuple[str, int]]:
    """Files of a bundle, those in wheels one by one, and their sizes."""
    for path in sorted(folder.rglob("*")):
        if path.suffix == ".whl":
            with zipfile.ZipFile(path) as wheel:
                yield from ((f"{path.name}:{one.filename}", one.file_size) for one in wheel.infolist())
        elif path.is_file():
            yield os.fspath(path.relative_to(folder)), path.stat().st_size


if __name__ == "__main__":
    main()
