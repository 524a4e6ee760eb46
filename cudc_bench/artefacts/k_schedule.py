"""How k, the temporal distance of a method with a horizon, grew while a dataset was collected.

A method whose k can grow says so in its summary, which the manifest keeps among its diagnostics. Here is what that summary holds: what
writes it and what reads it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

_GROWTH, _SUSPECT = "k_increments", "k_schedule_suspect"  # in the summary
_LARGEST_STEP = 10**12  # beyond any collection


class Growth(NamedTuple):
    """One growth of k; ``step`` counts environment steps."""

    step: int
    old_k: int
    new_k: int

    def __str__(self) -> str:
        return f"{self.old_k}→{self.new_k} at {self.step:,}"


@dataclass(frozen=True)
class KSchedule:
    """When k grew in one run.

    Attributes:
        growth: in the order of the method's summary; empty for methods that tell of none.
        suspect: whether the method itself found that k grew too early or too fast to mean anything; None where it does not say.
    """

    growth: tuple[Growth, ...] = ()
    suspect: bool | None = None

    def __str__(self) -> str:
        """For people: ``"3→4 at 84,000, 4→5 at 120,008"``; empty where k never grew."""
        return ", ".join(map(str, self.growth))

    @property
    def note(self) -> str:
        """What whoever picks a dataset from a list should know of it, in a few words; empty if there is nothing."""
        return "k schedule suspect" if self.suspect else ""


def k_schedule(diagnostics: Mapping[str, Any]) -> KSchedule:
    """The schedule in a manifest's diagnostics; what is malformed is left out."""
    told = diagnostics.get(_GROWTH)
    rows = [row for row in told if isinstance(row, dict)] if isinstance(told, list) else []
    found = [Growth(*(cast(int, row.get(name)) for name in Growth._fields)) for row in rows]
    sound = tuple(one for one in found if all(type(value) is int and 0 <= value < _LARGEST_STEP for value in one))
    return KSchedule(sound, diagnostics[_SUSPECT] is True if _SUSPECT in diagnostics else None)


def summarise(growth: Sequence[Mapping[str, Any]], at_bound: bool, steps: int) -> dict[str, Any]:
    """A method's summary of how its k grew.

    Args:
        growth: a row for each growth in the order of time, with ``step``, ``old_k``, ``new_k`` and whatever else the method knows of it.
        at_bound: whether k has reached its bound, and took more than one growth for that.
        steps: of the whole run.
    """
    starts, ends = suspect_limits(steps)
    at = [row["step"] for row in growth]
    early = bool(at) and (at[0] < starts or (at_bound and at[-1] - at[0] <= ends))
    return {_GROWTH: list(growth), _SUSPECT: early}


def suspect_limits(steps: int) -> tuple[int, int]:
    """A schedule is suspect if k first grew before the one, or went from there to its bound within the other; environment steps.

    Args:
        steps: of the whole run; the limits are 50K and 100K for the paper's 1M.
    """
    return steps // 20, steps // 10
