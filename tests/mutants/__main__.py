"""Runs the tests against every mutant: ``python -m tests.mutants [LIST …] [--only TEXT] [--jobs N]``.

Nothing in the checkout is changed: each mutant is a copy of the package and its tests in a scratch folder, in which pytest runs in its own
process, forked from one that has imported what takes seconds to import and nothing of ours. A mutant counts as noticed only if for each
name in its list a comparison failed; that the changed code cannot run proves nothing, and ends with an error, as does a text that is not
found exactly once.
"""

from __future__ import annotations

import argparse
import importlib
import os
import pkgutil
import shutil
import signal
import sys
import tempfile
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import pytest
import torch

import tests.mutants
from tests import ROOT
from tests.mutants import Mutant

STAGES = ("collectors", "relabelers", "evaluators", "leaderboard")
SLOW = ("hypothesis", "numpy", "pydantic", "torch.distributions", "torch.testing", "torch.utils._python_dispatch")  # to import
PATIENCE = 120  # seconds of a processor's time, for a mutant that never ends
UNCHANGED = Mutant("", "", "", ())


class Outcome(NamedTuple):
    """What pytest said.

    Attributes:
        noticed: the names (first words of parameters) of tests in which a comparison failed.
        broke: how a test ended that neither passed nor failed in a comparison.
        passed: how many passed.
    """

    noticed: frozenset[str]
    broke: str
    passed: int


class Only:
    """A plugin for pytest that runs the tests of some names alone."""

    def __init__(self, names: Sequence[str]) -> None:
        self.names = names

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items[:] = [item for item in items if first_word(item.name) in self.names]


def first_word(test: str) -> str:
    """Of a test's parameters; of a test without any its name."""
    return test.partition("[")[2].rstrip("]").split(" ")[0] or test


def misplaced(mutant: Mutant) -> str:
    """What is wrong with a mutant's text; nothing if it stands in its file exactly once and is changed."""
    count = (ROOT / mutant.file).read_text().count(mutant.old)
    if count != 1:
        return f"{mutant.file} has {count} times instead of once: {mutant.old!r}"
    return "" if mutant.old != mutant.new else f"{mutant.file}: nothing changes in {mutant.old!r}"


def copy_package(folder: Path) -> None:
    """The package as it is when it is installed, and the tests, in a folder that comes before every installed package."""
    bare = shutil.ignore_patterns("__pycache__", "*.pyc")
    shutil.copytree(ROOT / "cudc_bench", folder / "cudc_bench", ignore=bare)
    for stage in STAGES:
        shutil.copytree(ROOT / stage, folder / "cudc_bench" / stage, ignore=bare)
    shutil.copytree(ROOT / "tests", folder / "tests", ignore=bare)
    shutil.copy(ROOT / "pyproject.toml", folder)


def mutate(mutant: Mutant, folder: Path) -> None:
    """Make the change in the copy."""
    parts = Path(mutant.file).parts
    path = folder / "cudc_bench" / mutant.file if parts[0] in STAGES else folder / mutant.file
    path.write_text(path.read_text().replace(mutant.old, mutant.new))


def start(mutant: Mutant, test: str, folder: Path) -> int:
    """Run the tests on a mutant in a new process; its id."""
    copy_package(folder)
    if mutant.file:
        mutate(mutant, folder)
    child = os.fork()
    if child:
        return child
    code = 99
    try:
        signal.setitimer(signal.ITIMER_PROF, PATIENCE)
        said = os.open(folder / "said", os.O_WRONLY | os.O_CREAT)
        os.dup2(said, 1)
        os.dup2(said, 2)
        os.chdir(folder)
        sys.dont_write_bytecode = True
        sys.path[:] = [str(folder), *(path for path in sys.path if path and Path(path).resolve() != ROOT)]
        for name in [name for name in sys.modules if name.split(".")[0] in ("tests", "cudc_bench")]:
            del sys.modules[name]
        torch.set_num_threads(1)
        import cudc_bench

        assert Path(cudc_bench.__file__).is_relative_to(folder), "the tests would run on another copy"
        plugins = [Only(mutant.noticed_by)] if mutant.noticed_by else []
        code = int(pytest.main([test, "-p", "no:cacheprovider", "--tb=no", "--junitxml=outcome.xml"], plugins))
    finally:
        os._exit(code)


