"""A few seconds of two datasets beside each other, drawn from their physics states."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cudc_bench.data.reader import read_episodes
from cudc_bench.envs import make_simulators
from cudc_bench.envs.drawing import Drawer, check_camera
from cudc_bench.envs.video import Frame, check_length, find_ffmpeg, frame_times, write_video
from cudc_bench.execution.progress import bars, echo

from ..datasets.pair import Pair, Side

WHEN = ("first", "middle", "last")  # the episodes of a dataset from which something is shown
_FPS = 25.0
_SIZE = (320, 240)
_GAP = 8  # pixels between both


def write_film(folder: Path, pair: Pair, seconds: float) -> Path:
    """Write ``film.mp4``, or a GIF where there is no ffmpeg: of the first, the middle and the last episode the middle seconds.

    Args:
        folder: an existing one.
        pair: of two datasets.
        seconds: of each of the three; an episode that is shorter is shown whole, and its last state stays.

    Raises:
        RunError: nothing here can draw, a dataset is damaged, or the video cannot be written.
    """
    path = folder / f"film{'.mp4' if find_ffmpeg() else '.gif'}"
    (simulator,) = make_simulators(pair.domain.name, 1)
    view = check_camera(simulator, pair.domain.name, None)
    times = frame_times(round(seconds / simulator.timestep), simulator.timestep, _FPS)
    count = len(WHEN) * len(times)
    width = 2 * _SIZE[0] + _GAP
    check_length(path, count, width, _SIZE[1])
    scenes = [_scenes(side, times) for side in pair.sides]
    with Drawer(pair.domain.name, None, view, *_SIZE, os.environ.get("MUJOCO_GL")) as drawer:
        echo(f"film: {', '.join(WHEN)} episode of each, {seconds:g} s, drawn with {drawer.backend}")
        with bars([(f"draw {path.name}", count)], "frames") as (advance,):

            def frames() -> Iterator[Frame]:
                for beside in zip(*scenes, strict=True):
                    drawn = [list(drawer.frames(seed, states)) for seed, states in beside]
                    for left, right in zip(*drawn, strict=True):
                        yield _beside(left, right)
                        advance(1)

            write_video(path, frames(), count, _FPS)
    return path


def _scenes(side: Side, times: NDArray[np.int64]) -> list[tuple[int, NDArray[np.float64]]]:
    """Of three episodes the seed and the states (n, P) to draw."""
    manifest = side.manifest
    last = manifest.episodes - 1
    wanted = (0, last // 2, last)
    scenes = []
    for index, episode in zip(wanted, read_episodes(side.quality.id, ("infos/physics",), episodes=wanted), strict=True):
        states = episode["infos/physics"]
        start = max(0, (len(states) - 1 - int(times[-1])) // 2)
        scenes.append((manifest.episode_seed(index) or 0, states[np.minimum(start + times, len(states) - 1)]))
    return scenes


def _beside(left: Frame, right: Frame) -> Frame:
    gap = np.full((left.shape[0], _GAP, 3), 255, np.uint8)
    return np.concatenate([left, gap, right], axis=1)
