"""The lowest versions that pyproject.toml says will do, as constraints for pip: ``python -m tests.floors``, for ``make test-lowest``."""

from __future__ import annotations

import tomllib
from pathlib import Path

from packaging.requirements import Requirement

PROJECT = Path(__file__).parents[1] / "pyproject.toml"
# What only the tests need is not the user's: the newest of it will do.
TOOLS = ("dev", "docs")


def requirements() -> list[Requirement]:
    """What a user may have to have: all that the package and its extras ask for."""
    project = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]
    extras = [line for name, lines in project["optional-dependencies"].items() if name not in TOOLS for line in lines]
    found = [Requirement(line) for line in [*project["dependencies"], *extras]]
    return [one for one in found if one.name != project["name"]]  # an extra may be made of others


def floors() -> dict[str, str]:
    """The lowest version of each, by its name."""
    found: dict[str, str] = {}
    for one in requirements():
        (found[one.name],) = [clause.version for clause in one.specifier if clause.operator == ">="]
    return found


if __name__ == "__main__":
    for name, version in floors().items():
        print(f"{name}=={version}")
