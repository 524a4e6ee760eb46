"""States become pictures, in a process whose end is one clear line. What needs OpenGL is skipped where there is none."""

import os
import signal

import numpy as np
import pytest

from cudc_bench.envs import DOMAINS, make_simulators
from cudc_bench.envs.drawing import OVERVIEW, Drawer, backends, check_camera, environment, probe
from cudc_bench.errors import RunError, UsageError

WITHOUT_OPENGL = """
import ctypes
load = ctypes.CDLL.__init__
def refuse(self, name, *arguments, **options):
    if name and any(library in str(name) for library in ("EGL", "OSMesa", "glfw")):
        raise OSError(f"{name}: cannot open shared object file")
    load(self, name, *arguments, **options)
ctypes.CDLL.__init__ = refuse
"""
CRASHES = """
import os, sys
if os.environ.get("MUJOCO_GL") in ("egl", "osmesa") and "cudc_bench.envs.drawing_process" in " ".join(sys.orig_argv):
    os.kill(os.getpid(), 11)
"""


@pytest.fixture(scope="module")
def works():
    """Skips a test where nothing can draw."""
    backend = probe()
    if backend is None:
        pytest.skip("nothing here can draw: neither EGL nor OSMesa is installed")
    return backend


@pytest.fixture
def in_children(tmp_path, monkeypatch):
    """Runs a script at the start of every process."""

    def prepare(script):
        (tmp_path / "sitecustomize.py").write_text(script)
        monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    return prepare


def states_of(domain, seed, steps):
    """A simulator and the states (n, P) that constant actions lead to, after each of some numbers of steps."""
    (simulator,) = make_simulators(domain, 1)
    found = np.empty((len(steps), DOMAINS[domain].physics_size))
    simulator.reset(seed)
    for t in range(max(steps) + 1):
        if t in steps:
            simulator.state(found[steps.index(t)])
        simulator.step(np.full(DOMAINS[domain].action_size, 0.5, np.float32))
    return simulator, found


@pytest.mark.parametrize("domain", DOMAINS)
def test_the_body_is_seen_moving(domain, works):
    simulator, states = states_of(domain, 1, [0, 30])
    states = np.concatenate([states, states[:1]])
    with Drawer(domain, DOMAINS[domain].tasks[0], check_camera(simulator, domain, None), 96, 64) as drawer:
        assert drawer.backend == works
        first, second, again = drawer.frames(1, states)
        (other,) = drawer.frames(1, states[1:2])
    assert first.shape == (64, 96, 3)
    assert first.dtype == np.uint8
    assert 20 < first.mean() < 200  # lit
    assert (np.abs(first.astype(int) - second).max(-1) > 30).sum() > 40
    assert (first == again).all()
    assert (second == other).all()


def test_an_arms_target_is_where_its_task_has_it(works):
    simulator, states = states_of("jaco", 1, [0])
    places = {}
    for task in (*DOMAINS["jaco"].tasks, None):
        with Drawer("jaco", task, check_camera(simulator, "jaco", None), 320, 240) as drawer:
            (frame,) = drawer.frames(1, states)
        red = (frame[..., 0].astype(int) - frame[..., 1:].max(-1)) > 60
        places[task] = (red.sum(), *(np.argwhere(red).mean(0) if red.any() else (0, 0)))
    assert places.pop(None)[0] == 0
    assert all(count > 30 for count, _, _ in places.values())
    # From this side, top is behind bottom, and left of it.
    row = {task: place[1] for task, place in places.items()}
    assert max(row["reach_top_left"], row["reach_top_right"]) < min(row["reach_bottom_left"], row["reach_bottom_right"])
    assert len({place[1:] for place in places.values()}) == 4


def test_a_quadruped_far_from_home_still_stands_on_a_floor(works):
    simulator, states = states_of("quadruped", 1, [0])
    far = states.copy()
    far[0, :2] = 30.0
    with Drawer("quadruped", None, check_camera(simulator, "quadruped", None), 96, 64) as drawer:
        here, there = drawer.frames(1, np.concatenate([states, far]))
    assert abs(here.mean() - there.mean()) < 5
    assert (np.abs(here.astype(int) - there).max(-1) < 40).mean() > 0.9


@pytest.mark.parametrize(("domain", "drawn"), [("dm_control/cheetah-run", False), ("dm_control/reacher-easy", True)])
def test_domains_of_the_suite_are_drawn_too(domain, drawn, works):
    (simulator,) = make_simulators(domain, 1)
    states = np.empty((1, simulator.sizes[2]))
    simulator.reset(3)
    simulator.state(states[0])
    with Drawer(domain, None, check_camera(simulator, domain, None), 96, 64) as drawer:
        (frame,) = drawer.frames(3, states)
        (other,) = drawer.frames(4, states)
    assert frame.std() > 5
    # A target that the reset draws is the episode's own.
    assert (frame != other).any() == drawn


def test_a_drawing_process_that_dies_ends_in_one_line(works):
    _, states = states_of("walker", 1, [0])
    with Drawer("walker", "walk", "side", 64, 64) as drawer:
        list(drawer.frames(1, states))
        os.kill(drawer._process.pid, signal.SIGKILL)
        with pytest.raises(RunError, match=f"draws with {works} ended early: killed by signal 9; MUJOCO_GL=.* may work") as caught:
            list(drawer.frames(1, np.repeat(states, 1000, 0)))
    assert "\n" not in str(caught.value)
    assert drawer._process.returncode == -9


def test_without_opengl_one_line_says_what_to_install(in_children):
    in_children(WITHOUT_OPENGL)
    assert probe() is None
    with pytest.raises(RunError) as caught:
        Drawer("walker", "walk", "side", 64, 64)
    message = str(caught.value)
    assert message.startswith("nothing here can draw, because OpenGL without a display is missing (egl: its library is not there; osmesa: ")
    assert "libegl1" in message
    assert "libosmesa6" in message
    assert "\n" not in message


def test_a_driver_that_crashes_takes_only_its_process_with_it(in_children):
    in_children(CRASHES)
    with pytest.raises(RunError, match=r"\(egl: killed by signal 11; osmesa: killed by signal 11\)"):
        Drawer("walker", "walk", "side", 64, 64)


def test_what_the_user_chose_is_tried_first(monkeypatch):
    assert backends() == backends("") == backends("disabled") == backends("off") == ("egl", "osmesa")
    assert backends("osmesa") == ("osmesa", "egl")
    assert backends(" GLFW ") == ("glfw", "egl", "osmesa")
    # MuJoCo leaves this behind in a process that has drawn.
    monkeypatch.setenv("PYOPENGL_PLATFORM", "egl")
    monkeypatch.setenv("MUJOCO_GL", "egl")
    found = environment("osmesa")
    assert found["MUJOCO_GL"] == "osmesa"
    assert "PYOPENGL_PLATFORM" not in found
    assert os.environ["MUJOCO_GL"] == "egl"


@pytest.mark.parametrize(
    ("domain", "usual", "allowed"),
    [("walker", "side", ["back", "1"]), ("quadruped", OVERVIEW, ["x", "3", OVERVIEW]), ("jaco", OVERVIEW, ["front_close", "0"])],
)
def test_a_camera_is_one_of_the_models(domain, usual, allowed):
    (simulator,) = make_simulators(domain, 1)
    assert check_camera(simulator, domain, None) == usual
    for camera in allowed:
        assert check_camera(simulator, domain, camera) == camera
    for camera in ("sideways", "9", "-1", ""):
        with pytest.raises(UsageError, match=f"{domain} has no camera '{camera}'; allowed: .*{usual}"):
            check_camera(simulator, domain, camera)
