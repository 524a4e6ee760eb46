"""What a dataset says of itself: Minari's metadata, with our manifest in it, and the card."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from cudc_bench.artefacts.manifest import KEY, Manifest
from cudc_bench.data.card import render_card
from cudc_bench.data.layout import MAIN_FILE
from cudc_bench.data.measure import Coverage, measure_coverage, reward_statistics


def write_metadata(data: Path, manifest: Manifest, dataset_id: str, description: str, coverage: Coverage | None = None) -> None:
    """Write Minari's ``metadata.json``, with our manifest in it, and the dataset's card, ``README.md`` beside the ``data`` folder.

    Args:
        data: the dataset's ``data`` folder, with its HDF5 file complete.
        manifest: what the dataset is.
        dataset_id: its id.
        description: one paragraph for people.
        coverage: of its observations and actions, where that is known; it is computed unless given.
    """
    metadata = minari_metadata(data, manifest, dataset_id, description)
    (data / "metadata.json").write_text(json.dumps(metadata, indent=1) + "\n", encoding="utf-8")

    file = data / MAIN_FILE
    card = render_card(manifest, dataset_id, description, reward_statistics(file, manifest), coverage or measure_coverage(file, manifest))
    (data.parent / "README.md").write_text(card, encoding="utf-8")


def minari_metadata(data: Path, manifest: Manifest, dataset_id: str, description: str) -> dict[str, Any]:
    """What Minari keeps of a dataset in ``metadata.json``; the arguments are those of :func:`write_metadata`."""
    import minari
    from minari.serialization import serialize_space

    from cudc_bench.envs import env_spec
    from cudc_bench.envs.gym import action_space, observation_space

    reward = None if manifest.reward is None else manifest.reward.reference
    requirements = [f"{name}=={manifest.versions[name]}" for name in ("cudc-bench", "dm-control", "mujoco", "gymnasium")]
    metadata: dict[str, Any] = {
        "dataset_id": dataset_id,
        "minari_version": minari.__version__,
        "data_format": "hdf5",
        "total_episodes": manifest.episodes,
        "total_steps": manifest.steps,
        "dataset_size": round((data / MAIN_FILE).stat().st_size / 1e6, 3),
        "observation_space": serialize_space(observation_space(manifest.domain)),
        "action_space": serialize_space(action_space(manifest.domain)),
        "env_spec": env_spec(manifest.domain, manifest.task, reward).to_json(),
        "algorithm_name": manifest.label,
        "author": ["cudc-bench" if manifest.imported is None else manifest.imported.source],
        "author_email": [],
        "code_permalink": (manifest.commit if manifest.imported is None else None) or "",
        "description": description,
        "requirements": requirements,
        KEY: manifest.model_dump(),
    }
    if manifest.base is not None and manifest.base.linked:
        metadata["combined_datasets"] = [manifest.base.id]
    elif manifest.mixture is not None:
        metadata["combined_datasets"] = [part.id for part in manifest.mixture.parts]
    return metadata
