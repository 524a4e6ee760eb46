"""``cudc-bench`` as a process that is forked from one which has imported everything: two seconds of a core less for each.

What such a process does not show is how the command starts: what it imports, and what it reads of its environment while it does.
"""

from __future__ import annotations

import multiprocessing
import os
import runpy
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

from .waiting import PATIENCE

# What an interpreter, or a library that is imported before any command runs, reads once, from its environment.
READ_AT_START = ("PYTHON", "MUJOCO_GL", "OMP_", "LD_")

_server = multiprocessing.get_context("forkserver")
_server.set_forkserver_preload(["tests.imported"])


class Finished(NamedTuple):
    """How a process ended."""

    code: int
    out: str
    err: str


@contextmanager
def briefly(domain: str = "walker") -> Iterator[None]:
    """A domain's evaluations have short episodes in this process: their length changes nothing of what most tests prove.

    Data of the domain's own length cannot be collected meanwhile.
    """
    from cudc_bench.envs import DOMAINS
    from cudc_bench.evaluators.contract import BRIEF

    whole = DOMAINS[domain]
    DOMAINS[domain] = replace(whole, episode_length=BRIEF.episode_length)
    try:
        yield
    finally:
        DOMAINS[domain] = whole


def can_serve(env: Mapping[str, str]) -> bool:
    """Whether a process that has started already can have this environment."""
    return all(os.environ.get(name) == env.get(name) for name in {*os.environ, *env} if name.startswith(READ_AT_START))


def run(arguments: Sequence[str], cwd: Path, env: Mapping[str, str], said: Path, brief: bool = False) -> Finished:
    """Run ``cudc-bench`` and wait for its end.

    Args:
        arguments: of the command line.
        cwd, env: the process's folder and whole environment.
        said: an empty folder, for what it prints.
        brief: see :func:`briefly`.
    """
    return _finished(_command, ["cudc-bench", *arguments], cwd, env, said, brief)


def run_program(program: Path, env: Mapping[str, str], said: Path, brief: bool = False) -> Finished:
    """Run somebody's program in its folder, as ``python program.py`` does, and wait for its end; see :func:`run`."""
    return _finished(_program, [str(program)], program.parent, env, said, brief)


def _finished(what: Callable[[], None], arguments: list[str], cwd: Path, env: Mapping[str, str], said: Path, brief: bool) -> Finished:
    out, err = said / "out", said / "err"
    process = _server.Process(target=_main, args=(what, arguments, cwd, dict(env), out, err, brief))
    with _without_program():
        process.start()
    process.join(PATIENCE)
    if process.exitcode is None:
        process.kill()
        raise TimeoutError(f"{' '.join(arguments)} does not end")
    return Finished(process.exitcode, out.read_text(), err.read_text())


@contextmanager
def _without_program() -> Iterator[None]:
    """A process that is started meanwhile does not import the program of this one, pytest, which takes longer than most commands."""
    program, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = program


def _main(what: Callable[[], None], arguments: list[str], cwd: Path, env: dict[str, str], out: Path, err: Path, brief: bool) -> None:
    for number, path in ((1, out), (2, err)):
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(file, number)
        os.close(file)
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(env)
    sys.argv = arguments
    sys.path.insert(0, str(cwd))  # as ``python -m`` and ``python program.py`` do
    with briefly() if brief else nullcontext():
        what()


def _command() -> None:
    """Become what ``python -m cudc_bench.cli`` is; the processes that it starts in turn take it for that."""
    from cudc_bench.cli import __main__ as command

    sys.modules["__main__"] = command
    command.main()


def _program() -> None:
    runpy.run_path(sys.argv[0], run_name="__main__")
