"""``export``: from a run record to a policy in one file that needs PyTorch and nothing of this project."""

from __future__ import annotations

import hashlib
import io
import json
from pathlib import Path
from typing import Any

import torch
from torch.export import Dim

from cudc_bench.artefacts.provenance import versions
from cudc_bench.envs import check_domain, domain_title, env_id, make_simulators
from cudc_bench.envs.layouts import action_names, observation_layout
from cudc_bench.errors import RunError, UsageError
from cudc_bench.files import check_file, check_path, read_limited, unwritable, write_atomically

from .stored import Policy, check_record, load_policy

SUFFIX = ".pt2"
SPEC = "spec.json"  # inside the file
FORMAT = "cudc-bench policy 1"


def export_policy(record: str | Path, output: str | Path | None = None) -> Path:
    """Write the trained policy of a record as a file of its own, for ``torch.export.load``.

    It maps float32 observations (n, S) to actions (n, A) in [-1, 1], for any n. Inside the file, under the name ``spec.json``, is what it
    is: what observations and actions consist of, and how the policy was trained. The same policy gives the same bytes.

    Args:
        record: path of the record; its policy lies beside it.
        output: ``*.pt2``; beside the record unless given. A file that is there is replaced.

    Returns:
        The path of the file.

    Raises:
        UsageError: there is no such record; the output has another suffix or cannot be written.
        RunError: the record or its policy cannot be used, or writing failed.
    """
    place = check_record(record)
    path = place.with_suffix(SUFFIX) if output is None else check_path(output, "the output")
    if path.suffix.lower() != SUFFIX:
        raise UsageError(f"an exported policy cannot be '{path.name}'; it must end in {SUFFIX}.")
    check_file(path, "the output")
    policy = load_policy(place)
    content = to_bytes(policy, describe(policy, place, path.name))
    try:
        write_atomically(path, content)
    except OSError as error:
        raise unwritable(f"the policy {path}", error) from None
    return path


def to_bytes(policy: Policy, spec: dict[str, Any]) -> bytes:
    """The content of an exported file.

    Raises:
        RunError: the policy's network does what PyTorch cannot export.
    """
    # Two rows: PyTorch takes a size of 1 for a constant.
    example = torch.zeros(2, policy.observation_size)
    try:
        program = torch.export.export(policy, (example,), dynamic_shapes={"observation": {0: Dim("n", min=1)}})
    except Exception as error:  # of many kinds: a third party's network may do anything
        reason = (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")
        raise RunError(f"PyTorch cannot export the policy of {policy.record.algorithm}: {reason}.") from None
    for node in program.graph.nodes:
        # Where this machine keeps the source files is nobody's business.
        node.meta.pop("stack_trace", None)
    content = io.BytesIO()
    torch.export.save(program, content, extra_files={SPEC: json.dumps(spec, indent=1, ensure_ascii=False)})
    return content.getvalue()


def describe(policy: Policy, place: Path, name: str) -> dict[str, Any]:
    """What an exported policy is, JSON-ready.

    Args:
        policy: of the record.
        place: the record's path.
        name: of the exported file.
    """
    record = policy.record
    domain, dataset, final = check_domain(record.dataset.domain), record.dataset, record.final
    (simulator,) = make_simulators(domain.name, 1)
    parts, start = [], 0
    for block in observation_layout(domain.name):
        parts.append({"name": block.name, "start": start, "size": len(block.elements), "elements": list(block.elements)})
        start += len(block.elements)
    return {
        "format": FORMAT,
        "load": [
            "import torch",
            f'policy = torch.export.load({json.dumps(name)}).module()',
            f"action = policy(observation)  # float32 tensors (n, {policy.observation_size}) -> (n, {policy.action_size}), n >= 1",
        ],
        "observation": {"size": policy.observation_size, "dtype": "float32", "parts": parts},
        "action": {
            "size": policy.action_size, "dtype": "float32", "low": -1.0, "high": 1.0, "names": list(action_names(domain.name)),
            "meaning": "scaled linearly to the range of each actuator",
        },
        "environment": {
            "domain": domain.name, "task": dataset.task, "title": domain_title(domain.name),
            "gymnasium_id": env_id(domain.name, dataset.task) if dataset.reward is None else None,
            "control_timestep": simulator.timestep, "episode_length": domain.episode_length,
            "reward": None if dataset.reward is None else dataset.reward.model_dump(),
        },
        "training": {
            "algorithm": record.algorithm, "profile": record.profile, "seed": record.seed, "gradient_steps": final.step,
            "hyperparameters": record.hyperparameters, "hyperparameters_hash": record.hyperparameters_hash,
            "dataset": {
                "id": dataset.id, "fingerprint": dataset.fingerprint, "method": dataset.method, "seed": dataset.seed,
                "steps": dataset.steps, "profile": dataset.profile, "source": dataset.source, "used": dataset.used,
            },
            "command": record.command, "created": record.created, "commit": record.commit, "dirty": record.dirty,
            "versions": record.versions,
        },
        "result": {"return": final.mean, "episodes": len(final.returns), "returns": final.returns, "largest_possible": domain.max_return},
        "record": {"file": place.name, "sha256": _sha256(place)},
        "exported_with": versions(),
    }  # fmt: skip


def _sha256(place: Path) -> str:
    try:
        return hashlib.sha256(read_limited(place)).hexdigest()
    except OSError as error:
        raise RunError(f"cannot read the record {place}: {error.strerror}.") from None
