"""Stacks of members: what every one of them has, and what those have that learn by gradients.

The networks, optimisers and random streams of a stack are saved and restored as one.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Hashable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from cudc_bench.errors import UsageError
from cudc_bench.learning.networks import MemberRandom, Trainable, adam, bf16_products, minimise
from cudc_bench.learning.replay import Batch, Future
from cudc_bench.settings.config import Precision


class MemberStack(ABC):
    """E independent members, each with its own seed, and one configuration.

    Class attributes:
        config_class: the frozen dataclass of hyperparameters; its defaults are those of the paper or code that the class names.
        values: hyperparameters that make a named variant out of the method that it is a subclass of.
        citation: the paper, for lists and tables.
        paper: where it can be read, an address that begins with https://; empty if it is not known.
        wants_future: whether batches must hold a later state of the same episode and any state of the data
            (``Batch.future_observation``, ``Batch.other_observation``), and how the first is drawn.
        stacks_exactly: whether, on a CPU, in one thread and with updates one by one, a member learns and acts the same to the last bit
            whoever is beside it. Members of others are alone there; the contract battery shows whether it is so.

    Attributes:
        config: the hyperparameters.
        seeds: one for each member.
        device: where their tensors are.
    """

    config_class: ClassVar[type]
    values: ClassVar[Mapping[str, Any]] = {}
    citation: ClassVar[str]
    paper: ClassVar[str] = ""
    wants_future: ClassVar[Future | None] = None
    stacks_exactly: ClassVar[bool] = False

    def __init__(self, config: Any, seeds: Sequence[int], device: torch.device | str = "cpu") -> None:
        super().__init__()
        self.config = config
        self.seeds = tuple(seeds)
        self.device = torch.device(device)

    @abstractmethod
    def update(self, batch: Batch) -> dict[str, Tensor]:
        """Learn from one minibatch; metrics are (E,) tensors, complete when ``batch.measure`` is set."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Everything that updates and actions change: networks, optimisers, generators, counters."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""


class Learner(MemberStack, nn.Module):
    """Networks as modules, and beside them optimisers and streams by name.

    An update has two halves, so that a GPU can repeat the second without Python (see :mod:`cudc_bench.learning.cuda_graphs`).

    Attributes:
        random: streams that the state holds.
        optimisers: one for each loss.
        precision: of wide products in updates; what acts is always float32.
        engine: how updates are carried out (see :mod:`cudc_bench.learning.engines`); ``auto`` takes graphs on CUDA and none elsewhere.
        replayable: whether ``learn`` keeps to what a graph asks of it. A subclass that cannot sets it to False; one with an ``update`` of
            its own never does.
    """

    replayable: ClassVar[bool] = True

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "update" in vars(cls):
            cls.replayable = False

    def __init__(self, config: Any, seeds: Sequence[int], device: torch.device | str = "cpu") -> None:
        super().__init__(config, seeds, device)
        self.random: dict[str, MemberRandom] = {}
        self.optimisers: dict[str, torch.optim.Optimizer] = {}
        self.precision: Precision = "float32"
        self.engine = "auto"

    def add_optimiser(self, name: str, trained: Sequence[Trainable], learning_rate: float) -> None:
        """One Adam over some modules, under a name."""
        self.optimisers[name] = adam(trained, learning_rate, len(self.seeds))

    def minimise(self, name: str, loss: Tensor) -> None:
        """One step of the optimiser of that name on the sum of the members' losses (E,)."""
        minimise(loss, self.optimisers[name])

    def set_learning_rate(self, name: str, value: float) -> None:
        """Change the learning rate of an optimiser, in ``prepare``."""
        for group in self.optimisers[name].param_groups:
            if isinstance(group["lr"], Tensor):
                group["lr"].fill_(value)
            else:
                group["lr"] = value

    def update(self, batch: Batch) -> dict[str, Tensor]:
        plan = self.prepare()
        with self.products():
            return self.learn(batch, plan)

    def products(self) -> AbstractContextManager[None]:
        """The context in which ``learn`` is called."""
        return bf16_products() if self.precision == "bf16" else nullcontext()

    def prepare(self) -> Hashable:
        """The host's half of an update: counts, learning rates, and the plan of what ``learn`` will do."""
        return None

    def learn(self, batch: Batch, plan: Any) -> dict[str, Tensor]:
        """The device's half: it changes tensors in place, and depends on nothing but tensors, the configuration and the plan."""
        raise NotImplementedError(f"{type(self).__name__} does not say how it learns")

    def state_dict(self) -> dict[str, Any]:  # type: ignore[override]
        return {
            "networks": nn.Module.state_dict(self),
            "optimisers": {name: _state_of(optimiser) for name, optimiser in self.optimisers.items()},
            "random": {name: random.state_dict() for name, random in self.random.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:  # type: ignore[override]
        nn.Module.load_state_dict(self, state["networks"])
        for name, optimiser in self.optimisers.items():
            _load(optimiser, state["optimisers"][name])
        for name, random in self.random.items():
            random.load_state_dict(state["random"][name])


def _state_of(optimiser: torch.optim.Optimizer) -> dict[str, Any]:
    """Its state, with learning rates as numbers, wherever they are while it works."""
    state = optimiser.state_dict()
    groups = [{key: float(value) if key == "lr" else value for key, value in group.items()} for group in state["param_groups"]]
    return {**state, "param_groups": groups}


def _load(optimiser: torch.optim.Optimizer, state: dict[str, Any]) -> None:
    rates = [group["lr"] for group in optimiser.param_groups]
    optimiser.load_state_dict(state)
    for group, rate in zip(optimiser.param_groups, rates, strict=True):
        if isinstance(rate, Tensor):
            group["lr"] = rate.fill_(group["lr"])


def check_precision(kind: type, name: str, precision: Precision, device: str) -> None:
    """Refuse a precision that a kind of learner, or a device, does not have.

    Raises:
        UsageError: the message says which there are.
    """
    if precision == "tf32" and device == "cpu":
        raise UsageError("precision=tf32 is for CUDA; on a CPU choose float32 or bf16.")
    if precision != "float32" and getattr(kind, "learns", True) and not issubclass(kind, Learner):
        raise UsageError(f"{name} knows no precision=bf16 and no tf32; leave it at float32.")


def set_precision(learner: object, precision: Precision) -> None:
    """Say how exactly a learner multiplies, before its first update. TF32 is a mode of the whole process."""
    if isinstance(learner, Learner):
        learner.precision = precision
    if torch.cuda.is_available():
        torch.backends.cuda.matmul.allow_tf32 = precision == "tf32"
