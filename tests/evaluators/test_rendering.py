"""From a record to a video: what is played, what is said, and what is refused. Frames come from a stand-in for OpenGL."""

import numpy as np
import pytest
from PIL import Image

import cudc_bench
from cudc_bench.artefacts.provenance import versions
from cudc_bench.envs import DOMAINS
from cudc_bench.envs.drawing import probe
from cudc_bench.envs.rewards import load_reward
from cudc_bench.errors import RunError, UsageError
from cudc_bench.evaluators.policies import rendering
from cudc_bench.evaluators.policies.rollout import recorded_seeds
from cudc_bench.evaluators.policies.stored import policy_path

from .runs import change, write_run

HOP = "def hop(measured):\n    return measured['torso_height']\n"


class Sketch:
    """Draws no state, but counts."""

    def __init__(self, domain, task, camera, width, height, gl=None):
        self.job = (domain, task, camera, width, height, gl)
        self.backend, self.asked = "pencil", []
        Sketch.last = self

    def frames(self, seed, states):
        self.asked.append((seed, states))
        for t in range(len(states)):
            frame = np.zeros((self.job[4], self.job[3], 3), np.uint8)
            frame[:, t % self.job[3]] = 255
            yield frame

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.closed = True


@pytest.fixture
def sketch(monkeypatch):
    """Puts the stand-in into its place."""
    monkeypatch.setattr(rendering, "Drawer", Sketch)
    monkeypatch.setenv("MUJOCO_GL", "disabled")


def test_the_first_episodes_of_the_final_evaluation_are_shown_with_their_returns(tmp_path, sketch, capsys):
    path, _ = write_run(tmp_path, played=4)
    done = cudc_bench.render_policy(path, tmp_path / "there" / "video.gif", episodes=2, fps=2, width=32, height=24)
    record = cudc_bench.load_policy(path).record
    assert done.returns == done.recorded == tuple(record.final.returns[:2])
    err = capsys.readouterr().err
    for episode in range(2):
        assert f"episode {episode + 1}: return {record.final.returns[episode]:.6g}, as recorded" in err
    assert Sketch.last.job == ("walker", "walk", "side", 32, 24, "disabled")
    assert Sketch.last.closed
    asked = Sketch.last.asked
    assert [seed for seed, _ in asked] == recorded_seeds(record, 2)
    # 25 s at 2 frames a second, and one at the start.
    assert [states.shape for _, states in asked] == [(51, 18), (51, 18)]
    with Image.open(tmp_path / "there" / "video.gif") as picture:
        assert picture.size == (32, 24)
        assert picture.n_frames == 102


def test_other_seeds_are_shown_without_a_comparison(tmp_path, sketch, capsys):
    path, _ = write_run(tmp_path, domain="jaco", task="reach_top_left")
    done = rendering.render_policy(path, tmp_path / "video.gif", seed=7, episodes=2, camera=0, gl="osmesa")
    assert [seed for seed, _ in Sketch.last.asked] == [7, 8]
    assert Sketch.last.job == ("jaco", "reach_top_left", "0", 320, 240, "osmesa")
    assert len(done.returns) == 2
    assert done.recorded == ()
    err = capsys.readouterr().err
    assert f"episode 2: return {done.returns[1]:.6g}, seed 8" in err
    assert "recorded" not in err


def test_a_return_that_differs_is_said_to(tmp_path, sketch, capsys):
    path, _ = write_run(tmp_path, domain="jaco", task="reach_top_left", returns=(123.0, 4.0))
    done = rendering.render_policy(path, tmp_path / "video.gif", fps=1)
    assert done.recorded == (123.0,)
    assert f"return {done.returns[0]:.6g}; 123 was recorded, where another machine" in capsys.readouterr().err


