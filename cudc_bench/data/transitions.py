"""Datasets as one-step transitions, in NumPy's arrays and in torch's tensors; torch is imported when it is asked for."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cudc_bench.artefacts.ids import DatasetId
from cudc_bench.data.reader import load_episodes, verify_fingerprint
from cudc_bench.errors import UsageError
from cudc_bench.settings.profiles import resolve_device

if TYPE_CHECKING:
    import torch

Array = NDArray[Any]


@dataclass(frozen=True)
class Transitions:
    """One-step transitions of N steps in collection order; row i never crosses an episode's end.

    Attributes:
        observations: s (N, S) float32.
        actions: a (N, A) float32.
        rewards: r (N,) float32; zeros in a task-agnostic dataset.
        next_observations: s' (N, S) float32.
        terminations: (N,) bool, always False in these domains.
        truncations: (N,) bool, True at the last step of each episode.
        episodes: (N,) int64, the episode of each row.
    """

    observations: Array
    actions: Array
    rewards: Array
    next_observations: Array
    terminations: Array
    truncations: Array
    episodes: Array

    def __len__(self) -> int:
        return len(self.rewards)

    def to_torch(self, device: Any = "cpu") -> TensorTransitions:
        """The same as torch tensors, field by field, with the same shapes and types.

        Args:
            device: ``"cpu"``, ``"cuda"``, ``"auto"``, or any other that torch knows. On the CPU the tensors share these arrays' memory.

        Raises:
            UsageError: there is no such device here.
        """
        return to_torch(self, device)


@dataclass(frozen=True)
class TensorTransitions:
    """What :class:`~cudc_bench.data.transitions.Transitions` holds, as torch tensors on one device, field by field.

    Attributes:
        observations: s (N, S) float32.
        actions: a (N, A) float32.
        rewards: r (N,) float32; zeros in a task-agnostic dataset.
        next_observations: s' (N, S) float32.
        terminations: (N,) bool, always False in these domains.
        truncations: (N,) bool, True at the last step of each episode.
        episodes: (N,) int64, the episode of each row.
    """

    observations: torch.Tensor
    actions: torch.Tensor
    rewards: torch.Tensor
    next_observations: torch.Tensor
    terminations: torch.Tensor
    truncations: torch.Tensor
    episodes: torch.Tensor

    def __len__(self) -> int:
        return len(self.rewards)


def load_transitions(dataset_id: DatasetId | str, *, verify: bool = False, root: str | Path | None = None) -> Transitions:
    """Read a dataset as one-step transitions.

    Args:
        dataset_id: such as ``"walker/walk/cudc-v0"``.
        verify: compute the fingerprint anew and compare it with the manifest's.
        root: Minari's root unless given.

    Raises:
        UsageError: no such dataset, or not one of ours.
        RunError: the data are damaged, the base is missing, or (with ``verify``) the fingerprint does not fit.
    """
    place = None if root is None else Path(root)
    names = ("observations", "actions", "rewards", "terminations", "truncations")
    if verify:
        verify_fingerprint(dataset_id, place)
    flat = load_episodes(dataset_id, names, place)
    ends = np.cumsum(flat.lengths + 1) - 1
    first = np.ones(len(flat.arrays["observations"]), np.bool_)
    first[ends] = False
    following = np.roll(first, 1)
    return Transitions(
        observations=flat.arrays["observations"][first],
        actions=flat.arrays["actions"],
        rewards=flat.arrays["rewards"],
        next_observations=flat.arrays["observations"][following],
        terminations=flat.arrays["terminations"],
        truncations=flat.arrays["truncations"],
        episodes=np.repeat(np.arange(len(flat.lengths)), flat.lengths),
    )


def to_torch(transitions: Transitions, device: str | torch.device = "cpu") -> TensorTransitions:
    """Transitions as tensors; see :meth:`cudc_bench.Transitions.to_torch`."""
    import torch

    place = torch_device(device)
    return TensorTransitions(**{one.name: torch.from_numpy(getattr(transitions, one.name)).to(place) for one in fields(TensorTransitions)})


def torch_device(device: str | torch.device) -> torch.device:
    """The device of that name; ``"auto"`` is CUDA where there is some.

    Raises:
        UsageError: there is none here.
    """
    import torch

    try:
        place = torch.device(resolve_device("auto") if device == "auto" else device)
        torch.empty(0, device=place)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise UsageError(f"device '{device}' is not available here: {str(error).splitlines()[0]}") from None
    return place
