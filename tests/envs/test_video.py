"""Frames become files that hold them, whole or not at all. No frame here is drawn by OpenGL."""

import os
import stat
import sys

import numpy as np
import pytest
from PIL import Image

from cudc_bench.envs import video
from cudc_bench.envs.video import check_length, check_video, find_ffmpeg, frame_times, write_video
from cudc_bench.errors import RunError, UsageError

# Writes what it is given: arguments to one file, frames to the one that it is asked for.
FFMPEG = """#!{python}
import pathlib, sys
content = sys.stdin.buffer.read({limit})
if {code}:
    print("first line\\n[libx264 @ 0x1] it does not like this.\\n", file=sys.stderr)
    sys.exit({code})
pathlib.Path(sys.argv[-1]).write_bytes(content)
pathlib.Path(r"{arguments}").write_text("\\n".join(sys.argv[1:]))
"""


def moving_square(count, width=48, height=32):
    """A red square on its way to the right, on grey."""
    for frame in range(count):
        picture = np.full((height, width, 3), 90, np.uint8)
        picture[10:20, frame : frame + 10] = (200, 30, 30)
        yield picture


@pytest.fixture
def ffmpeg(tmp_path, monkeypatch):
    """Puts something else in ffmpeg's place."""

    def make(code=0, limit=-1):
        place = tmp_path / "bin" / "ffmpeg"
        place.parent.mkdir(exist_ok=True)
        place.write_text(FFMPEG.format(python=sys.executable, code=code, limit=limit, arguments=tmp_path / "arguments"))
        place.chmod(place.stat().st_mode | stat.S_IXUSR)
        monkeypatch.setattr(video, "find_ffmpeg", lambda: str(place))
        return tmp_path / "arguments"

    return make


@pytest.mark.parametrize("fps", [25, 30, 7, 50])
def test_a_gif_plays_all_frames_in_their_time(fps, tmp_path):
    path = tmp_path / "new" / "video.gif"
    write_video(path, moving_square(30), 30, fps)
    with Image.open(path) as picture:
        assert picture.info["loop"] == 0
        assert picture.n_frames == 30
        shown = 0
        for frame, expected in enumerate(moving_square(30)):
            picture.seek(frame)
            assert abs(shown - frame * 1000 / fps) <= 5
            shown += picture.info["duration"]
            assert np.abs(np.asarray(picture.convert("RGB")).astype(int) - expected).max() <= 4
    assert os.listdir(path.parent) == ["video.gif"]


def test_frames_that_stay_the_same_keep_their_time(tmp_path):
    write_video(tmp_path / "still.gif", (np.zeros((32, 32, 3), np.uint8) for _ in range(10)), 10, 25)
    with Image.open(tmp_path / "still.gif") as picture:
        times = []
        for frame in range(picture.n_frames):
            picture.seek(frame)
            times.append(picture.info["duration"])
    assert sum(times) == 400


def test_an_mp4_is_made_of_the_frames_as_they_are(ffmpeg, tmp_path):
    arguments = ffmpeg()
    write_video(tmp_path / "video.mp4", moving_square(5), 5, 29.97)
    assert (tmp_path / "video.mp4").read_bytes() == b"".join(frame.tobytes() for frame in moving_square(5))
    given = arguments.read_text().split("\n")
    for option, value in (("-s", "48x32"), ("-r", "29.97"), ("-pix_fmt", "rgb24"), ("-c:v", "libx264")):
        assert given[given.index(option) + 1] == value


@pytest.mark.skipif(find_ffmpeg() is None, reason="there is no ffmpeg: pip install 'cudc-bench[video]'")
def test_a_real_mp4_is_one(tmp_path):
    write_video(tmp_path / "video.mp4", moving_square(20), 20, 25)
    content = (tmp_path / "video.mp4").read_bytes()
    assert content[4:8] == b"ftyp"
    # With its table of contents first: it plays while it is loaded.
    assert content.index(b"moov") < content.index(b"mdat")


@pytest.mark.parametrize("limit", [-1, 10])
def test_when_ffmpeg_fails_its_last_line_says_why_and_nothing_is_left(limit, ffmpeg, tmp_path):
    ffmpeg(code=3, limit=limit)
    (tmp_path / "video.mp4").write_bytes(b"of before")
    with pytest.raises(RunError, match=r"cannot write the video .*/video.mp4: ffmpeg: \[libx264 @ 0x1\] it does not like this\.$"):
        write_video(tmp_path / "video.mp4", moving_square(500), 500, 25)
    assert (tmp_path / "video.mp4").read_bytes() == b"of before"
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
@pytest.mark.parametrize("kind", [RunError, KeyboardInterrupt])
def test_when_drawing_fails_nothing_is_left(suffix, kind, ffmpeg, tmp_path):
    ffmpeg()

    def frames():
        yield from moving_square(3)
        raise kind("in the middle")

    with pytest.raises(kind, match="in the middle"):
        write_video(tmp_path / f"video{suffix}", frames(), 10, 25)
    assert [path.name for path in tmp_path.iterdir() if path.name not in {"bin", "arguments"}] == []


def test_what_cannot_be_written_ends_in_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match=r"cannot write the video .*/file/video.gif: File exists\.$"):
        write_video(tmp_path / "file" / "video.gif", moving_square(3), 3, 25)


def test_wrong_input_is_refused_before_there_are_frames(tmp_path, monkeypatch):
    for name, size, fps, match in (
        ("video.avi", (64, 48), 25, r"a video cannot be 'video.avi'; allowed: \*.mp4, \*.gif"),
        ("video", (64, 48), 25, "a video cannot be 'video'"),
        ("video.gif", (64, 48), 60, "--fps cannot be 60 in a GIF; at most 50"),
        ("video.mp4", (63, 48), 25, "cannot be 63x48; both numbers must be even"),
    ):
        with pytest.raises(UsageError, match=match):
            check_video(tmp_path / name, *size, fps)
    check_video(tmp_path / "VIDEO.GIF", 63, 47, 25)
    monkeypatch.setattr(video, "find_ffmpeg", lambda: None)
    with pytest.raises(
        UsageError, match=r"'video.mp4' needs ffmpeg, which is not installed; pip install 'cudc-bench\[video\]', or write a"
    ):
        check_video(tmp_path / "video.mp4", 64, 48, 25)
    check_length(tmp_path / "video.mp4", 10**6, 4000, 4000)
    check_length(tmp_path / "video.gif", 626, 640, 480)
    with pytest.raises(UsageError, match="a GIF cannot have 62,600 frames of 640x480"):
        check_length(tmp_path / "video.gif", 62_600, 640, 480)


def test_the_systems_ffmpeg_serves_without_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert find_ffmpeg() is None
    place = tmp_path / "ffmpeg"
    place.write_text("#!/bin/sh\n")
    place.chmod(0o755)
    assert find_ffmpeg() == str(place)


@pytest.mark.parametrize(("steps", "timestep", "length"), [(1000, 0.025, 25.0), (1000, 0.02, 20.0), (250, 0.04, 10.0), (1000, 0.01, 10.0)])
@pytest.mark.parametrize("fps", [1, 25, 30, 29.97, 60, 500])
def test_frames_show_an_episode_in_real_time(steps, timestep, length, fps):
    times = frame_times(steps, timestep, fps)
    assert times[0] == 0
    assert abs(len(times) / fps - length) <= 1 / fps + 1e-9
    assert times.max() <= steps
    for frame, state in enumerate(times):
        assert abs(frame / fps - state * timestep) <= timestep / 2 + 1e-9