def test_a_users_own_function_runs_only_when_the_user_names_it(tmp_path, sketch, capsys, monkeypatch):
    (tmp_path / "hops2.py").write_text(HOP)
    monkeypatch.syspath_prepend(tmp_path)
    reward = load_reward("hops2:hop", DOMAINS["walker"])
    path, _ = write_run(tmp_path, task="hop", played=2, reward=reward)
    done = rendering.render_policy(path, tmp_path / "video.gif", fps=1)
    assert (done.returns, done.recorded) == ((), ())
    assert "its return needs the function that it was trained on (--reward)" in capsys.readouterr().err
    done = rendering.render_policy(path, tmp_path / "video.gif", fps=1, reward="hops2:hop")
    assert done.returns == done.recorded != ()
    with pytest.raises(UsageError, match="trained on the function hops2:hop, not on hops2:skip"):
        rendering.render_policy(path, tmp_path / "video.gif", reward="hops2:skip")
    dataset = cudc_bench.load_policy(path).record.dataset.model_dump()
    change(path, dataset=dataset | {"reward": {"reference": "hops2:hop", "sha256": "1" * 64}})
    with pytest.raises(RunError, match="hops2:hop has changed"):
        rendering.render_policy(path, tmp_path / "video.gif", reward="hops2:hop")
    path, _ = write_run(tmp_path / "task")
    with pytest.raises(UsageError, match="trained on walk, not on hops2:hop"):
        rendering.render_policy(path, tmp_path / "video.gif", reward="hops2:hop")


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"episodes": 0}, "--episodes takes 1 to 100, not 0"),
        ({"seed": -1}, "a seed cannot be -1"),
        ({"fps": 0.0}, "--fps takes 1 to 1000, not 0"),
        ({"fps": float("nan")}, "--fps takes 1 to 1000, not nan"),
        ({"width": 8}, "--width takes 16 to 4096, not 8"),
        ({"height": 5000}, "--height takes 16 to 4096, not 5000"),
        ({"camera": "sideways"}, "walker has no camera 'sideways'; allowed: side, back, 0 to 1. Did you mean 'side'"),
        ({"output": "video.webm"}, "a video cannot be 'video.webm'"),
        ({"output": "."}, "a video cannot be ''"),
        ({"output": "file/video.gif"}, "'file' is a file"),
        ({"output": "folder.gif"}, "'folder.gif' is a folder; name a file"),
    ],
)
def test_wrong_input_is_refused_before_anything_is_done(options, match, tmp_path, sketch, monkeypatch):
    path, _ = write_run(tmp_path)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    (tmp_path / "folder.gif").mkdir()
    before = sorted(tmp_path.rglob("*"))
    Sketch.last = None
    with pytest.raises(UsageError, match=match):
        rendering.render_policy(path, **{"output": "video.gif"} | options)
    assert Sketch.last is None
    assert sorted(tmp_path.rglob("*")) == before


def test_the_default_output_lies_beside_the_record(tmp_path, sketch, monkeypatch):
    path, _ = write_run(tmp_path, domain="jaco", task="reach_top_left")
    monkeypatch.setattr(rendering, "find_ffmpeg", lambda: None)
    assert rendering.render_policy(path, fps=1).path == tmp_path / "td3-seed1.gif"


def test_the_command_without_opengl_ends_in_one_line(tmp_path, cli):
    path, _ = write_run(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "sitecustomize.py").write_text(
        "import ctypes\nload = ctypes.CDLL.__init__\n"
        "def refuse(self, name, *a, **k):\n"
        "    if 'EGL' in str(name) or 'OSMesa' in str(name):\n        raise OSError(name)\n"
        "    load(self, name, *a, **k)\n"
        "ctypes.CDLL.__init__ = refuse\n"
    )
    done = cli("render", str(path), "--output", "video.gif", env={"PYTHONPATH": str(tmp_path / "empty"), "MUJOCO_GL": "osmesa"})
    assert (done.code, done.out) == (1, "")
    assert done.err.startswith("cudc-bench: error: nothing here can draw, because OpenGL without a display is missing")
    assert "apt-get install libegl1" in done.err
    assert done.err.count("\n") == 1
    assert not (tmp_path / "video.gif").exists()
    policy_path(path).unlink()
    done = cli("render", str(path), "--output", "video.gif")
    assert done.code == 1
    assert "train it again with: cudc-bench evaluate" in done.err
    assert done.err.count("\n") == 1


@pytest.mark.skipif(probe() is None, reason="nothing here can draw: neither EGL nor OSMesa is installed")
def test_the_command_makes_a_video(tmp_path, cli):
    path, _ = write_run(tmp_path, domain="jaco", task="reach_top_left", played=2)
    change(path, machine={"threads": 1}, versions=versions())
    done = cli("render", str(path), "--output", "video.gif", "--fps", "2", "--width", "64", "--height", "48", env={"MUJOCO_GL": "none"})
    assert (done.code, done.out) == (0, "video.gif\n"), done.err
    assert "as recorded" in done.err
    with Image.open(tmp_path / "video.gif") as picture:
        assert picture.size == (64, 48)
        assert picture.n_frames == 21
        assert np.asarray(picture.convert("RGB")).std() > 5
