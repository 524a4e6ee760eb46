"""Trained policies in files beside their records: weights alone, which the record says how to use."""

from __future__ import annotations

import copy
import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from cudc_bench import plugins
from cudc_bench.artefacts.again import commands_from_nothing
from cudc_bench.artefacts.provenance import is_own_command, versions
from cudc_bench.artefacts.records import LABELS, Record, read_record
from cudc_bench.envs import check_domain
from cudc_bench.errors import CudcBenchError, RunError, UsageError
from cudc_bench.files import MOST_WEIGHTS, check_path, read_limited, unwritable, write_atomically
from cudc_bench.settings.config import field_names
from cudc_bench.settings.evaluate_config import EvaluateConfig

from ..base import Evaluator
from ..zero_shot import ZeroShotLearner

SUFFIX = ".policy.pt"
LEARNER = ".learner.pt"  # of a zero-shot learner, at the place of its training
SLOW = "target_"  # what the names of slow copies begin with


class Policy(nn.Module):
    """One member's deterministic policy, without the member axis.

    Attributes:
        record: of the run that trained it.
        observation_size, action_size: S and A.
    """

    def __init__(self, module: nn.Module, record: Record, observation_size: int, action_size: int) -> None:
        super().__init__()
        self.module = module
        self.record = record
        self.observation_size, self.action_size = observation_size, action_size

    def forward(self, observation: Tensor) -> Tensor:
        """(n, S) -> (n, A) in [-1, 1], float32."""
        action: Tensor = self.module(observation[None])[0]
        return action

    @torch.no_grad()
    def act(self, observation: ArrayLike) -> NDArray[np.float32]:
        """Actions (A,) or (n, A) in [-1, 1] for an observation (S,) or several (n, S), as Gymnasium's environments take and give them.

        Raises:
            UsageError: the observation has another shape.
        """
        array = np.array(observation, np.float32)
        if array.ndim not in {1, 2} or array.shape[-1] != self.observation_size:
            raise UsageError(
                f"the policy takes observations ({self.observation_size},) or (n, {self.observation_size}), not {array.shape}."
            )
        actions = self(torch.from_numpy(array.reshape(-1, self.observation_size))).numpy()
        return actions if array.ndim == 2 else actions[0]


def policy_path(record: Path) -> Path:
    """Where a record's policy is kept."""
    return record.with_name(record.name.removesuffix(".json") + SUFFIX)


def check_record(record: str | Path) -> Path:
    """The path of a record that a user named.

    Raises:
        UsageError: there is no such file.
    """
    path = check_path(record, "the record")
    if not path.is_file():
        raise UsageError(f"there is no record at '{path}'; cudc-bench evaluate prints the paths of those that it writes.")
    return path


def save_policy(policy: nn.Module, member: int, record: Path) -> None:
    """Write one member's policy beside its record.

    Args:
        policy: of all members, as :attr:`Evaluator.policy` gives it.
        member: which.
        record: its path.

    Raises:
        RunError: it cannot be written.
    """
    weights = {name: value[member : member + 1] for name, value in policy.state_dict().items()}
    _write_weights(weights, policy_path(record), "policy")


def save_learner(agent: ZeroShotLearner, member: int, place: Path) -> None:
    """Write what one member of a zero-shot learner needs to be asked for further tasks: its networks, without their slow copies.

    Args:
        agent: E members.
        member: which.
        place: the place of its training (see ``Run.path``).

    Raises:
        RunError: it cannot be written.
    """
    weights = {name: value.chunk(len(agent.seeds))[member] for name, value in _lasting(agent).items()}
    _write_weights(weights, place.with_name(place.name.removesuffix(".json") + LEARNER), "learner")


def _lasting(agent: ZeroShotLearner) -> dict[str, Tensor]:
    """What a trained learner is, without the slow copies that it learned with."""
    return {name: value for name, value in nn.Module.state_dict(agent).items() if not name.startswith(SLOW)}


def learner_path(record: Path, found: Record) -> Path:
    """Where the learner behind a record is kept, which all records of its training share."""
    stem = record.name.removesuffix(".json")
    if found.zero_shot is not None and found.zero_shot.labels != LABELS:
        stem = stem.replace(f"-labels{found.zero_shot.labels}", "", 1)
    folder = record.parent
    return folder.parent.parent / folder.name / (stem + LEARNER)


def load_learner(record: Path, found: Record) -> ZeroShotLearner:
    """The zero-shot learner of a record, of one member, on the CPU.

    Args:
        record: path of a record of its training.
        found: what it says.

    Raises:
        RunError: the learner is missing or damaged, or this version cannot make its networks from the record.
        UsageError: the record's algorithm or domain is not installed here.
    """
    path = learner_path(record, found)
    if not path.exists():
        raise RunError(f"the learner of {record} is not here ({path}); {_again(found)}")
    kind, facts = plugins.load("evaluators", found.algorithm), check_domain(found.dataset.domain)
    weights = _read_weights(path)
    agent = _agent(kind, found, facts.observation_size, facts.action_size, record, _largest(weights))
    if not isinstance(agent, ZeroShotLearner):
        raise RunError(f"{found.algorithm} is no learner without rewards here{_other_version(found)}.")
    _check_shapes(_lasting(agent), weights, f"the learner {path}", found)
    nn.Module.load_state_dict(agent, dict(weights), strict=False)
    return agent.eval().requires_grad_(False)


