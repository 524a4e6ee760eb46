"""From metrics on a device to rows of numbers, one for each member."""

from __future__ import annotations

import math
from collections.abc import Mapping

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
