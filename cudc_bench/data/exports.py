"""Ways out: datasets as torch tensors, for d3rlpy and for TorchRL.

Both libraries have readers of Minari datasets of their own, which these functions do not use: that of d3rlpy 2.8 puts the T+1 observations
of an episode beside its T actions, so that each episode is shifted by one more row than the one before, and that of TorchRL 0.14 returns
zeros for local datasets. Here everything goes through our own flat arrays. torch, d3rlpy and TorchRL are imported when they are used.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cudc_bench.artefacts.ids import DatasetId, parse_id
from cudc_bench.artefacts.manifest import read_manifest
from cudc_bench.data.reader import load_episodes
from cudc_bench.data.transitions import load_transitions, torch_device
from cudc_bench.errors import UsageError

if TYPE_CHECKING:
    import torch
    from d3rlpy.dataset import MDPDataset  # type: ignore[import-not-found,import-untyped,unused-ignore]
    from torchrl.data import TensorDictReplayBuffer  # type: ignore[import-not-found,import-untyped,unused-ignore]


def to_d3rlpy(
    dataset_id: DatasetId | str,
    *,
    transition_picker: Any = None,
    trajectory_slicer: Any = None,
    unlabelled: bool = False,
    root: str | Path | None = None,
) -> MDPDataset:
    """Read a dataset as d3rlpy's ``MDPDataset``, with every transition of every episode.

    An episode of d3rlpy is rows of (observation, action, reward), and the transition of row t takes s' from row t+1; of an episode that
    ends by a timeout, as all here do, the last row is therefore no transition but only the place of the last s'. So T steps become T+1
    rows, and the closing one holds the last observation, the last action once more and reward 0. d3rlpy makes T transitions of them,
    whose values are those of :func:`cudc_bench.load_transitions`. None is terminal, so that values bootstrap through the end. The closing
    row is never sampled as a transition, nor as a part of a trajectory, and adds nothing to returns; but ``episode.size()`` is T+1, and
    the last transition's ``next_action``, which no data can tell and of d3rlpy's algorithms only ReBRAC reads, repeats its action.

    Args:
        dataset_id: such as ``"walker/walk/cudc-v0"``.
        transition_picker, trajectory_slicer: as for ``MDPDataset``, such as ``d3rlpy.dataset.MultiStepTransitionPicker(3, gamma=0.99)``.
        unlabelled: accept a dataset without rewards, whose rewards are all 0.
        root: Minari's root unless given.

    Returns:
        Observations (S,) and actions (A,) float32, rewards (1,) float32.

    Raises:
        UsageError: no such dataset, or not one of ours; it has no rewards; or d3rlpy is not installed.
        RunError: the data are damaged, or the base is missing.
    """
    checked, place = _checked(dataset_id, unlabelled, root)
    dataset = _optional("d3rlpy.dataset", "to_d3rlpy")
    constants = _optional("d3rlpy.constants", "to_d3rlpy")
    flat = load_episodes(checked, ("observations", "actions", "rewards"), place)
    rows = flat.lengths + 1
    closing = np.zeros(int(rows.sum()), np.bool_)
    closing[np.cumsum(rows) - 1] = True
    # The row among the actions that each row takes its action from: one less for each closing row before it, itself included.
    source = np.arange(len(closing)) - np.cumsum(closing)
    return dataset.MDPDataset(
        observations=flat.arrays["observations"],
        actions=flat.arrays["actions"][source],
        rewards=np.where(closing, np.float32(0), flat.arrays["rewards"][source]),
        terminals=np.zeros(len(closing), np.float32),
        timeouts=closing.astype(np.float32),
        transition_picker=transition_picker,
        trajectory_slicer=trajectory_slicer,
        action_space=constants.ActionSpace.CONTINUOUS,
        action_size=flat.arrays["actions"].shape[1],
    )


def to_torchrl(
    dataset_id: DatasetId | str,
    *,
    batch_size: int = 256,
    device: str | torch.device = "cpu",
    unlabelled: bool = False,
    root: str | Path | None = None,
    **options: Any,
) -> TensorDictReplayBuffer:
    """Read a dataset into a TorchRL replay buffer, one row for each transition, in collection order.

    A row holds ``observation`` (S,), ``action`` (A,), ``episode`` () int64, and below ``next``: ``observation`` (S,), ``reward`` (1,),
    ``terminated`` (1,), ``truncated`` (1,) and ``done`` (1,), all as TorchRL's losses expect them. ``terminated`` is always False, so
    that values bootstrap through the end of an episode; ``truncated`` and ``done`` are True at its last step.

    Args:
        dataset_id: such as ``"walker/walk/cudc-v0"``.
        batch_size: rows of a sample.
        device: where the buffer lives: ``"cpu"``, ``"cuda"``, ``"auto"``, or any other that torch knows.
        unlabelled: accept a dataset without rewards, whose rewards are all 0.
        root: Minari's root unless given.
        options: as for ``TensorDictReplayBuffer``, such as ``sampler=SliceSampler(num_slices=8, traj_key="episode")``, ``transform`` or
            ``prefetch``.

    Returns:
        A ``TensorDictReplayBuffer`` over a ``LazyTensorStorage``, full.

    Raises:
        UsageError: no such dataset, or not one of ours; it has no rewards; no such device; or TorchRL is not installed.
        RunError: the data are damaged, or the base is missing.
    """
    checked, place = _checked(dataset_id, unlabelled, root)
    torchrl = _optional("torchrl.data", "to_torchrl")
    tensordict = _optional("tensordict", "to_torchrl")
    where = torch_device(device)
    data = load_transitions(checked, root=place).to_torch()
    # Scalars of a step have a last dimension of their own in TorchRL; without it, a reward would be broadcast against values.
    following = {
        "observation": data.next_observations,
        "reward": data.rewards[:, None],
        "terminated": data.terminations[:, None],
        "truncated": data.truncations[:, None],
        "done": (data.terminations | data.truncations)[:, None],
    }
    rows = {"observation": data.observations, "action": data.actions, "episode": data.episodes, "next": following}
    storage = torchrl.LazyTensorStorage(len(data), device=where)
    buffer = torchrl.TensorDictReplayBuffer(storage=storage, batch_size=batch_size, **options)
    buffer.extend(tensordict.TensorDict(rows, batch_size=[len(data)]))
    return buffer


def _checked(dataset_id: DatasetId | str, unlabelled: bool, root: str | Path | None) -> tuple[DatasetId, Path | None]:
    checked = dataset_id if isinstance(dataset_id, DatasetId) else parse_id(dataset_id)
    place = None if root is None else Path(root)
    if read_manifest(checked, place).task is None and not unlabelled:
        raise UsageError(
            f"'{checked}' has no rewards, they are all 0; label it with cudc-bench relabel {checked} and take one of its tasks, "
            "or pass unlabelled=True."
        )
    return checked, place


def _optional(module: str, function: str) -> Any:
    extra = function.removeprefix("to_")  # each extra is named after its library
    try:
        return import_module(module)
    except ImportError as error:
        # Not only where it is absent: the reason names what an installation lacks.
        reason = " ".join(str(error).split())
        raise UsageError(f"{function} needs {extra}, which cannot be imported ({reason}); pip install 'cudc-bench[{extra}]'.") from None
