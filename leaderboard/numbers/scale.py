"""What returns become before tasks are put together: scores, by a task's reference or by its largest possible return."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TypeVar

from cudc_bench.artefacts.records import Record
from cudc_bench.artefacts.references import Bounds
from cudc_bench.envs.domains import DOMAINS
from cudc_bench.settings.evaluate_config import in_full

from .statistics import Floats
from .words import extent

T = TypeVar("T", float, "Floats")
# By task.
References = Mapping[str, Bounds]
FLOOR, CEILING = "floor", "ceiling"
MEANING = {FLOOR: "random actions", CEILING: "TD3 trained online"}
LABELS = {name: f"{name} ({text})" for name, text in MEANING.items()}  # where a method's name could stand
# Settings of a training that say how its policies are evaluated.
_EVALUATION = {"evaluate_every", "evaluation_episodes", "final_episodes", "final_evaluations", "milestones"}
BETWEEN = "returns between each task's floor (random actions, 0) and ceiling (TD3 trained online on the task, 1)"
OF_LARGEST = "returns divided by each task's largest possible one"


@dataclass(frozen=True)
class Scale:
    """A linear change of returns: ``low`` becomes 0 and ``high`` becomes 1.

    Attributes:
        low, high: two returns.
        least, largest: the least and the largest possible return; None where they are not known.
    """

    low: float
    high: float
    least: float | None
    largest: float | None

    def score(self, value: T) -> T:
        """What a return becomes."""
        return (value - self.low) / (self.high - self.low)

    def width(self, deviation: float) -> float:
        """What a difference of returns becomes."""
        return deviation / (self.high - self.low)


def scale_of(domain: str, task: str, references: References) -> Scale | None:
    """The scale of a task: its reference's if there is one, else from 0 to the largest possible return, if that is known."""
    largest = largest_return(domain, task)
    if (bounds := references.get(task)) is not None:
        return Scale(bounds.floor, bounds.ceiling, None if largest is None else 0.0, largest)
    return None if largest is None else Scale(0.0, largest, 0.0, largest)


def largest_return(domain: str, task: str) -> float | None:
    """The largest possible return of a task; None if that is not known."""
    known = DOMAINS.get(domain)
    return known.max_return if known is not None and task in known.tasks else None


def serving(references: Mapping[tuple[str, str, str], Bounds], record: Record) -> dict[str, Bounds]:
    """The references by which a record's group may be measured, by task.

    A reference belongs to one profile: to its length of collection, which the online training has too. A group whose name says more than
    the profile (other settings of the collection or the training, a part of a dataset, a reward of one's own) has none, unless it says
    only how often policies were evaluated, which changes no score but by chance. Columns of imported datasets, whose names say their size,
    are measured by what their table is measured by.
    """
    trained = {name: value for name, value in record.overrides.items() if name not in _EVALUATION}
    alike = record.model_copy(update={"overrides": trained, "hyperparameters": in_full(record.hyperparameters)})
    if alike.group != record.profile:
        return {}
    return {task: bounds for (profile, domain, task), bounds in references.items()
            if (profile, domain) == (record.profile, record.dataset.domain)}  # fmt: skip


def references_caption(references: References, tasks: Iterable[str]) -> str:
    """What floors and ceilings are, and which of some tasks have none; empty if none has."""
    tasks = list(tasks)
    having = [references[task] for task in tasks if task in references]
    if not having:
        return ""
    seeds = extent(min(one.seeds for one in having), max(one.seeds for one in having))
    seeds = "1 seed" if seeds == "1" else f"{seeds} seeds"
    lacking = [task for task in tasks if task not in references]
    return (
        f" Floor: mean return of random actions; ceiling: of TD3 trained online on the task at this profile ({seeds} each)."
        " Score: (return - floor) / (ceiling - floor)." + (f" Without a reference: {', '.join(lacking)}." if lacking else "")
    )
