"""Commands that something goes wrong with, and how they end then."""

from __future__ import annotations

from typing import Any

from .smalldisk import Ended

HDF5 = "data/main_data.hdf5"
COLLECT = ("collect", "--method", "random", "--workers", "1", "--set", "steps=1000")
SHORT = ("--set", "gradient_steps=4", "--set", "evaluate_every=2", "--set", "milestones=[4]", "--set", "evaluation_episodes=1")
EVALUATE = ("evaluate", "--algo", "td3", "--workers", "1", *SHORT, "--set", "final_episodes=1")
PILOT_SETTINGS = ("--set", "steps=2400", "--set", "seed_steps=500", "--set", "update_every=10")
PILOT = ("pilot", "--method", "cudc-vary-icm", "--workers", "1", *PILOT_SETTINGS)
FULL = "No space left on device; free some space and run the same command again."
TIMED = {"seconds", "created"}


def but(command: tuple[str, ...], **settings: Any) -> tuple[str, ...]:
    """A command with other settings."""
    words = [word for word in command if word != "--set" and word.partition("=")[0] not in settings]
    return tuple(
        part
        for word in [*words, *(f"{name}={value}" for name, value in settings.items())]
        for part in (("--set", word) if "=" in word else (word,))
    )


def refused(done: Ended, code: int, *words: str) -> None:
    """It ended with a code and one line that has some words."""
    lines = [line for line in done.err.splitlines() if "cudc-bench: error:" in line]
    assert (done.code, len(lines)) == (code, 1), done.err
    assert "Traceback" not in done.err
    assert done.line == lines[0]
    for word in words:
        assert word in lines[0], lines[0]


def timeless(value: Any) -> Any:
    """A record or thresholds without what tells the time."""
    if isinstance(value, dict):
        return {name: timeless(one) for name, one in value.items() if name not in TIMED}
    return [timeless(one) for one in value] if isinstance(value, list) else value