def _write_weights(weights: Mapping[str, Tensor], path: Path, what: str) -> None:
    content = io.BytesIO()
    # As if each were alone: how it lay in memory is nobody's business.
    alone = {name: value.detach().cpu().clone(memory_format=torch.contiguous_format) for name, value in weights.items()}
    torch.save(alone, content)
    try:
        write_atomically(path, content.getvalue())
    except OSError as error:
        raise unwritable(f"the {what} {path}", error) from None


def load_policy(record: str | Path) -> Policy:
    """The trained policy of a record, on the CPU.

    Args:
        record: path of the record, as ``evaluate`` returned it; the policy's weights lie beside it.

    Raises:
        RunError: the record or the policy is missing or damaged, or this version cannot make the policy's network from the record.
        UsageError: the record's algorithm or domain is not installed here.
    """
    place = check_path(record, "the record")
    found = read_record(place)
    path = policy_path(place)
    kind = plugins.load("evaluators", found.algorithm)
    facts = check_domain(found.dataset.domain)
    if not path.exists():
        raise RunError(f"{place} has no policy beside it ({path.name}); {_again(found)}")
    weights = _read_weights(path)
    module = copy.deepcopy(_agent(kind, found, facts.observation_size, facts.action_size, place, _largest(weights)).policy)
    _check_shapes(module.state_dict(), weights, f"the policy {path}", found)
    module.load_state_dict(weights)
    policy = Policy(module, found, facts.observation_size, facts.action_size)
    return policy.eval().requires_grad_(False)


def _largest(weights: Mapping[str, Tensor]) -> int:
    """The largest size of some weights."""
    return max((size for value in weights.values() for size in value.shape), default=1)


def _check_shapes(expected: Mapping[str, Tensor], there: Mapping[str, Tensor], what: str, record: Record) -> None:
    """Refuse weights that are not those of a network.

    Raises:
        RunError: they are others.
    """
    wanted, given = _shapes(expected), _shapes(there)
    if wanted != given:
        name = min(name for name in wanted.keys() | given.keys() if wanted.get(name) != given.get(name))
        raise RunError(
            f"{what} does not fit its record: '{name}' is {given.get(name, 'missing')} and should be"
            f" {wanted.get(name, 'missing')}{_other_version(record)}; {_again(record)}"
        )


def _agent(kind: Any, record: Record, observation: int, action: int, place: Path, largest: int) -> Evaluator:
    """What a record trained, with one member, whose weights do not matter yet; ``largest`` is the largest size of its weights."""
    known = set(field_names(kind.config_class))
    # A hyperparameter that came later has a default that does what was done before. One that has gone may have meant anything.
    gone = sorted(set(record.hyperparameters) - known - set(field_names(EvaluateConfig)))
    if gone:
        raise RunError(
            f"{place} was made by another version of {record.algorithm}: this one has no hyperparameter '{gone[0]}'"
            f"{_other_version(record)}; {_again(record)}"
        )
    try:
        config = kind.configure(settings={name: value for name, value in record.hyperparameters.items() if name in known})
        # A record asks for no more memory than its policy justifies.
        if (width := getattr(config, "width", 0)) > max(16 * largest, 4096):
            raise RunError(f"its width of {width:,} is not that of its policy")
        agent: Evaluator = kind(observation, action, config, [record.seed])
    except (CudcBenchError, ValueError, TypeError) as error:
        # Also what an algorithm itself refuses when it is built.
        raise RunError(f"{place} cannot be used with this version of {record.algorithm}: {str(error).rstrip('.')}.") from None
    return agent


def _read_weights(path: Path) -> Mapping[str, Tensor]:
    """Tensors by name. Nothing in the file is ever run."""
    try:
        content = read_limited(path, MOST_WEIGHTS)
    except OSError as error:
        raise RunError(f"cannot read the policy {path}: {error.strerror}.") from None
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            # PyTorch compresses nothing; what is compressed may be of any size.
            if any(member.compress_type != zipfile.ZIP_STORED for member in archive.infolist()):
                raise ValueError("compressed")
            broken = archive.testzip()  # PyTorch itself does not look at the checksums
        weights = None if broken else torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    except Exception:  # damage can break the reader anywhere in it, and its messages advise to trust the file
        raise RunError(f"the policy {path} is damaged, or is not a file of weights alone.") from None
    if weights is None:
        raise RunError(f"the policy {path} is damaged: its checksums are not those of its content.")
    if not isinstance(weights, Mapping) or not all(isinstance(k, str) and isinstance(v, Tensor) for k, v in weights.items()):
        raise RunError(f"the policy {path} is damaged: it does not hold weights by name.")
    if sum(value.numel() for value in weights.values()) > len(content):
        # Strides of 0 make a tensor of any size from one number.
        raise RunError(f"the policy {path} is damaged: it claims more weights than it has.")
    for name, value in weights.items():
        if value.layout is not torch.strided or not torch.isfinite(value).all():
            raise RunError(f"the policy {path} is damaged: '{name}' has weights that are not finite numbers.")
    return weights


def _shapes(weights: Mapping[str, Tensor]) -> dict[str, str]:
    """Of each tensor its shape and type, such as ``"1x24x16 float32"``."""
    return {name: f"{'x'.join(map(str, value.shape))} {str(value.dtype).removeprefix('torch.')}" for name, value in weights.items()}


def _other_version(record: Record) -> str:
    """The version that made a record, if it is another."""
    made, here = record.versions.get("cudc-bench", "unknown"), versions()["cudc-bench"]
    return "" if made == here else f" (made with cudc-bench {made}, this is {here})"


def _again(record: Record) -> str:
    # The record may be anybody's, and people copy what follows.
    return f"train it again with: {' && '.join(commands_from_nothing(record))}" if is_own_command(record.command) else "train it again"
