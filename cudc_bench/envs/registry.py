"""Domains by name, and what is loaded for them when it is needed."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cudc_bench import plugins
from cudc_bench.envs.domains import DOMAINS, SUITE, Domain
from cudc_bench.errors import RunError, UsageError, unknown

if TYPE_CHECKING:
    from cudc_bench.envs.simulator import Simulator

_NAME = re.compile(r"[a-z0-9_]{2,64}")


def check_domain(name: str) -> Domain:
    """Return the domain of that name: one of ours, one that an installed package registers in the group ``cudc_bench.domains``, or
    ``dm_control/<domain>-<task>`` for any environment of dm_control's suite.

    The latter is defined when it is first asked for, which loads MuJoCo and takes a second or so.

    Raises:
        UsageError: there is none, or it is one of the suite's that cannot be used here; the message says why.
        RunError: a package registers it, but what it registers cannot be used.
    """
    if name.startswith(SUITE):
        from cudc_bench.envs.suite import suite_domain

        return suite_domain(name)
    if name in DOMAINS:
        return DOMAINS[name]
    if name not in plugins.names("domains"):
        raise unknown("domain", name, [*DOMAINS, *plugins.names("domains"), f"{SUITE}<domain>-<task>"])
    return _registered(name)


@cache
def _registered(name: str) -> Domain:
    found = plugins.load("domains", name)
    if not isinstance(found, Domain):
        raise RunError(f"the domain '{name}' is registered as {type(found).__name__}; it must be a cudc_bench.envs.Domain.")
    if found.name != name or _NAME.fullmatch(name) is None:
        raise RunError(f"the domain '{name}' calls itself {found.name!a}; both must be the same, of 2 to 64 small letters, digits and '_'.")
    return found


def check_tasks(domain: Domain, tasks: Sequence[str] | None) -> tuple[str, ...]:
    """Return the tasks in the domain's order without repeats; all of them for ``None``.

    Raises:
        UsageError: one does not belong to the domain, or cannot be relabelled, or none can, or none is named; the message says why.
    """
    if not domain.tasks:
        raise UsageError(
            f"'{domain.name}' has no task that can be relabelled ({excluded_tasks(domain)}); give a reward of your own (--reward)."
        )
    if tasks is not None and not tasks:
        raise UsageError(f"no task was given; allowed: {', '.join(domain.tasks)}.")
    for task in tasks or ():
        if task in domain.excluded:
            allowed = ", ".join(domain.tasks)
            raise UsageError(f"the {domain.name} task '{task}' cannot be relabelled: {domain.excluded[task]}; allowed: {allowed}.")
        if task not in domain.tasks:
            raise unknown(f"{domain.name} task", task, domain.tasks)
    return tuple(task for task in domain.tasks if tasks is None or task in tasks)


def make_simulators(domain: str, count: int) -> list[Simulator]:
    """Simulators of a domain, which may share what is read only; this loads MuJoCo."""
    facts = check_domain(domain)
    kind: type[Simulator] = _resolve(facts.simulator)
    return kind.make(facts, count)


def reward_function(domain: str) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """The function from physical quantities (..., Q) to the rewards (..., tasks) of a domain, in the order of its tasks."""
    return _resolve(check_domain(domain).rewards)


def excluded_tasks(domain: Domain) -> str:
    """The tasks of the same body that cannot be relabelled, and why; empty when there are none."""
    reasons = dict.fromkeys(domain.excluded.values())
    return "; ".join(f"{', '.join(task for task in domain.excluded if domain.excluded[task] == why)}: {why}" for why in reasons)


def _resolve(reference: str) -> Any:
    module, name = reference.split(":")
    return getattr(import_module(module), name)
