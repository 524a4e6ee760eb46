"""Reward functions of a user's own: tasks beyond those of the domains.

Such a function lives in an importable module and is named ``module:function``. It gets what was measured at N steps, by name, and
returns N rewards::

    def hop(measured):  # walker/hop/cudc-v0
        return (measured["torso_height"] > 1.3) * measured["torso_upright"]

Each step is to be treated by itself: N is an episode here, one step there. The function sees the domain's own physical quantities (each
(N,), listed by ``cudc-bench list``), and ``physics`` (N, P), ``action`` (N, A) and ``observation`` (N, S): the state and observation that
the action led to. The same function labels datasets, gives the live reward in Gymnasium, and scores policies.
"""

from __future__ import annotations

import hashlib
import inspect
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cudc_bench.envs.domains import Domain
from cudc_bench.errors import BrokenDownError, RunError, UsageError, nearest

Array = NDArray[Any]
_REFERENCE = re.compile(r"(?P<module>[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*):(?P<function>[A-Za-z_]\w*)", re.ASCII)
_NAME = re.compile(r"[a-z0-9_]{2,64}")


class Measured(Mapping[str, Array]):
    """What was measured at N steps, by name; a name that it lacks is refused with those that it has.

    Args:
        domain: whose quantities.
        quantities: (N, Q).
        physics: (N, P) float64.
        action: (N, A) float32.
        observation: (N, S) float32.
    """

    def __init__(self, domain: Domain, quantities: Array, physics: Array, action: Array, observation: Array) -> None:
        self._arrays = dict(zip(domain.quantities, np.moveaxis(quantities, -1, 0), strict=True))
        self._arrays |= {"physics": physics, "action": action, "observation": observation}
        self._domain = domain.name

    def __getitem__(self, name: str) -> Array:
        if name not in self._arrays:
            names = ", ".join(self._arrays)
            raise BrokenDownError(f"{self._domain} measures no '{name}'; a reward sees: {names}.{nearest(name, self._arrays)}")
        return self._arrays[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._arrays)

    def __len__(self) -> int:
        return len(self._arrays)


@dataclass(frozen=True)
class CustomReward:
    """A user's reward function.

    Attributes:
        reference: ``module:function``.
        name: the function's name, which names the task.
        sha256: of the function's source text, so that a changed function is noticed; what it calls is not covered.
        function: the function itself.
    """

    reference: str
    name: str
    sha256: str
    function: Callable[[Measured], Any]

    def __call__(self, measured: Measured) -> NDArray[np.float64]:
        """Rewards (N,) of N steps.

        Raises:
            BrokenDownError: the function failed, or what it returned is not N real numbers that are finite in float32, too.
        """
        steps = len(measured["action"])
        try:
            returned = np.asarray(self.function(measured))
        except RunError:
            raise
        except (Exception, SystemExit) as error:
            raise BrokenDownError(f"the reward function {self.reference} failed: {type(error).__name__}: {error}.") from error
        if returned.shape != (steps,):
            raise BrokenDownError(
                f"the reward function {self.reference} returned shape {returned.shape} for {steps} steps; return ({steps},)."
            )
        if returned.dtype.kind not in "biuf":
            raise BrokenDownError(f"the reward function {self.reference} returned {returned.dtype}; return real numbers.")
        rewards = returned.astype(np.float64)
        with np.errstate(over="ignore"):
            # As they will be stored.
            finite = np.isfinite(rewards.astype(np.float32))
        if not finite.all():
            row = int(np.flatnonzero(~finite)[0])
            what = f"numbers that are not finite in float32; first at row {row} ({rewards[row]:g})"
            raise BrokenDownError(f"the reward function {self.reference} returned {what}.")
        return rewards


def load_reward(reference: str | Callable[[Measured], Any], domain: Domain) -> CustomReward:
    """Find a user's reward function.

    Modules are looked for where Python looks, and in the working folder.

    Args:
        reference: ``module:function``, or the function itself, which must be importable under its name.
        domain: whose tasks its name must not repeat.

    Raises:
        UsageError: there is no such function, or it cannot be found again by its name, or its name cannot name a task.
    """
    text = reference if isinstance(reference, str) else _reference_of(reference)
    reward = _load(text)
    if not isinstance(reference, str) and reward.function is not reference:
        raise UsageError(f"{text} is another function than the one given; give a function of an importable module.")
    if reward.name in domain.tasks:
        raise UsageError(f"{domain.name} has a task '{reward.name}' already; give the function {text} another name.")
    return reward


def _reference_of(function: Callable[..., Any]) -> str:
    module, name = getattr(function, "__module__", None), getattr(function, "__qualname__", repr(function))
    if module in (None, "__main__") or not _REFERENCE.fullmatch(f"{module}:{name}"):
        raise UsageError(
            f"the reward function {name} cannot be imported again, as evaluation needs it; put it into a module, named 'module:function'."
        )
    return f"{module}:{name}"


@cache
def _load(reference: str) -> CustomReward:
    match = _REFERENCE.fullmatch(reference)
    if match is None:
        raise UsageError(f"--reward takes module:function, not '{reference}'.")
    module_name, name = match["module"], match["function"]
    if os.getcwd() not in sys.path:
        # As with `python -m`: people's functions lie where they work.
        sys.path.append(os.getcwd())
    try:
        module = import_module(module_name)
    except ImportError as error:
        raise UsageError(f"--reward cannot import '{module_name}': {error}.") from None
    except (Exception, SystemExit) as error:
        raise UsageError(f"--reward cannot import '{module_name}': {type(error).__name__}: {error}.") from None
    function = getattr(module, name, None)
    if not inspect.isfunction(function):
        functions = [one for one, value in vars(module).items() if inspect.isfunction(value)]
        raise UsageError(
            f"'{module_name}' has no function '{name}'; it has: {', '.join(sorted(functions)) or 'none'}.{nearest(name, functions)}"
        )
    if not _NAME.fullmatch(name):
        raise UsageError(f"the function '{name}' cannot name a task: 2 to 64 lower-case letters, digits and '_' are allowed.")
    return CustomReward(reference, name, hashlib.sha256(inspect.getsource(function).encode()).hexdigest(), function)
