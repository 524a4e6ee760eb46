"""``diagnostics.jsonl``: what a collector measured of itself while it learned, in a file beside its dataset.

A line is a JSON object: ``step``, the environment steps so far, which rise from line to line; ``updates``; the coverage of the domain's
descriptors where it has some; and whatever the last update before it measured, by name: ``k`` for every method with a horizon, losses,
``reward``, and what the method adds. Measures are numbers; those that are missing were not measured, and a number that is not finite counts
as missing.
"""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from cudc_bench.artefacts.ids import DatasetId, dataset_path
from cudc_bench.errors import RunError, UsageError
from cudc_bench.files import MOST_TEXT, check_regular
from cudc_bench.text import plain

DIAGNOSTICS = "diagnostics.jsonl"
_LARGEST_STEP, _LARGEST = 10**9, 1e30  # Above any real one; larger ones would overflow sums and axes.


def diagnostics_path(dataset_id: DatasetId | str) -> Path:
    """The diagnostics of a dataset, whether there are any or not."""
    return dataset_path(dataset_id) / DIAGNOSTICS


def to_line(row: Mapping[str, Any]) -> bytes:
    """One line of the file, with its end."""
    return json.dumps(row).encode() + b"\n"


def read_measures(dataset_id: DatasetId | str, names: Collection[str]) -> tuple[dict[str, dict[int, float]], int]:
    """Some measures of a dataset's diagnostics.

    Args:
        dataset_id: whose.
        names: of the measures; others are not looked at.

    Returns:
        Of each measure value by step, ascending; a measure without any is absent. And the step of the last line.

    Raises:
        UsageError: the dataset has none.
        RunError: the file cannot be read, or a line of it is damaged.
    """
    path = diagnostics_path(dataset_id)
    values: dict[str, dict[int, float]] = defaultdict(dict)
    last, number = 0, 0
    try:
        check_regular(path)
        with path.open("rb") as file:
            while line := file.readline(MOST_TEXT):
                number += 1
                row = _row(line)
                step = row["step"]
                if type(step) is not int or not last < step <= _LARGEST_STEP:
                    raise ValueError("'step' is not a number of steps beyond that of the line before")
                last = step
                for name in names:
                    if (value := _number(row, name)) is not None:
                        values[name][step] = value
    except FileNotFoundError:
        raise UsageError(f"'{dataset_id}' has no diagnostics: there is no file {path}.") from None
    except OSError as error:
        raise RunError(f"cannot read the diagnostics {path}: {error.strerror}.") from None
    except ValueError as error:
        raise RunError(f"the diagnostics of '{dataset_id}' are damaged ({path}, line {number}): {plain(str(error))}.") from None
    if not number:
        raise RunError(f"the diagnostics of '{dataset_id}' are damaged ({path}, line 1): the file is empty.")
    return dict(values), last


def _row(line: bytes) -> dict[str, Any]:
    try:
        row = json.loads(line.decode("utf-8"))
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    if not isinstance(row, dict) or "step" not in row:
        raise ValueError("it is not a JSON object with 'step'")
    return row


def _number(row: dict[str, Any], name: str) -> float | None:
    value = row.get(name)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"'{name}' is not a number")
    if not isinstance(value, int) and not math.isfinite(value):
        return None
    if abs(value) > _LARGEST:
        raise ValueError(f"'{name}' is beyond {_LARGEST:g}")
    return float(value)
