"""Environments: thin MuJoCo simulators, bit-identical to dm_control's, and their Gymnasium ids.

``cudc_bench/walker-v0`` is the reward-free domain that collectors explore; ``cudc_bench/walker-walk-v0`` and its siblings are the
tasks. Importing this registers the ids and nothing more: MuJoCo is loaded when the first environment is made.
"""

from __future__ import annotations

from functools import partial

import gymnasium

from cudc_bench.envs.domains import DOMAINS, Domain, check_domain, check_tasks, make_simulators, reward_function

__all__ = [
    "DOMAINS",
    "Domain",
    "check_domain",
    "check_tasks",
    "env_id",
    "make_simulators",
    "register",
    "reward_function",
]


def env_id(domain: str, task: str | None = None) -> str:
    """The Gymnasium id of a domain (reward-free) or of one of its tasks."""
    return f"cudc_bench/{domain}-v0" if task is None else f"cudc_bench/{domain}-{task}-v0"


def register() -> None:
    """Register every id with Gymnasium; a second call changes nothing.

    The entry point is a string and the arguments are plain JSON, so that a Minari dataset can store the specification and
    ``recover_environment()`` can rebuild it in a process that never imported this package.
    """
    for domain in DOMAINS.values():
        add = partial(gymnasium.register, entry_point="cudc_bench.envs.gym:SimulatorEnv", max_episode_steps=domain.episode_length)
        for task in (None, *domain.tasks):
            if env_id(domain.name, task) not in gymnasium.registry:
                add(id=env_id(domain.name, task), kwargs={"domain": domain.name, "task": task})


register()
