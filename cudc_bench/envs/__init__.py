"""Environments: thin MuJoCo simulators, bit-identical to dm_control's, and their Gymnasium ids.

``cudc_bench/walker-v0`` is the reward-free domain that collectors explore; ``cudc_bench/walker-walk-v0`` and its siblings are the
tasks. Importing this or the package registers the ids and nothing more: MuJoCo is loaded when the first environment is made. Domains of
dm_control's suite are not registered: ``gymnasium.make(env_spec("dm_control/cheetah-run", "run"))`` makes one.
"""

from __future__ import annotations

# Not from ``gymnasium`` itself: this may be imported while that is (see ``cudc_bench/__init__.py``).
from gymnasium.envs import registration
from gymnasium.envs.registration import EnvSpec

from cudc_bench.artefacts.ids import domain_slug
from cudc_bench.envs.domains import DOMAINS, Domain, domain_title
from cudc_bench.envs.registry import check_domain, check_tasks, excluded_tasks, make_simulators, reward_function

__all__ = [
    "DOMAINS",
    "Domain",
    "check_domain",
    "check_tasks",
    "domain_title",
    "env_id",
    "env_spec",
    "excluded_tasks",
    "make_simulators",
    "register",
    "reward_function",
]


def env_id(domain: str, task: str | None = None) -> str:
    """The Gymnasium id of a domain (reward-free) or of one of its tasks."""
    return f"cudc_bench/{'-'.join(filter(None, (domain_slug(domain), task)))}-v0"


def env_spec(domain: str, task: str | None = None, reward: str | None = None) -> EnvSpec:
    """What Gymnasium makes a domain's environment from; it need not be registered.

    The entry point is a string and the arguments are plain JSON, so that a Minari dataset can store the specification and
    ``recover_environment()`` can rebuild it in a process that never imported this package.

    Args:
        domain: reward-free unless one of the others is given.
        task: one of the domain's, or the name of an own reward function.
        reward: an own reward function, as ``module:function``.
    """
    return EnvSpec(
        id=env_id(domain, task),
        entry_point="cudc_bench.envs.gym:SimulatorEnv",
        max_episode_steps=check_domain(domain).episode_length,
        kwargs={"domain": domain, "task": task} if reward is None else {"domain": domain, "reward": reward},
    )


def register() -> None:
    """Register every built-in id with Gymnasium; a second call changes nothing."""
    for domain in DOMAINS.values():
        for task in (None, *domain.tasks):
            spec = env_spec(domain.name, task)
            if spec.id not in registration.registry:
                registration.register(spec.id, spec.entry_point, max_episode_steps=spec.max_episode_steps, kwargs=spec.kwargs)


register()
