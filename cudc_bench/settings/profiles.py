"""Profiles: named, complete, versioned sets of hyperparameters.

The dataclass defaults beside each method are the paper's, so ``paper`` changes nothing. The smaller profiles change the same few
values for every method, and shorten every schedule that counts environment steps in proportion to the run (``schedules``); tuning a single
method in one of them is forbidden. Results of different profiles never share a table.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from cudc_bench.errors import UsageError, unknown


@dataclass(frozen=True)
class Profile:
    """One set of hyperparameters.

    Attributes:
        name: as on the command line.
        purpose: one line for people.
        collect: values for collection, applied wherever a configuration has a field of that name.
        evaluate: the same for offline training.
        threads: CPU threads of each run; None shares the machine's cores among the runs. Small networks run best on one thread, and a
            fixed number makes a result independent of how many runs share the machine.
        in_ids: whether the default ids of its datasets name it. Those of the two that ``auto`` takes do not: ``walker/cudc-v0`` is what
            whoever names no profile gets and loads, on any machine.
    """

    name: str
    purpose: str
    collect: Mapping[str, Any] = field(default_factory=dict)
    evaluate: Mapping[str, Any] = field(default_factory=dict)
    threads: int | None = None
    in_ids: bool = True


PAPER_STEPS = 1_000_000  # environment steps of a dataset
_SMALL = {"width": 128, "batch_size": 128, "learning_rate": 1e-3}
# Of evaluators that embed states. With the papers' 50 dimensions, which go with minibatches of 1,024, FB stays near the floor at this
# size (docs/how-to/zero-shot.md has the figures).
_EMBEDDING = {"feature_width": 64, "state_dim": 64, "z_dim": 16}


def schedules(config: type, profile: Mapping[str, Any]) -> dict[str, Any]:
    """What a profile makes of the hyperparameters that scale with the steps of a run: their defaults, which are for the paper's, in
    proportion to its own.

    Args:
        config: a frozen dataclass; its fields with the metadata ``WITH_STEPS`` are whole numbers, or tuples of them.
        profile: its values for collection.
    """
    steps = profile.get("steps", PAPER_STEPS)
    scaling = [one for one in dataclasses.fields(config) if one.metadata.get("scales_with") == "steps"]
    return {one.name: _scaled(one.default, steps / PAPER_STEPS) for one in scaling}


def _scaled(value: Any, share: float) -> Any:
    return tuple(_scaled(one, share) for one in value) if isinstance(value, tuple) else round(value * share)


PROFILES: dict[str, Profile] = {
    profile.name: profile
    for profile in (
        Profile("paper", "the paper's setting: 1M steps, width 1024, 500K gradient steps; a GPU's work", in_ids=False),
        Profile(
            "cpu",
            "the same methods at a size where two cores collect a dataset in minutes",
            collect={"steps": 400_000, "update_every": 8, "feature_dim": 128, **_SMALL},
            evaluate={
                "gradient_steps": 50_000, "evaluate_every": 5_000, "evaluation_episodes": 5, "final_episodes": 20,
                "milestones": (10_000, 50_000), **_SMALL, **_EMBEDDING,
            },
            threads=1,
            in_ids=False,
        ),
        Profile(
            "demo",
            "the cpu profile cut short: a first look in minutes, too short for conclusions",
            collect={"steps": 100_000, "update_every": 8, "feature_dim": 128, "measure_every": 250, **_SMALL},
            evaluate={
                "gradient_steps": 10_000, "evaluate_every": 1_000, "evaluation_episodes": 3, "final_episodes": 10,
                "milestones": (2_000, 10_000), **_SMALL, **_EMBEDDING,
            },
            threads=1,
        ),
        Profile(
            "smoke",
            "seconds, to see that everything runs; the numbers mean nothing",
            collect={
                "steps": 3_000, "seed_steps": 1_000, "update_every": 50, "measure_every": 10, "feature_dim": 16, "width": 16,
                "batch_size": 32, "learning_rate": 1e-3,
            },
            evaluate={
                "gradient_steps": 40, "evaluate_every": 20, "evaluation_episodes": 1, "final_episodes": 2,
                "milestones": (20, 40), "width": 16, "batch_size": 32, "learning_rate": 1e-3, "feature_width": 8, "state_dim": 8,
                "z_dim": 8,
            },
            threads=1,
        ),
    )
}  # fmt: skip


def resolve_profile(name: str) -> Profile:
    """The profile of that name; ``auto`` is ``paper`` where CUDA is available and ``cpu`` elsewhere.

    Raises:
        UsageError: there is none of that name.
    """
    if name == "auto":
        import torch

        return PROFILES["paper" if torch.cuda.is_available() else "cpu"]
    if name not in PROFILES:
        raise unknown("profile", name, [*PROFILES, "auto"])
    return PROFILES[name]


def resolve_device(name: str) -> str:
    """``auto`` is ``cuda`` where available, else ``cpu``.

    Raises:
        UsageError: an unknown device, or CUDA where there is none.
    """
    if name not in {"auto", "cpu", "cuda"}:
        raise unknown("device", name, ["auto", "cpu", "cuda"])
    if name == "cpu":
        return name
    import torch

    if torch.cuda.is_available():
        return "cuda"
    if name == "cuda":
        raise UsageError("device 'cuda' is not available here; use --device cpu, or see cudc-bench doctor.")
    return "cpu"
