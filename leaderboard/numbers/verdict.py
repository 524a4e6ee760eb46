"""What the tests of a comparison say, in words, and nothing that they do not say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from .grid import Entry
from .overall import Comparison, Overall
from .power import FOUND
from .words import span

RANDOM = "random"  # the collector that any other has to beat
_WORDS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve")


def verdict(overall: Overall, comparison: Comparison) -> tuple[str, ...]:
    """Which methods the tests of a comparison tell apart, in sentences.

    One method beats another where :attr:`~.overall.Pair.better` says so. Methods between which there is no such pair cannot be told apart,
    which is not to say that they are equal.

    Args:
        overall: whose comparison it is.
        comparison: at one milestone.
    """
    tested = [standing.method for standing in comparison.standings if standing.n > 1]
    single = [standing.method for standing in comparison.standings if standing.n < 2]
    if len(comparison.standings) < 2:
        return ("There is one method only, and nothing to compare it with.",)
    if len(tested) < 2:
        return ("Nothing can be told yet: a test needs two collector seeds in each domain of two methods at least.",)
    wins = {(pair.method, pair.other) for pair in comparison.pairs if pair.better}
    others = [method for method in tested if method != RANDOM]
    said = _among(others, {(x, y) for x, y in wins if RANDOM not in (x, y)})
    if RANDOM in tested:
        said.append(_against_random(others, wins))
    if single:
        said.append(f"Not tested, with a single seed in a domain: {_listed(single)}.")
    apart = {frozenset(pair) for pair in wins}
    if len(apart) < len(tested) * (len(tested) - 1) // 2:
        said.append(_caution(overall, comparison))
    return tuple(said)


def _among(methods: Sequence[str], wins: set[tuple[str, str]]) -> list[str]:
    """What is known of some methods beside one another."""
    if len(methods) < 2:
        return []
    if not wins:
        return [f"{_number(len(methods)).capitalize()} methods cannot be told apart: {_listed(methods)}."]
    beaten = {worse for _, worse in wins}
    front = [method for method in methods if method not in beaten]
    if not front:
        return [f"Each of {_number(len(methods))} methods is beaten by another."]
    counts = {method: sum(better == method for better, _ in wins) for method in front}
    if len(front) == 1 and counts[front[0]] == len(methods) - 1:
        others = f"all {_number(len(methods) - 1)} others" if len(methods) > 2 else next(one for one in methods if one != front[0])
        return [f"{front[0]} beats {others}."]
    wide = [f"{method} beats {_number(count)}" for method, count in counts.items() if count]
    first = f"Of {_number(len(methods))} methods none is found better than {_listed(front, 'or')}"
    if len(front) > 1:
        first += ", and these cannot be told apart"
    return [f"{first}{f'; {_listed(wide)}' if wide else ''}.", f"Beaten by another: {_listed([one for one in methods if one in beaten])}."]


def _against_random(others: Sequence[str], wins: set[tuple[str, str]]) -> str:
    better = [method for method in others if (method, RANDOM) in wins]
    worse = [method for method in others if (RANDOM, method) in wins]
    unknown = [method for method in others if method not in better and method not in worse]
    if len(better) == len(others) > 1:
        return f"{'Both' if len(others) == 2 else f'All {_number(len(others))}'} beat {RANDOM}."
    parts = [f"{_listed(better)} beat{'s' * (len(better) == 1)} {RANDOM}"] if better else []
    if unknown:
        parts.append(f"{_listed(unknown)} cannot be told from {'it' if parts else RANDOM}")
    if worse:
        parts.append(f"{RANDOM} beats {_listed(worse)}")
    return f"{'; '.join(parts)}."


def _caution(overall: Overall, comparison: Comparison) -> str:
    """What it means that methods are not told apart."""
    if comparison.hopeless:
        return "No difference could be found: with so few seeds nothing can pass the test."
    power = overall.power if comparison is overall.headline else None
    if power is None:
        return "Methods that cannot be told apart need not be equal."
    lead, seeds = power.design.lead, span([power.own], "seed")
    found = "no lead is" if lead is None else f"a lead of {overall.lead(lead)} is"
    return f"Methods that cannot be told apart need not be equal: with {seeds} {found} found in {round(10 * FOUND)} of 10 cases."


def task_verdict(cells: Mapping[str, Entry]) -> tuple[str, ...]:
    """What the marks of a task's results say, in sentences.

    Args:
        cells: the results of methods on one task at a milestone, marked as by :func:`~.table.mark_best`.
    """
    if not cells:
        return ()
    first = max(cells, key=lambda method: (cells[method].value, cells[method].n))
    if len(cells) < 2:
        return (f"There is one method only: {first}.",)
    said = [f"{first} has the largest mean."]
    others = {method: cell for method, cell in cells.items() if method != first}
    if cells[first].n < 2:
        return (said[0], "It has a single seed, so that nothing can be tested against it.")
    near = [method for method, cell in others.items() if cell.best]
    worse = [method for method, cell in others.items() if not cell.best and cell.n > 1]
    single = [method for method, cell in others.items() if not cell.best and cell.n < 2]
    if near:
        said.append(f"Not significantly worse, or the same after rounding: {_listed(near)}.")
    if worse:
        said.append(f"Significantly worse: {_listed(worse)}.")
    if single:
        said.append(f"Not tested, with a single seed: {_listed(single)}.")
    return tuple(said)


def _number(count: int) -> str:
    return _WORDS[count] if count < len(_WORDS) else str(count)


def _listed(names: Sequence[str], last: str = "and") -> str:
    return f" {last} ".join(filter(None, (", ".join(names[:-1]), names[-1])))
