"""What a shell offers: commands, options and values, from one process that loads next to nothing."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from cudc_bench import plugins
from cudc_bench.cli import app
from cudc_bench.cli.app import main
from cudc_bench.suites.names import suite_names

from ..waiting import PATIENCE

Ask = Callable[[str], list[str]]


@pytest.fixture
def ask(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], command_line: Callable) -> Ask:
    """What bash would be offered at the end of a line."""
    monkeypatch.setattr(app, "build_app", lambda: command_line)

    def asked(line: str) -> list[str]:
        words = line.split(" ")
        with monkeypatch.context() as patch:
            patch.setenv("COMP_WORDS", line)
            patch.setenv("COMP_CWORD", str(len(words) - 1))
            patch.setenv("_CUDC_BENCH_COMPLETE", "complete_bash")
            patch.setattr(sys, "argv", ["cudc-bench"])
            with pytest.raises(SystemExit) as ended:
                main()
        out, err = capfd.readouterr()
        assert (ended.value.code, err) == (0, "")
        return out.split()

    return asked


def test_commands_and_options_are_offered(ask: Ask) -> None:
    assert set(ask("cudc-bench ")) >= set(plugins.names("commands"))
    assert ask("cudc-bench coll") == ["collect"]
    assert {"--method", "--quiet", "--help"} <= set(ask("cudc-bench collect --"))
    assert ask("cudc-bench list --js") == ["--json"]


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("collect --method cudc-v", ["cudc-vary-apt", "cudc-vary-icm"]),
        ("collect --method icm,cudc-v", ["icm,cudc-vary-apt", "icm,cudc-vary-icm"]),
        ("collect --method icm,ic", []),
        ("collect --domain ", ["walker", "quadruped", "jaco"]),
        ("collect --profile ", ["paper", "cpu", "demo", "smoke", "auto"]),
        ("collect --device c", ["cpu", "cuda"]),
        ("collect --engine e", ["eager"]),
        ("collect --log t", ["tensorboard"]),
        ("collect --precision b", ["bf16"]),
        ("pilot --method be", ["be"]),
        ("evaluate --algo td3-", ["td3-bc", "td3-fujimoto"]),
        ("evaluate --algo bc,cq", ["bc,cql", "bc,cql-fixed"]),
        ("evaluate --domain jaco --tasks reach_top", ["reach_top_left", "reach_top_right"]),
        ("evaluate --tasks stand,fl", ["stand,flip"]),
        ("evaluate --domain walker --task ", ["stand", "walk", "run", "flip", "all"]),
        ("run --keep ", ["datasets", "records"]),
        ("run --domains walker,quadruped --tasks j", ["jump"]),
        ("leaderboard --algo cr", ["crr"]),
        ("list --kind data", ["datasets"]),
        ("list --kind methods,pro", ["methods,profiles"]),
        ("show quad", ["quadruped"]),
        ("show reach_bottom", ["reach_bottom_left", "reach_bottom_right"]),
        ("show td3-b", ["td3-bc"]),
    ],
)
def test_values_are_offered(line: str, expected: list[str], ask: Ask) -> None:
    assert ask(f"cudc-bench {line}") == expected


def test_suites_are_offered(ask: Ask) -> None:
    assert ask("cudc-bench run ") == suite_names()


@pytest.mark.parametrize(
    "command", ["verify", "relabel", "delete", "stats", "diagnostics", "evaluate --dataset-id", "verify walker/cudc-smoke-v0"]
)
def test_datasets_are_offered(command: str, ask: Ask, datasets: Path) -> None:
    assert ask(f"cudc-bench {command} wal") == []
    for one in ("walker/cudc-smoke-v0", "walker/walk/cudc-smoke-v0"):
        (datasets / one / "data").mkdir(parents=True)
        (datasets / one / "data/metadata.json").write_text("{}")
    assert ask(f"cudc-bench {command} wal") == ["walker/cudc-smoke-v0", "walker/walk/cudc-smoke-v0"]


def test_a_root_that_cannot_be_read_offers_nothing(ask: Ask, datasets: Path) -> None:
    datasets.write_text("")
    assert ask("cudc-bench verify ") == []


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_scripts_for_shells_are_shown(shell: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION", "1")  # the option then takes a shell's name
    with pytest.raises(SystemExit) as ended:
        main(["--show-completion", shell])
    out, err = capfd.readouterr()
    assert (ended.value.code, err) == (0, "")
    assert f"complete_{shell}" in out


def test_the_installed_command_answers_and_loads_next_to_nothing(environment: dict[str, str], datasets: Path, tmp_path: Path) -> None:
    asked = environment | {"COMP_WORDS": "cudc-bench evaluate --tasks fl", "COMP_CWORD": "3", "_CUDC_BENCH_COMPLETE": "complete_bash"}
    script = Path(sys.executable).with_name("cudc-bench")
    command = [sys.executable, "-X", "importtime", script]
    done = subprocess.run(command, cwd=tmp_path, env=os.environ | asked, capture_output=True, text=True, timeout=PATIENCE)
    assert (done.returncode, done.stdout) == (0, "flip\n")
    loaded = {line.rpartition("|")[2].strip().split(".")[0] for line in done.stderr.splitlines()}
    assert "typer" in loaded
    assert not loaded & {"torch", "numpy", "gymnasium", "minari", "h5py", "mujoco"}
