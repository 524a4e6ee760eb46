"""Fixtures for all tests: a Minari root for each test, one small dataset collected once, and the command line as a process."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import hypothesis
import pytest

import cudc_bench

from . import served
from .served import Finished
from .slow import slow_tests, without_parameters
from .waiting import PATIENCE

# Before PyTorch is loaded, here and in the processes that tests start: the tests already share the cores among them, and threads that
# wait for each other on a busy core take many times as long as one thread alone.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# Failures inside the battery then show the values that were compared, as those of any test module do.
pytest.register_assert_rewrite("cudc_bench.collectors.contract", "cudc_bench.evaluators.contract")

TASKS = ("stand", "walk", "run", "flip")

# Time limits, on one example or on making examples, fail on a busy machine and prove nothing. What decides whether a change lands draws
# the same examples every time; everybody's own runs draw new ones.
hypothesis.settings.register_profile(
    "cudc_bench", deadline=None, print_blob=True, derandomize=bool(os.environ.get("CI")),
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)  # fmt: skip
hypothesis.settings.load_profile("cudc_bench")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what took long the last time that somebody looked, and begin with the longest: alone at the end, they would leave cores idle.

    What needs a GPU is left out where there is none.
    """
    slow = slow_tests()
    if on_gpus := [item for item in items if item.get_closest_marker("cuda") is not None]:
        import torch

        for item in () if torch.cuda.is_available() else on_gpus:
            item.add_marker(pytest.mark.skip(reason="needs CUDA"))
    items.sort(key=lambda item: item.get_closest_marker("longest") is None)
    for item in items:
        if without_parameters(item.nodeid) in slow:
            item.add_marker("slow")


@pytest.fixture(autouse=True)
def datasets(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The test's own Minari root, which does not exist yet."""
    root = tmp_path_factory.mktemp("minari") / "datasets"
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(root))
    monkeypatch.setenv("CUDC_BENCH_THRESHOLDS", str(root.with_name("thresholds.json")))
    monkeypatch.delenv("CUDC_BENCH_PROFILE", raising=False)
    # Commands that are run in this process set these for those that they start.
    monkeypatch.setenv("CUDC_BENCH_QUIET", "")
    monkeypatch.setenv("CUDC_BENCH_DEBUG", "")
    return root


@pytest.fixture(scope="session")
def collected_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A root with ``walker/cudc-smoke-v0`` at the smoke profile and its four relabelled sets; never to be changed."""
    root = tmp_path_factory.mktemp("collected") / "datasets"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        assert cudc_bench.collect("cudc", profile="smoke") == ["walker/cudc-smoke-v0"]
        assert cudc_bench.relabel("walker/cudc-smoke-v0") == [f"walker/{task}/cudc-smoke-v0" for task in TASKS]
    return root


@pytest.fixture
def smoke(collected_once: Path, datasets: Path) -> Path:
    """The test's own copy of the collected datasets, in its root."""
    shutil.copytree(collected_once, datasets)
    return datasets


@pytest.fixture(scope="session")
def command_line() -> Any:
    """The command line: to make it of its functions takes longer than most of what it is asked here, and what comes out is the same."""
    import typer

    from cudc_bench.cli import app

    return typer.main.get_command(app.build_app())


@pytest.fixture
def ready_command_line(command_line: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command line is not made anew for each command that is given in this process."""
    from cudc_bench.cli import app

    monkeypatch.setattr(app, "build_app", lambda: command_line)


@pytest.fixture
def environment(datasets: Path) -> dict[str, str]:
    """What processes get: the test's root, wide tables, and the smoke profile, so that none starts hours of work by mistake."""
    return os.environ | {"MINARI_DATASETS_PATH": str(datasets), "CUDC_BENCH_PROFILE": "smoke", "COLUMNS": "200"}


@pytest.fixture
def cli(environment: dict[str, str], tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Finished]:
    """Runs ``cudc-bench`` as a process in ``tmp_path``: a new one, or where nothing depends on how it starts, a forked one.

    If it is to be ``brief``, Walker's policies are tried in short episodes.
    """

    def run(
        *arguments: str, env: Mapping[str, str] | None = None, interpreter: str = sys.executable, anew: bool = False, brief: bool = False
    ) -> Finished:
        whole = environment | dict(env or {})
        if not anew and interpreter == sys.executable and served.can_serve(whole):
            return served.run(arguments, tmp_path, whole, tmp_path_factory.mktemp("said"), brief)
        command = [interpreter, "-m", "cudc_bench.cli", *arguments]
        done = subprocess.run(command, cwd=tmp_path, env=whole, capture_output=True, text=True, timeout=PATIENCE)
        return Finished(done.returncode, done.stdout, done.stderr)

    return run


@pytest.fixture
def python(environment: dict[str, str], tmp_path: Path) -> Callable[..., Finished]:
    """Runs a script in a fresh interpreter in ``tmp_path``."""

    def run(script: str, *arguments: str, without: tuple[str, ...] = ()) -> Finished:
        env = {name: value for name, value in environment.items() if name not in without}
        command = [sys.executable, "-c", script, *arguments]
        done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=PATIENCE)
        return Finished(done.returncode, done.stdout, done.stderr)

    return run
