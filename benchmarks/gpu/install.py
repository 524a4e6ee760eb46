"""Install the bundle without pip and without a network: ``python3 install.py [FOLDER]``, with the Python that has PyTorch.

Wheels are unpacked into ``FOLDER/site``, which comes before what that Python has itself; ``FOLDER/bin`` has the commands. Nothing else is
touched, and no virtual environment is made: one that is made from within another one does not see its PyTorch.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import zipfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
COMMAND = """#!/bin/sh
export PYTHONPATH="{site}${{PYTHONPATH:+:$PYTHONPATH}}"
exec "{python}" {arguments} "$@"
"""


def main() -> None:
    """Check, unpack, and say what to do next."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", nargs="?", type=Path, default=HERE / "installed", help="where to; %(default)s by default")
    folder = parser.parse_args().folder.resolve()
    if why := unfit((HERE / "python").read_text().strip()):
        sys.exit(f"install.py: {why}")
    site = folder / "site"
    shutil.rmtree(site, ignore_errors=True)
    for wheel in sorted((HERE / "wheels").glob("*.whl")):
        unpack(wheel, site)
    commands = folder / "bin"
    commands.mkdir(exist_ok=True)
    for name, arguments in (("cudc-bench", "-m cudc_bench.cli"), ("python", "")):
        path = commands / name
        path.write_text(COMMAND.format(site=site, python=sys.executable, arguments=arguments))
        path.chmod(0o755)
    print(f"installed; try: {commands / 'cudc-bench'} doctor")


def unfit(python: str) -> str | None:
    """Why this Python cannot take the bundle; None if it can."""
    here = f"{sys.version_info.major}.{sys.version_info.minor}"
    if here != python:
        return f"this bundle is for Python {python}, {sys.executable} is {here}; take another, or make gpu-bundle PYTHON_VERSION={here}."
    from importlib.util import find_spec

    if find_spec("torch") is None:
        return f"{sys.executable} has no PyTorch; run this with the Python that has it."
    return None


def unpack(wheel: Path, site: Path) -> None:
    """Put a wheel's files where they are imported from; scripts and headers are not needed."""
    with zipfile.ZipFile(wheel) as archive:
        for one in archive.infolist():
            top, _, rest = one.filename.partition("/")
            name = one.filename
            if top.endswith(".data"):
                kind, _, name = rest.partition("/")
                if kind not in ("purelib", "platlib"):
                    continue
            target = site / name
            if one.is_dir() or site not in target.resolve().parents:
                continue
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(archive.read(one))


if __name__ == "__main__":
    main()
