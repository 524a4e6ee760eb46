"""The versions that pyproject.toml asks for: `make test-lowest` and `make test-newest` try them."""

from __future__ import annotations

import re
import sys
import tomllib
from importlib.metadata import packages_distributions

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests import ROOT

from .floors import PROJECT, TOOLS, floors, requirements

IMPORT = re.compile(r"^\s*(?:import|from) ([A-Za-z_]\w*)", re.MULTILINE)
OURS = {"cudc_bench", "collectors", "relabelers", "evaluators", "leaderboard", "tests", "benchmarks", "studies", "docs", "examples"}
BROUGHT = {"absl": "dm-control", "markupsafe": "jinja2"}  # by what every version of it is made with
FOLDERS = ("cudc_bench", "collectors", "relabelers", "evaluators", "leaderboard", "tests")


def test_the_versions_that_are_tested_lie_in_the_ranges() -> None:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pinned = {canonicalize_name(name): version for name, _, version in (line.partition("==") for line in lines if "==" in line)}
    for one in requirements():
        version = pinned.get(canonicalize_name(one.name))
        assert version is None or version in one.specifier, one


def test_each_has_a_lowest_version_that_is_in_its_range() -> None:
    for one in requirements():
        assert floors()[one.name] in one.specifier, one


def test_whatever_is_imported_is_asked_for() -> None:
    project = tomllib.loads(PROJECT.read_text())["project"]
    tools = [Requirement(line) for name in TOOLS for line in project["optional-dependencies"][name]]
    asked = {canonicalize_name(one.name) for one in [*requirements(), *tools]}
    found = {name for folder in FOLDERS for path in (ROOT / folder).rglob("*.py") for name in IMPORT.findall(path.read_text())}
    providers = packages_distributions()
    missing = {
        name
        for name in found - OURS - set(BROUGHT) - set(sys.stdlib_module_names)
        if name in providers and not asked & {canonicalize_name(one) for one in providers[name]}
    }
    assert not missing
    assert asked >= set(BROUGHT.values())
