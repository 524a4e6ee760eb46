"""What to run next, as a command that works as it is printed."""

from __future__ import annotations

import os
from collections.abc import Sequence

from cudc_bench.artefacts.manifest import read_manifest
from cudc_bench.artefacts.provenance import command_line
from cudc_bench.settings.profiles import PROFILES, resolve_profile


def evaluate_on(ids: Sequence[str], tasks: Sequence[str] | None = None, reward: str | None = None) -> str:
    """The command that trains on datasets.

    Args:
        ids: of them, task-agnostic or labelled; there is one at least, and all are of one profile.
        tasks: that task-agnostic ones are labelled for; None for all.
        reward: an own reward function that they are labelled by.
    """
    options = {"--algo": "td3", "--dataset-id": ",".join(ids)}
    if tasks is not None:
        options["--task"] = ",".join(tasks)
    if reward is not None:
        options["--reward"] = reward
    # What was collected at one profile is trained on at the same; imported data go with any.
    usual = resolve_profile(os.environ.get("CUDC_BENCH_PROFILE") or "auto").name
    if (profile := read_manifest(ids[0]).profile) in PROFILES and profile != usual:
        options["--profile"] = profile
    return command_line("evaluate", options, {})
