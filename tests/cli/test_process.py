"""How the command gets on with the process that it is: signals and standard streams."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from cudc_bench import plugins
from cudc_bench.cli.app import main
from cudc_bench.execution.streams import open_streams
from cudc_bench.files import replacing

from ..waiting import PATIENCE


def only(monkeypatch: pytest.MonkeyPatch, command: Callable[[], None]) -> None:
    """Let there be one command, called ``it``."""
    monkeypatch.setattr(plugins, "names", lambda kind: ["it"])
    monkeypatch.setattr(plugins, "load", lambda kind, name: command)
    monkeypatch.setattr(plugins, "is_own", lambda kind, name: True)


def test_sigterm_leaves_nothing_half_done_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def write() -> None:
        with replacing(tmp_path / "video.gif", ".gif") as temporary:
            temporary.touch()
            os.kill(os.getpid(), signal.SIGTERM)
            raise AssertionError("it went on")

    only(monkeypatch, write)
    with pytest.raises(SystemExit) as ended:
        main(["it"])
    assert ended.value.code == 128 + signal.SIGTERM
    assert capsys.readouterr().err == "cudc-bench: error: interrupted.\n"
    assert not list(tmp_path.iterdir())
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def test_what_a_killed_process_left_goes_when_the_file_is_written_again(tmp_path: Path) -> None:
    with replacing(tmp_path / "video.gif", ".gif") as temporary:
        pass_by = temporary.name
        temporary.touch()
    dead = subprocess.Popen(["true"])
    dead.wait()
    (tmp_path / pass_by.replace(str(os.getpid()), str(dead.pid))).touch()
    with replacing(tmp_path / "video.gif", ".gif") as temporary:
        temporary.touch()
    assert [path.name for path in tmp_path.iterdir()] == ["video.gif"]


def run(script: str, redirected: str = "", **env: str) -> subprocess.CompletedProcess[str]:
    """A command that does what a script says, in a new interpreter; nothing but the command line itself is imported."""
    before = "from cudc_bench.cli import app; from cudc_bench import plugins; plugins.names = lambda kind: ['it'];"
    before += "plugins.is_own = lambda kind, name: True; plugins.load = lambda kind, name: it\n"
    whole = f"{before}def it():\n    {script}\napp.main(['it'])"
    command = ["bash", "-c", f'"{sys.executable}" -c "$0" {redirected}', whole]
    return subprocess.run(command, env=os.environ | env, capture_output=True, text=True, timeout=PATIENCE)


PRINTS = "from rich.console import Console; Console().print('[red]├─ é[/]')"


@pytest.mark.parametrize(
    ("redirected", "env", "code", "out", "err"),
    [
        ("", {"PYTHONIOENCODING": "ascii"}, 0, "\\u251c\\u2500 \\xe9\n", ""),
        (">&-", {}, 0, "", ""),
        ("<&- >&- 2>&-", {}, 0, "", ""),
        ("> /dev/full", {}, 1, "", "cudc-bench: error: the system refused to go on: No space left on device.\n"),
        ("| true; exit ${PIPESTATUS[0]}", {}, 1, "", ""),
    ],
)
def test_whatever_the_streams_are_there_is_no_traceback(redirected: str, env: dict[str, str], code: int, out: str, err: str) -> None:
    done = run(PRINTS, redirected, **env)
    assert (done.returncode, done.stdout, done.stderr) == (code, out, err)


def test_no_file_takes_the_place_of_a_closed_stream(tmp_path: Path) -> None:
    read, write = os.pipe()
    if not (child := os.fork()):
        for number in (0, 1, 2):
            os.close(number)
        sys.stdin = sys.stdout = sys.stderr = None  # type: ignore[assignment]
        open_streams()
        with (tmp_path / "data").open("wb") as file:
            print("said")
            os.write(write, b"%d" % (file.fileno() > 2 and all(map(os.get_inheritable, (0, 1, 2)))))
        os._exit(0)
    os.waitpid(child, 0)
    assert os.read(read, 1) == b"1"
    assert (tmp_path / "data").read_bytes() == b""


class FatalError(Exception):
    """As MuJoCo's is called."""


@pytest.mark.parametrize(
    "error", [MemoryError(), FatalError("Could not allocate memory"), RuntimeError("DefaultCPUAllocator: can't allocate memory")]
)
def test_whoever_wants_more_memory_than_there_is_says_so(
    error: Exception, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail() -> None:
        raise error

    only(monkeypatch, fail)
    with pytest.raises(SystemExit) as ended:
        main(["it"])
    assert ended.value.code == 1
    assert capsys.readouterr().err.startswith("cudc-bench: error: there is not enough memory for these sizes; ")


def test_a_backend_that_matplotlib_does_not_know_is_no_reason_not_to_draw() -> None:
    script = """
from cudc_bench.leaderboard.show.figures.drawing import figure_files, framed
import os
assert set(figure_files("one", lambda: framed("title", {"a": {}}, 1, 1)[0], ["svg"])) == {"one.svg"}
assert os.environ["MPLBACKEND"] == "nonsense"
"""
    env = os.environ | {"MPLBACKEND": "nonsense"}
    done = subprocess.run([sys.executable, "-c", script], env=env, capture_output=True, text=True, timeout=PATIENCE)
    assert (done.returncode, done.stderr) == (0, "")
