"""Frames into video files: GIF by Pillow, MP4 by ffmpeg."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from importlib import import_module
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cudc_bench.errors import UsageError
from cudc_bench.files import replacing, sync, unwritable

Frame = NDArray[np.uint8]
SUFFIXES = (".mp4", ".gif")
_GIF_COLOURS = 255  # one less than there can be: the free one stands for "as in the frame before"
_GIF_LARGEST_FPS = 50  # viewers slow down frames that are shorter than 20 ms
_GIF_LARGEST_PIXELS = 2_000_000_000  # of all frames together: all are in memory, a byte for each
_CRF = "20"  # x264's quality; 23 is its default, and smaller is better


def check_video(path: Path, width: int, height: int, fps: float) -> None:
    """Refuse what :func:`write_video` could not do, before there are frames.

    Raises:
        UsageError: the suffix is unknown, a size does not fit it, or MP4 cannot be written here.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise UsageError(f"a video cannot be '{path.name}'; allowed: {', '.join('*' + one for one in SUFFIXES)}.")
    if suffix == ".gif" and fps > _GIF_LARGEST_FPS:
        raise UsageError(f"--fps cannot be {fps:g} in a GIF; at most {_GIF_LARGEST_FPS} are allowed.")
    if suffix == ".mp4" and (width % 2 or height % 2):
        raise UsageError(f"a frame of an MP4 cannot be {width}x{height}; both numbers must be even.")
    if suffix == ".mp4" and find_ffmpeg() is None:
        raise UsageError(f"'{path.name}' needs ffmpeg, which is not installed; pip install 'cudc-bench[video]', or write a *.gif.")


def check_length(path: Path, count: int, width: int, height: int) -> None:
    """Refuse a GIF that would not fit into memory.

    Raises:
        UsageError: it has too many frames of that size.
    """
    if path.suffix.lower() == ".gif" and count * width * height > _GIF_LARGEST_PIXELS:
        raise UsageError(f"a GIF cannot have {count:,} frames of {width}x{height}; write an *.mp4, or fewer or smaller ones.")


def find_ffmpeg() -> str | None:
    """The ffmpeg of the extra ``[video]``, or the system's; None if there is neither."""
    try:
        return str(import_module("imageio_ffmpeg").get_ffmpeg_exe())
    except (ImportError, RuntimeError):  # the package is there, but without an executable for this machine
        return shutil.which("ffmpeg")


def frame_times(steps: int, timestep: float, fps: float) -> np.ndarray:
    """The states (row 0 is the reset's) that frames at times 0, 1/fps, … show, so that an episode plays in real time.

    Args:
        steps: T, of the episode.
        timestep: of one of them, s.
        fps: frames a second.
    """
    # A whole number of frames may come out a rounding short.
    count = int(steps * timestep * fps + 1e-6) + 1
    return np.minimum(np.round(np.arange(count) / fps / timestep).astype(int), steps)


def write_video(path: Path, frames: Iterable[Frame], count: int, fps: float) -> None:
    """Write a file, whole or not at all; one that is there is replaced.

    Args:
        path: ``*.gif`` or ``*.mp4``, as :func:`check_video` let it pass.
        frames: (height, width, 3) each, all of one size; taken one after the other.
        count: how many frames.
        fps: frames a second.

    Raises:
        RunError: it cannot be written there, or ffmpeg failed. What making the frames raises passes through.
    """
    write = _write_gif if path.suffix.lower() == ".gif" else _write_mp4
    try:
        with replacing(path, path.suffix) as temporary:
            write(temporary, iter(frames), count, fps)
            sync(temporary)
    except OSError as error:
        raise unwritable(f"the video {path}", error) from None


def _write_gif(path: Path, frames: Iterator[Frame], count: int, fps: float) -> None:
    from PIL import Image

    first = Image.fromarray(next(frames))
    # One palette and no dithering: what stays the same then stays the same to the bit, and the file is a third of the size.
    palette = first.quantize(_GIF_COLOURS)
    pictures = (one.quantize(palette=palette, dither=Image.Dither.NONE) for one in chain([first], map(Image.fromarray, frames)))
    # In ms, of which the format knows tens only: rounded so that frames are never late by more than half of that.
    ends = np.round(np.arange(count + 1) * 100.0 / fps).astype(int) * 10
    next(pictures).save(path, save_all=True, append_images=pictures, duration=np.diff(ends).tolist(), loop=0)


def _write_mp4(path: Path, frames: Iterator[Frame], count: int, fps: float) -> None:
    first = next(frames)
    height, width, _ = first.shape
    command = [
        str(find_ffmpeg()), "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:g}",
        "-i", "-", "-an", "-c:v", "libx264", "-crf", _CRF, "-pix_fmt", "yuv420p", "-movflags", "+faststart", str(path),
    ]  # fmt: skip
    with tempfile.TemporaryFile() as complaints:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=complaints)
        assert process.stdin is not None
        try:
            for frame in chain([first], frames):
                try:
                    process.stdin.write(np.ascontiguousarray(frame).tobytes())
                except OSError:  # it has ended; its exit status says why
                    break
            process.stdin.close()
        except OSError:
            pass
        except BaseException:
            process.kill()
            raise
        finally:
            code = process.wait()
        if code:
            complaints.seek(0)
            lines = complaints.read().decode(errors="replace").split("\n")
            last = next((line.strip() for line in reversed(lines) if line.strip()), f"exit status {code}")
            raise OSError(f"ffmpeg: {last.rstrip('.')}")
