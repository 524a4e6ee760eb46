"""What every command takes: -h, --quiet and --debug, before it or behind it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import pytest
import typer

from cudc_bench import plugins
from cudc_bench.cli.app import main
from cudc_bench.errors import RunError
from cudc_bench.execution.progress import QUIET, bars, draws_bars, echo, warn

from .test_process import only


def run(arguments: list[str]) -> int:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert isinstance(ended.value.code, int)
    return ended.value.code


def test_h_is_help_everywhere(here: Callable) -> None:
    for command in ([], *([name] for name in plugins.names("commands"))):
        long, short = (here([*command, option]) for option in ("--help", "-h"))
        assert long == short
        assert (long.code, long.err) == (0, "")
        assert "Usage: " in long.out


def works() -> None:
    echo("a note")
    warn("a problem")
    with bars([("work", 3)], "things") as (advance,):
        advance(3)
    print("a result")


def fails() -> None:
    works()
    raise RunError("it went wrong.")


@pytest.mark.parametrize("arguments", [["--quiet", "it"], ["-q", "it"], ["it", "--quiet"], ["it", "-q"], ["it"]])
def test_who_wants_quiet_gets_results_errors_and_problems(
    arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if arguments == ["it"]:
        monkeypatch.setenv(QUIET, "1")
    only(monkeypatch, works)
    assert run(arguments) == 0
    assert capsys.readouterr() == ("a result\n", "a problem\n")
    only(monkeypatch, fails)
    assert run(arguments) == 1
    assert capsys.readouterr() == ("a result\n", "a problem\ncudc-bench: error: it went wrong.\n")


def test_others_hear_of_everything(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    only(monkeypatch, works)
    assert run(["it"]) == 0
    out, err = capsys.readouterr()
    assert out == "a result\n"
    assert [line.split(",")[0] for line in err.splitlines()] == ["a note", "a problem", "work: 3/3 things"]


def test_a_terminal_has_no_bars_either(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cudc_bench.execution.progress.console", lambda: type("Terminal", (), {"is_terminal": True}))
    assert draws_bars()
    monkeypatch.setenv(QUIET, "1")
    assert not draws_bars()


def test_debug_may_stand_behind_a_command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    only(monkeypatch, fails)
    assert run(["it", "--debug"]) == 1
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize("spelling", [("-q",), ("--quick", "-q"), ("--quiet",)])
def test_a_commands_own_option_stays_its_own(
    spelling: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def take(own: bool = False) -> None:
        echo(f"own is {own}")

    take.__annotations__["own"] = Annotated[bool, typer.Option(*spelling)]
    only(monkeypatch, take)
    assert run(["it", spelling[-1]]) == 0
    assert capsys.readouterr() == ("", "own is True\n")
    assert run(["--quiet", "it", spelling[-1]]) == 0
    assert capsys.readouterr() == ("", "")
