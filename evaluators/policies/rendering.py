"""``render``: from a run record to a video of its policy."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cudc_bench.artefacts.records import Record
from cudc_bench.envs import check_domain, make_simulators
from cudc_bench.envs.drawing import LARGEST, SMALLEST, Drawer, check_camera
from cudc_bench.envs.rewards import CustomReward, load_reward
from cudc_bench.envs.video import Frame, check_length, check_video, find_ffmpeg, frame_times, write_video
from cudc_bench.errors import RunError, UsageError
from cudc_bench.execution.parallel import Job, cores, run_jobs
from cudc_bench.execution.progress import Advance, bars, echo
from cudc_bench.files import check_file, check_path

from .rollout import Played, play, recorded_seeds
from .stored import check_record, load_policy

_SIZES = {".mp4": (640, 480), ".gif": (320, 240)}
_MOST_EPISODES = 100


@dataclass(frozen=True)
class Rendering:
    """A video and what it shows.

    Attributes:
        path: of the video.
        returns: undiscounted, of each episode; empty if they were not measured.
        recorded: what the record says of the same episodes; shorter or empty if they are not the record's.
    """

    path: Path
    returns: tuple[float, ...]
    recorded: tuple[float, ...]


def render_policy(
    record: str | Path,
    output: str | Path | None = None,
    *,
    episodes: int = 1,
    seed: int | None = None,
    width: int | None = None,
    height: int | None = None,
    fps: float = 25.0,
    camera: str | int | None = None,
    reward: str | None = None,
    gl: str | None = None,
) -> Rendering:
    """Play the trained policy of a record and write a video of it, in real time.

    Without a seed the episodes are the first of the record's final evaluation. On the machine and with the versions that made the
    record, their returns are then the recorded ones exactly.

    Args:
        record: path of the record; its policy lies beside it.
        output: ``*.mp4`` or ``*.gif``; beside the record unless given, an MP4 where ffmpeg is installed and a GIF elsewhere. A file
            that is there is replaced.
        episodes: how many, one after the other.
        seed: reset the episodes with this seed and those that follow it, instead of the record's.
        width, height: of the frames in pixels; 640x480 in an MP4 and 320x240 in a GIF.
        fps: frames a second.
        camera: a name or number of the model's; one that shows the domain well unless given.
        reward: the function that the policy was trained on, if it was a user's own; without it, its return is not measured.
        gl: the kind of OpenGL to try first, such as ``"osmesa"``; what ``MUJOCO_GL`` says unless given.

    Raises:
        UsageError: wrong input; nothing has been done.
        RunError: the record or its policy cannot be used, nothing here can draw, or the video cannot be written.
    """
    place = check_record(record)
    _check_numbers(episodes, seed, fps)
    path = place.with_suffix(".mp4" if find_ffmpeg() else ".gif") if output is None else check_path(output, "the output")
    size = _size(path, width, height)
    check_video(path, *size, fps)
    check_file(path, "the output")

    policy = load_policy(place)
    found = policy.record
    facts = check_domain(found.dataset.domain)
    custom = _check_reward(found, reward)
    (simulator,) = make_simulators(facts.name, 1)
    view = check_camera(simulator, facts.name, None if camera is None else str(camera))
    seeds = recorded_seeds(found, episodes) if seed is None else [seed + episode for episode in range(episodes)]
    recorded = found.final.returns[:episodes] if seed is None else []
    chosen = frame_times(facts.episode_length, simulator.timestep, fps)
    check_length(path, episodes * len(chosen), *size)
    # It starts first: where nothing can draw, no episode is played for nothing.
    with Drawer(facts.name, found.dataset.task, view, *size, os.environ.get("MUJOCO_GL") if gl is None else gl) as drawer:
        length = facts.episode_length * simulator.timestep
        echo(f"render {found.algorithm} on {found.labelled_id}: {episodes} x {length:g} s, drawn with {drawer.backend}")
        played = _play(
            f"play {found.dataset.task}", episodes * facts.episode_length, _threads(found), policy=policy, seeds=seeds, recorded=recorded,
            reward=custom,
        )  # fmt: skip
        for episode, one in enumerate(played):
            echo(f"episode {episode + 1}: {_outcome(one)}")
        with bars([(f"draw {path.name}", len(chosen) * episodes)], "frames") as (advance,):
            write_video(path, _frames(drawer, played, chosen, advance), len(chosen) * episodes, fps)
    returns = tuple(one.total for one in played if one.total is not None)
    return Rendering(path, returns, tuple(one.recorded for one in played if one.recorded is not None))


def _check_numbers(episodes: int, seed: int | None, fps: float) -> None:
    if not 1 <= episodes <= _MOST_EPISODES:
        raise UsageError(f"--episodes takes 1 to {_MOST_EPISODES}, not {episodes}.")
    if seed is not None and seed < 0:
        raise UsageError(f"a seed cannot be {seed}; it must be 0 or more.")
    if not (np.isfinite(fps) and 1 <= fps <= 1000):
        raise UsageError(f"--fps takes 1 to 1000, not {fps:g}.")


def _size(path: Path, width: int | None, height: int | None) -> tuple[int, int]:
    """Of the frames: what was asked for, or else what is usual for such a video."""
    usual = _SIZES.get(path.suffix.lower(), _SIZES[".mp4"])
    size = (usual[0] if width is None else width, usual[1] if height is None else height)
    for option, value in zip(("--width", "--height"), size, strict=True):
        if not SMALLEST <= value <= LARGEST:
            raise UsageError(f"{option} takes {SMALLEST} to {LARGEST}, not {value}.")
    return size


def _play(description: str, steps: int, threads: int, **arguments: object) -> list[Played]:
    (played,) = run_jobs(play, [Job(description, steps, dict(arguments))], unit="steps", workers=1, threads=threads)
    found: list[Played] = played
    return found


def _threads(record: Record) -> int:
    """As many as the record was made with, if there are: with others, sums are formed in another order."""
    threads = record.machine.get("threads")
    return threads if isinstance(threads, int) and 1 <= threads <= cores() else cores()


def _frames(drawer: Drawer, played: Sequence[Played], chosen: np.ndarray, advance: Advance) -> Iterator[Frame]:
    for one in played:
        for frame in drawer.frames(one.seed, one.states[chosen]):
            yield frame
            advance(1)


def _outcome(played: Played) -> str:
    if played.total is None:
        return f"seed {played.seed}; its return needs the function that it was trained on (--reward)"
    if played.recorded is None:
        return f"return {played.total:.6g}, seed {played.seed}"
    if played.total == played.recorded:
        return f"return {played.total:.6g}, as recorded"
    return f"return {played.total:.6g}; {played.recorded:.6g} was recorded, where another machine, device or version rounded differently"


def _check_reward(record: Record, reward: str | None) -> CustomReward | None:
    """The function that a policy was trained on. Records come from others: what one names runs only if the user names it, too.

    Raises:
        UsageError: it is another one, or the policy was trained on a task.
        RunError: it has changed since.
    """
    there = record.dataset.reward
    if reward is None:
        return None
    if there is None:
        raise UsageError(f"the policy was trained on {record.dataset.task}, not on {reward}; leave out --reward.")
    if reward != there.reference:
        raise UsageError(f"the policy was trained on the function {there.reference}, not on {reward}; give --reward {there.reference}.")
    custom = load_reward(reward, check_domain(record.dataset.domain))
    if custom.sha256 != there.sha256:
        raise RunError(f"the function {reward} has changed since the policy was trained on it; leave out --reward, or train again.")
    return custom
