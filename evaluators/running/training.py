"""What an online training of TD3 is made of, whatever is then made of it: a reference, or datasets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

from cudc_bench.envs import check_domain, check_tasks
from cudc_bench.learning.engines import set_engine
from cudc_bench.learning.learner import check_precision
from cudc_bench.runs.execution import Execution
from cudc_bench.settings.config import as_dict, build, changed, check_settings
from cudc_bench.settings.evaluate_config import OnlineConfig
from cudc_bench.settings.profiles import resolve_profile
from cudc_bench.settings.seeds import check_seeds

from ..td3 import TD3, TD3Config
from .online import rehearse_online


@dataclass(frozen=True)
class Member:
    """One training: a task and a seed."""

    task: str
    seed: int


@dataclass(frozen=True)
class OnlineTraining:
    """The trainings of one command.

    Attributes:
        domain, tasks, seeds: whose.
        profile: the set of hyperparameters that they start from.
        loop, config: all hyperparameters.
        overrides: those that the user changed.
        device, engine: where the agents learn, and how their updates are to be carried out.
    """

    domain: str
    tasks: tuple[str, ...]
    seeds: tuple[int, ...]
    profile: str
    loop: OnlineConfig
    config: TD3Config
    overrides: dict[str, Any]
    device: str
    engine: str

    @classmethod
    def checked(
        cls, domain: str, tasks: Sequence[str] | None, seeds: Sequence[int], profile: str, settings: Mapping[str, Any],
        execution: Execution, usual: Mapping[str, Any] | None = None, **more: Any,
    ) -> Self:  # fmt: skip
        """The same as a user asks for it; ``usual`` wins over the profile, and ``more`` are fields of a subclass.

        Raises:
            UsageError: it cannot be.
        """
        chosen, given = resolve_profile(profile), dict(settings)
        check_settings(given, [OnlineConfig, TD3Config])
        layers = (chosen.collect, chosen.evaluate, usual or {})
        loop, config = build(OnlineConfig, *layers, given), TD3.configure(chosen.evaluate, given)
        overrides = changed(as_dict(loop, config), as_dict(build(OnlineConfig, *layers), TD3.configure(chosen.evaluate), later=True))
        check_precision(TD3, "td3", loop.precision, execution.device)
        found = check_tasks(check_domain(domain), tasks)
        engine = execution.engine_for(TD3, (loop.steps - loop.seed_steps) // loop.update_every)
        numbers = tuple(sorted(check_seeds(seeds)))
        return cls(domain, found, numbers, chosen.name, loop, config, overrides, execution.device, engine, **more)

    @property
    def values(self) -> dict[str, Any]:
        """All hyperparameters by name."""
        return as_dict(self.loop, self.config)

    def agent(self, seeds: Sequence[int]) -> TD3:
        """Untrained agents."""
        facts = check_domain(self.domain)
        agent = TD3(facts.observation_size, facts.action_size, self.config, seeds, self.device)
        set_engine(agent, self.engine)
        return agent

    def rehearse(self, members: Sequence[Member]) -> None:
        """See :class:`~cudc_bench.runs.memory.Rehearsing`."""
        rehearse_online(self.agent([one.seed for one in members]), self.loop, check_domain(self.domain), [one.task for one in members])


def names_of(members: Sequence[Member]) -> str:
    """What stands for some members in messages."""
    names = [f"{one.task} seed {one.seed}" for one in members]
    return " + ".join(names) if len(names) < 3 else f"{len(names)} trainings"
