"""From metrics on a device to rows of numbers, one for each member."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from cudc_bench.errors import BrokenDownError


def member_rows(metrics: Mapping[str, Tensor], step: int) -> list[dict[str, float]]:
    """Read metrics (E,) from the device, once, as one row for each member.

    Args:
        metrics: by name.
        step: where the run stands, for the error.

    Raises:
        BrokenDownError: a number is not finite; training has broken down.
    """
    values = {name: value.tolist() for name, value in metrics.items()}
    members = len(next(iter(values.values()), []))
    rows = [{name: value[member] for name, value in values.items()} for member in range(members)]
    broken = sorted({name for row in rows for name, value in row.items() if not math.isfinite(value)})
    if broken:
        raise BrokenDownError(f"training broke down at step {step:,}: {', '.join(broken)} not finite; try a smaller learning_rate.")
    return rows


def check_actions(actions: NDArray[Any], observations: NDArray[Any], where: str) -> None:
    """Refuse actions that are not finite before a simulator gets them: it would say that it had diverged.

    Args:
        actions, observations: any shapes; the actions follow the observations.
        where: the run stands, such as ``"at step 5"``.

    Raises:
        BrokenDownError: the observations were not finite, or else the networks are broken.
    """
    if np.isfinite(actions).all():
        return
    check_simulated(observations, where)
    raise BrokenDownError(f"training broke down {where}: actions not finite; try a smaller learning_rate.")


def check_bounds(actions: NDArray[Any], where: str) -> None:
    """Refuse actions beyond [-1, 1], which datasets cannot hold and simulators would silently clip.

    Args:
        actions: of any shape, finite.
        where: the run stands.

    Raises:
        BrokenDownError: one is.
    """
    if (largest := float(np.abs(actions).max(initial=0.0))) > 1.0:
        raise BrokenDownError(f"the method acts out of [-1, 1] {where} (up to {largest:g}); its act() must keep actions there.")


def check_simulated(values: NDArray[Any], where: str) -> None:
    """Refuse what a simulation led to if it is not finite.

    Raises:
        BrokenDownError: it is not.
    """
    if not np.isfinite(values).all():
        raise BrokenDownError(f"the simulation broke down {where}: what was observed is not finite; run again with another seed.")
