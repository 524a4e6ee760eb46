"""The process that draws for ``drawing.py``: states come in on standard input, frames go out on standard output.

Started as ``python -m cudc_bench.envs.drawing_process JOB`` with ``MUJOCO_GL`` set. It answers ``+`` when it is ready to draw and ``-``
when OpenGL works but the domain cannot be drawn. A request is the episode's seed, the number of states, and the states; the answer
is a frame of height x width x 3 bytes for each.
"""

from __future__ import annotations

import json
import os
import sys
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from cudc_bench.envs.domains import DOMAINS
from cudc_bench.envs.drawing import OVERVIEW, REQUEST
from cudc_bench.envs.registry import check_domain, make_simulators

if TYPE_CHECKING:
    from cudc_bench.envs.simulator import Simulator

# Shadows take most of the time where a processor draws; this is half as fine as the models ask for, and hard to tell apart.
_SHADOWS = 1024
_FLOOR = 100.0  # half the quadruped's floor as it is drawn, m: at the 10 m that are simulated (an infinite plane) it walks off the picture


def main(job: dict[str, Any], requests: BinaryIO, answers: BinaryIO) -> None:
    """Draw until there are no more requests."""
    _check_opengl()
    # MuJoCo has made its choice; dm_control would make one, too, and open a display for nothing.
    os.environ["MUJOCO_GL"] = "disabled"
    try:
        painter = _Painter(job)
    except Exception:
        answers.write(b"-")
        answers.flush()
        raise
    painter.start()
    try:
        answers.write(b"+")
        answers.flush()
        while head := requests.read(REQUEST.size):
            seed, count = REQUEST.unpack(head)
            states = np.frombuffer(requests.read(count * painter.states * 8), np.float64).reshape(count, painter.states)
            painter.restart(seed)
            for state in states:
                answers.write(painter.draw(state).tobytes())
            answers.flush()
    finally:
        # Left to the interpreter's end, it would complain that OpenGL has gone before it.
        painter.renderer.close()


def _check_opengl() -> None:
    """Fail before anything else is loaded where OpenGL is missing."""
    try:
        import mujoco

        context = mujoco.GLContext(1, 1)
        context.make_current()
        context.free()
    except AttributeError:
        # PyOpenGL has None for a library that it did not find; MuJoCo has no GLContext for a system that it does not know.
        raise RuntimeError("its library is not there") from None


class _Painter:
    def __init__(self, job: dict[str, Any]) -> None:
        self._domain, self._task = job["domain"], job["task"]
        self._size = job["width"], job["height"]
        self.states = check_domain(self._domain).physics_size
        self._seed: int | None = None
        (self._simulator,) = make_simulators(self._domain, 1)
        self._model, self._data = self._simulator.compiled
        quality, limits = self._model.vis.quality, self._model.vis.global_
        quality.shadowsize = min(quality.shadowsize, _SHADOWS)
        limits.offwidth, limits.offheight = (max(pair) for pair in zip((limits.offwidth, limits.offheight), self._size, strict=True))
        if self._domain == "quadruped":
            self._model.geom("floor").size[:2] = _FLOOR
        self._camera = _overview(self._simulator, self._domain) if job["camera"] == OVERVIEW else _number(self._model, job["camera"])

    def start(self) -> None:
        """Take OpenGL; some kinds fail no earlier."""
        import mujoco

        width, height = self._size
        self.renderer = mujoco.Renderer(self._model, height, width)

    def restart(self, seed: int) -> None:
        # An environment asks for its frames one by one, and some resets take longer than a frame.
        if seed == self._seed:
            return
        self._seed = seed
        self._simulator.reset(seed)
        if self._domain == "jaco":
            self._place_target()

    def draw(self, state: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        self._simulator.set_state(state)
        self.renderer.update_scene(self._data, self._camera)
        frame: np.ndarray[Any, Any] = self.renderer.render()
        return frame

    def _place_target(self) -> None:
        """Put the model's target where the task has it: the simulator has one model for all tasks, since none observes it."""
        from cudc_bench.envs.jaco import TARGETS

        site, tasks = self._model.site("target_site"), DOMAINS["jaco"].tasks
        if self._task in tasks:
            site.pos[:] = TARGETS[tasks.index(self._task)]
            site.sameframe[:] = 0  # As compiled it lies in its body's origin, and MuJoCo would not look at its position.
        else:
            site.rgba[3] = 0.0


def _number(model: Any, camera: str) -> int:
    return int(camera) if camera.isdecimal() else int(model.camera(camera).id)


def _overview(simulator: Simulator, domain: str) -> Any:
    """A camera that shows all there is to see, for models that have none of this kind."""
    import mujoco

    model, _ = simulator.compiled
    view = mujoco.MjvCamera()
    if domain == "quadruped":
        view.type, view.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, model.body("torso").id
        view.distance, view.azimuth, view.elevation = 3.0, 135.0, -20.0
    elif domain == "jaco":
        # The whole arm, whose base is 40 cm behind the middle of the targets.
        view.lookat[:] = 0.0, 0.15, 0.3
        view.distance, view.azimuth, view.elevation = 1.6, 60.0, -30.0
    else:
        mujoco.mjv_defaultFreeCamera(model, view)
    return view


if __name__ == "__main__":
    # Whatever a driver prints must not end up among the frames.
    frames = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    try:
        main(json.loads(sys.argv[1]), sys.stdin.buffer, frames)
    except (BrokenPipeError, KeyboardInterrupt):
        os._exit(1)
    except Exception as error:
        print(str(error).splitlines()[0], file=sys.stderr, flush=True)
        # Past the clean-up of a broken OpenGL, which has more to say.
        os._exit(1)