def outcome(folder: Path, status: int) -> Outcome:
    """Read what pytest left."""
    code = os.waitstatus_to_exitcode(status)
    if code not in (0, 1) or not (folder / "outcome.xml").exists():
        said = (folder / "said").read_text() if (folder / "said").exists() else ""
        return Outcome(frozenset(), f"pytest ended with {code}: {said[-600:]}", 0)
    noticed, broke, passed = set(), "", 0
    for case in ElementTree.parse(folder / "outcome.xml").iter("testcase"):
        name = case.attrib["name"]
        failure, error = case.find("failure"), case.find("error")
        if failure is None and error is None:
            passed += 1
        elif failure is not None and failure.attrib["message"].startswith(("AssertionError", "assert ")):
            noticed.add(first_word(name))
        else:
            found = failure if failure is not None else error
            broke = f"{name}: {'' if found is None else found.attrib['message']}"
    return Outcome(frozenset(noticed), broke, passed)


def run(jobs: Sequence[tuple[Mutant, str]], at_once: int) -> Iterator[tuple[Mutant, Outcome]]:
    """The outcome of each mutant with its tests, as they end."""
    waiting, running = list(jobs), dict[int, tuple[Mutant, tempfile.TemporaryDirectory[str]]]()
    while waiting or running:
        while waiting and len(running) < at_once:
            mutant, test = waiting.pop(0)
            scratch = tempfile.TemporaryDirectory(prefix="mutant-")
            running[start(mutant, test, Path(scratch.name).resolve())] = mutant, scratch
        child, status = os.wait()
        mutant, scratch = running.pop(child)
        with scratch:
            yield mutant, outcome(Path(scratch.name), status)


def line(text: str) -> str:
    return " ".join(text.split())


def verdict(mutant: Mutant, found: Outcome) -> tuple[str, str]:
    """One word on a mutant, and what there is to say; all but "noticed" and "survives" are faults."""
    missed = [name for name in mutant.noticed_by if name not in found.noticed]
    if found.broke:
        return "BROKEN", line(found.broke)[:200]
    if mutant.survives:
        return (
            ("survives", mutant.survives)
            if not found.noticed
            else ("NOTICED", f"by {', '.join(sorted(found.noticed))}; it is said to survive")
        )
    if missed:
        return "MISSED", f"by {', '.join(missed)}"
    return "noticed", f"by {', '.join(sorted(found.noticed))}"


def main() -> int:
    """Run what the command line asks for, print a line for each mutant, and the count; 0 if all is as it should be."""
    lists = [module.name for module in pkgutil.iter_modules(tests.mutants.__path__) if module.name != "__main__"]
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description="Says which wrong formulas the tests notice.")
    parser.add_argument("lists", nargs="*", choices=[[], *lists], help="of mutants; all without it", metavar="LIST")
    parser.add_argument("--only", default="", metavar="TEXT", help="mutants whose file, old or new text holds TEXT")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="mutants at a time")
    options = parser.parse_args()

    chosen: list[tuple[Mutant, str]] = []
    unchanged: list[tuple[Mutant, str]] = []
    for name in options.lists or lists:
        module = importlib.import_module(f"tests.mutants.{name}")
        chosen += [(mutant, module.TESTS) for mutant in module.MUTANTS if options.only in "\n".join(mutant[:3])]
        unchanged.append((UNCHANGED, module.TESTS))
    wrong = [problem for mutant, _ in chosen if (problem := misplaced(mutant))]
    if wrong or not chosen:
        print("\n".join(wrong) or f"no mutant holds {options.only!r}")
        return 2
    for name in SLOW:
        importlib.import_module(name)
    for _, found in run(unchanged, options.jobs):
        if found.broke or found.noticed or not found.passed:
            print(f"the tests fail without any change: {found.broke or ', '.join(sorted(found.noticed))}")
            return 2

    started, words = time.monotonic(), []
    for mutant, found in run(chosen, options.jobs):
        word, said = verdict(mutant, found)
        words.append(word)
        print(f"{word:9}{mutant.file}: {line(mutant.old)}  ->  {line(mutant.new)}\n{'':9}{said}", flush=True)
    counts = ", ".join(f"{words.count(word)} {word}" for word in sorted(set(words), reverse=True))
    print(f"{len(words)} mutants in {time.monotonic() - started:.0f} seconds: {counts}")
    return int(any(word.isupper() for word in words))


if __name__ == "__main__":
    sys.exit(main())
