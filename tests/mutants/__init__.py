"""Changes to the product's formulas that a test with independent versions of them must notice.

``python -m tests.mutants`` makes each of them in a copy of the package, runs the tests against that copy, and says whether they noticed. A
module here lists the changes for one file of tests, as ``TESTS`` and ``MUTANTS``.
"""

from __future__ import annotations

from typing import NamedTuple


class Mutant(NamedTuple):
    """One wrong formula.

    Attributes:
        file: in the repository.
        old: what stands there exactly once.
        new: what stands there instead; it must run, and compute something else.
        noticed_by: names of learners, the first words of tests' parameters: for each of them a test must fail.
        survives: why no test can notice it, if none can.
    """

    file: str
    old: str
    new: str
    noticed_by: tuple[str, ...]
    survives: str = ""


def mutants(file: str, noticed_by: tuple[str, ...], *formulas: tuple[str, ...]) -> list[Mutant]:
    """Mutants of one file that the same tests must notice: of each formula what stands there, and one or more things that could."""
    return [Mutant(file, old, new, noticed_by) for old, *others in formulas for new in others]


def survivor(file: str, names: tuple[str, ...], old: str, new: str, reason: str) -> Mutant:
    """A change that makes no difference to the tests of these names, and why."""
    return Mutant(file, old, new, names, reason)
