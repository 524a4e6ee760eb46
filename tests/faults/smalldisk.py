"""A process that runs commands on a disk of its own, as small and as read-only as a test wants it.

``python -m tests.faults.smalldisk FOLDER`` takes requests as lines of JSON; :class:`SmallDisk` starts it in a user and mount namespace,
where a tmpfs can be mounted without being seen by, or needing anything of, the rest of the machine. Commands run in processes that are
forked from one that has imported everything, which saves seconds for each.
"""

from __future__ import annotations

import io
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import redirect_stderr
from pathlib import Path
from typing import Any, NamedTuple

from tests import ROOT

BALLAST = "ballast"


class Ended(NamedTuple):
    """How a command ended."""

    code: int
    out: str
    err: str

    @property
    def line(self) -> str:
        """The last line that it said."""
        return (self.err.splitlines() or [""])[-1]


class SmallDisk:
    """The disk, and commands on it.

    Args:
        folder: an empty one, where the disk is mounted and what commands say is kept.

    Attributes:
        place: the disk, as commands name it.
        seen: the same disk, as the rest of the machine sees it.
    """

    def __init__(self, folder: Path) -> None:
        self.place = folder / "disk"
        self.place.mkdir()
        command = ["unshare", "-rm", sys.executable, "-m", "tests.faults.smalldisk", str(folder)]
        self._process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.seen = Path(f"/proc/{self._ask(hello=True)}/root{self.place}")

    @staticmethod
    def obstacle() -> str | None:
        """Why there cannot be one here, or None."""
        if shutil.which("unshare") is None:
            return "there is no unshare(1) here, so that no disk of its own can be mounted"
        tried = subprocess.run(["unshare", "-rm", "mount", "-t", "tmpfs", "none", "/mnt"], capture_output=True, text=True)
        return f"no disk of its own can be mounted here: {tried.stderr.strip()}" if tried.returncode else None

    def mount(self, size: str = "64m") -> None:
        """Put a fresh, empty disk in place of what there was."""
        self._ask(mount=size)

    def remount(self, options: str) -> None:
        """Change the disk's options, such as ``"ro"`` or ``"size=1m"``; what is on it stays."""
        self._ask(remount=options)

    def leave(self, size: int) -> None:
        """Fill the disk but for so many bytes; what filled it before goes first."""
        (self.seen / BALLAST).unlink(missing_ok=True)
        found = os.statvfs(self.seen)
        ballast = max(0, found.f_bavail * found.f_frsize - size)
        with (self.seen / BALLAST).open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, max(ballast, 1))

    def free(self) -> None:
        """Take away what :meth:`leave` filled the disk with."""
        (self.seen / BALLAST).unlink(missing_ok=True)

    def run(self, *command: str) -> Ended:
        """``cudc-bench`` with its datasets and thresholds on the disk."""
        return Ended(*self._ask(run=command))

    def listed(self) -> str:
        """What ``minari list local`` prints."""
        code, out, err = self._ask(minari=["list", "local", "--all"])
        assert code == 0, err
        return str(out)

    def files(self) -> list[str]:
        """Everything on the disk but what fills it."""
        return sorted(path.relative_to(self.seen).as_posix() for path in self.seen.rglob("*") if path.name != BALLAST)

    def close(self) -> None:
        """End the process, and with it the disk."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()

    def _ask(self, **request: Any) -> Any:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())


def forked(function: Callable[[], Any], said: Path) -> Callable[[], Ended]:
    """Start a function in a process of its own; what is returned waits for its end. The function may end by ``sys.exit``.

    Args:
        function: what to do.
        said: a path, of which files beside it keep what is printed.
    """
    out, err = said.with_suffix(".out"), said.with_suffix(".err")
    child = os.fork()
    if not child:
        code: Any = 99
        try:
            for number, path in ((1, out), (2, err)):
                os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
            function()
        except SystemExit as ended:
            code = ended.code or 0
        except BaseException:
            import traceback

            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)

    def wait() -> Ended:
        _, status = os.waitpid(child, 0)
        return Ended(os.waitstatus_to_exitcode(status), out.read_text(), err.read_text())

    return wait


def serve(folder: Path) -> None:
    """Answer requests until there are no more."""
    import minari.cli

    import cudc_bench
    from cudc_bench.cli import app as cli

    from .. import imported  # noqa: F401

    # What a process has imported once, those forked from it need not import again.
    with tempfile.TemporaryDirectory() as name, redirect_stderr(io.StringIO()):
        os.environ["MINARI_DATASETS_PATH"] = name
        cudc_bench.relabel(*cudc_bench.collect("icm", profile="smoke", settings={"steps": 1010, "seed_steps": 1000}), ["walk"])
        settings = {"evaluate_every": 1, "evaluation_episodes": 1, "final_episodes": 1}
        short: dict[str, Any] = {"profile": "smoke", "steps": 1, "settings": settings, "output": f"{name}/results"}
        (record,) = cudc_bench.evaluate("td3", dataset_id="walker/walk/icm-smoke-v0", **short)
        cudc_bench.export_policy(record)
        cudc_bench.make_leaderboard(f"{name}/results", f"{name}/report")
    disk = folder / "disk"
    os.chdir(folder)
    os.environ |= {
        "MINARI_DATASETS_PATH": str(disk / "datasets"), "CUDC_BENCH_THRESHOLDS": str(disk / "thresholds.json"),
        "CUDC_BENCH_PROFILE": "smoke", "COLUMNS": "200",
    }  # fmt: skip

    def answer(request: dict[str, Any]) -> Any:
        match request:
            case {"hello": _}:
                return os.getpid()
            case {"mount": size}:
                subprocess.run(["umount", str(disk)], stderr=subprocess.DEVNULL, check=False)
                return subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(disk)], check=True).returncode
            case {"remount": options}:
                return subprocess.run(["mount", "-o", f"remount,{options}", str(disk)], check=True).returncode
            case {"run": command}:
                return forked(lambda: cli.main(command), folder / "said")()
            case {"minari": command}:
                return forked(lambda: minari.cli.app(command), folder / "said")()

    for line in sys.stdin:
        print(json.dumps(answer(json.loads(line))), flush=True)


if __name__ == "__main__":
    serve(Path(sys.argv[1]))
