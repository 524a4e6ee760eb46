"""What is fixed about each domain, without loading a simulator."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cudc_bench.errors import unknown

if TYPE_CHECKING:
    from cudc_bench.envs.simulator import Simulator


@dataclass(frozen=True)
class Domain:
    """A domain of the benchmark (paper, section "Experiments"; sizes: spec of ExORL and dm_control).

    Attributes:
        name: as in ids and on the command line.
        tasks: the downstream tasks, in the order of the paper's tables; rewards come in this order everywhere.
        observation_size: S, float32.
        action_size: A, each in [-1, 1], float32.
        physics_size: P, float64 numbers that restore the simulator (positions, velocities, activations).
        episode_length: T control steps; an episode ends by this limit only.
        max_return: the largest possible sum of rewards.
        quantities: the Q physical quantities that rewards are functions of.
        simulator: ``module:class`` of its :class:`~cudc_bench.envs.simulator.Simulator`.
        rewards: ``module:function`` from physical quantities (..., Q) to the rewards (..., tasks).
        relabeler: the registered relabeler that serves it.
    """

    name: str
    tasks: tuple[str, ...]
    observation_size: int
    action_size: int
    physics_size: int
    episode_length: int
    max_return: float
    quantities: tuple[str, ...]
    simulator: str
    rewards: str
    relabeler: str


DOMAINS: dict[str, Domain] = {
    domain.name: domain
    for domain in (
        Domain(
            name="walker",
            tasks=("stand", "walk", "run", "flip"),
            observation_size=24,
            action_size=6,
            physics_size=18,
            episode_length=1000,
            max_return=1000.0,
            quantities=("torso_height", "torso_upright", "com_velocity_x", "angular_momentum_y"),
            simulator="cudc_bench.envs.walker:Walker",
            rewards="cudc_bench.envs.walker:walker_rewards",
            relabeler="walker",
        ),
    )
}


def check_domain(name: str) -> Domain:
    """Return the domain of that name.

    Raises:
        UsageError: there is none.
    """
    if name not in DOMAINS:
        raise unknown("domain", name, DOMAINS)
    return DOMAINS[name]


def check_tasks(domain: Domain, tasks: Sequence[str] | None) -> tuple[str, ...]:
    """Return the tasks in the domain's order without repeats; all of them for ``None``.

    Raises:
        UsageError: one does not belong to the domain.
    """
    for task in tasks or ():
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


def _resolve(reference: str) -> Any:
    module, name = reference.split(":")
    return getattr(import_module(module), name)
