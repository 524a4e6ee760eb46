"""Draws states of a domain, in a process of its own.

MuJoCo chooses its OpenGL when it is first imported, and this package tells it to have none (see ``cudc_bench/__init__.py``). A driver that
crashes takes its process with it. So a second process draws: it gets states and gives frames (``drawing_process.py``).
"""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from cudc_bench.errors import RunError, UsageError, nearest

if TYPE_CHECKING:
    from cudc_bench.envs.simulator import Float64, Simulator

Frame = NDArray[np.uint8]
BACKENDS = ("egl", "osmesa")
INSTALL = "on Debian and Ubuntu, 'apt-get install libegl1 libgl1-mesa-dri' (EGL) or 'apt-get install libosmesa6' (OSMesa) installs it"
# What MuJoCo itself takes for "no OpenGL".
_NONE = {"", "disabled", "disable", "off", "false", "0"}
# Of the domains whose models have no camera that shows all there is to see; see drawing_process.py.
OVERVIEW = "overview"
_CAMERAS: dict[str, str] = {"walker": "side", "quadruped": OVERVIEW, "jaco": OVERVIEW}
SMALLEST, LARGEST = 16, 4096  # width and height of frames, pixels
REQUEST = struct.Struct("<QQ")  # the head of one: seed, number of states


def backends(first: str | None = None) -> tuple[str, ...]:
    """The kinds of OpenGL to try, in order.

    Args:
        first: as the user chose it, such as ``MUJOCO_GL`` says; passed over if it means none.
    """
    chosen = (first or "").strip().lower()
    return tuple(dict.fromkeys((*(() if chosen in _NONE else (chosen,)), *BACKENDS)))


def environment(backend: str) -> dict[str, str]:
    """The environment of a process that draws with a kind of OpenGL."""
    found = os.environ | {"MUJOCO_GL": backend, "PYTHONFAULTHANDLER": "0"}
    # MuJoCo sets it for its own process, and a child would inherit the parent's kind.
    found.pop("PYOPENGL_PLATFORM", None)
    return found


def probe(first: str | None = None) -> str | None:
    """The kind of OpenGL that works here, found in processes that make a context and end; None if there is none."""
    script = "import mujoco; context = mujoco.GLContext(32, 32); context.make_current(); context.free()"
    for backend in backends(first):
        try:
            done = subprocess.run([sys.executable, "-c", script], env=environment(backend), capture_output=True, timeout=60)
        except (OSError, subprocess.TimeoutExpired):
            continue
        if done.returncode == 0:
            return backend
    return None


def check_camera(simulator: Simulator, domain: str, camera: str | None) -> str:
    """The camera to draw a domain with: a name of the model's, a number, or :data:`OVERVIEW`.

    Args:
        simulator: of the domain.
        domain: its name.
        camera: as the user gave it; None for the one that shows the domain best.

    Raises:
        UsageError: the model has no such camera.
    """
    model, _ = simulator.compiled
    names = [model.camera(i).name for i in range(model.ncam)]
    if camera is None:
        return _CAMERAS.get(domain, "0" if names else OVERVIEW)
    own = [OVERVIEW] if _CAMERAS.get(domain) == OVERVIEW or not names else []
    if camera in names or camera in own or camera in map(str, range(len(names))):
        return camera
    allowed = [*own, *filter(None, names)]
    numbers = [f"0 to {len(names) - 1}"] if len(names) > 1 else ["0"][: len(names)]
    raise UsageError(f"{domain} has no camera '{camera}'; allowed: {', '.join([*allowed, *numbers])}.{nearest(camera, allowed)}")


class Drawer:
    """A process that draws one domain; use it as a context.

    Args:
        domain: its name.
        task: whose target is shown, where the domain has targets; None or an unknown one for none.
        camera: as :func:`check_camera` gave it.
        width, height: of the frames, pixels.
        gl: the kind of OpenGL to try first.

    Attributes:
        backend: the kind of OpenGL that draws.

    Raises:
        RunError: nothing here can draw; the message says what to install.
    """

    def __init__(self, domain: str, task: str | None, camera: str, width: int, height: int, gl: str | None = None) -> None:
        self._shape = (height, width, 3)
        job = json.dumps({"domain": domain, "task": task, "camera": camera, "width": width, "height": height})
        reasons = []
        for backend in backends(gl):
            self.backend = backend
            # Not a pipe: nobody would empty it.
            self._complaints = tempfile.TemporaryFile()  # noqa: SIM115 - close() closes it
            self._process = subprocess.Popen(
                [sys.executable, "-m", "cudc_bench.envs.drawing_process", job], env=environment(backend),
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._complaints,
            )  # fmt: skip
            try:
                ready = self._output.read(1)
            except BaseException:
                self.close()
                raise
            if ready == b"+":
                return
            reasons.append(f"{backend}: {self._ending()}")
            self.close()
            if ready == b"-":
                raise RunError(f"{domain} cannot be drawn: {reasons[-1]}.")
        raise RunError(f"nothing here can draw, because OpenGL without a display is missing ({'; '.join(reasons)}); {INSTALL}.")

    def frames(self, seed: int, states: Float64) -> Iterator[Frame]:
        """Draw states.

        Args:
            seed: with which their episode was reset: some models are changed by a reset.
            states: (n, P).

        Yields:
            n frames (height, width, 3), RGB.

        Raises:
            RunError: the process died.
        """
        try:
            self._input.write(REQUEST.pack(seed, len(states)) + np.ascontiguousarray(states, np.float64).tobytes())
            self._input.flush()
        except OSError:
            raise self._died() from None
        size = self._shape[0] * self._shape[1] * self._shape[2]
        for _ in range(len(states)):
            content = self._output.read(size)
            if len(content) < size:
                raise self._died()
            yield np.frombuffer(content, np.uint8).reshape(self._shape)

    def close(self) -> None:
        """End the process."""
        for stream in (self._input, self._output):
            with suppress(OSError):  # what could not be sent any more
                stream.close()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._complaints.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def _input(self) -> Any:
        return self._process.stdin

    @property
    def _output(self) -> Any:
        return self._process.stdout

    def _died(self) -> RunError:
        return RunError(
            f"the process that draws with {self.backend} ended early: {self._ending()}; MUJOCO_GL={_other(self.backend)} may work."
        )

    def _ending(self) -> str:
        """How the process ended, in a few words: the last line that it wrote, or its exit status."""
        code = self._process.wait()
        self._complaints.seek(0)
        lines = self._complaints.read().decode(errors="replace").split("\n")
        last = next((line.strip() for line in reversed(lines) if line.strip()), "")
        if code < 0 or not last:
            return f"killed by signal {-code}" if code < 0 else f"exit status {code}"
        return last.rstrip(".")[:200]


def _other(backend: str) -> str:
    return next(one for one in BACKENDS if one != backend)
