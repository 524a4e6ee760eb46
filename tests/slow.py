"""Which tests ``make test-fast`` leaves out: those that took long in a whole run, by the list in ``slow.txt``.

``make slow`` runs all tests, and writes the list anew from how long each of them took.
"""

from __future__ import annotations

import re
import sys
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

LIST = Path(__file__).with_name("slow.txt")
SECONDS = 0.4  # of a test with all of its parameters, above which it is left out
_LINE = re.compile(r"(\d+\.\d+)s (?:call|setup|teardown) +(tests/\S+?\.py::\S.*)")


def without_parameters(test: str) -> str:
    """``tests/a.py::TestB::test_c[d]`` -> ``tests/a.py::TestB::test_c``."""
    return test.partition("[")[0]


def slow_tests() -> frozenset[str]:
    """The tests on the list."""
    return frozenset(LIST.read_text().split())


def slow_in(lines: Iterable[str]) -> list[str]:
    """The tests that took long, by what ``pytest --durations=0 --durations-min=0.05`` printed."""
    seconds: dict[str, float] = defaultdict(float)
    for line in lines:
        if (found := _LINE.match(line)) is not None:
            seconds[without_parameters(found[2])] += float(found[1])
    return sorted(test for test, total in seconds.items() if total >= SECONDS)


if __name__ == "__main__":
    LIST.write_text("\n".join(slow_in(sys.stdin)) + "\n")
    print(f"{len(slow_tests())} tests are slow: {LIST}")
