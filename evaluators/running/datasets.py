"""From datasets on the disk to minibatches of a stack."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from cudc_bench.artefacts.manifest import read_manifest
from cudc_bench.data.reader import FlatEpisodes, load_episodes
from cudc_bench.learning.networks import MemberRandom
from cudc_bench.learning.replay import Episodes


def load_members(
    ids: Sequence[str], seeds: Sequence[int], device: torch.device | str, used: int | None = None, labelled: bool = True
) -> Episodes:
    """The datasets of a stack of members, for sampling one-step transitions.

    Members whose datasets differ in their rewards only (the tasks of one collected dataset) share one copy of the rest.

    Args:
        ids: a dataset for each member.
        seeds: of the members' index streams.
        device: where the arrays go.
        used: only the first so many transitions of each dataset; the episode in which they end is cut short.
        labelled: whether they are read with their rewards.
    """
    sources: dict[tuple[str, str], int] = {}
    flats: list[FlatEpisodes] = []
    source_of_member, rewards = [], []
    for one in ids:
        fields = read_manifest(one).fields
        key = (fields["observations"], fields["actions"])
        if key not in sources:
            sources[key] = len(flats)
            flats.append(load_episodes(one, ("observations", "actions"), verify=True))
        source_of_member.append(sources[key])
        if labelled:
            rewards.append(torch.from_numpy(load_episodes(one, ("rewards",), verify=True).arrays["rewards"]))
    steps = used or max(int(flat.lengths.sum()) for flat in flats)
    first = flats[0].arrays
    episodes = Episodes(
        len(flats), max(len(flat.lengths) for flat in flats), steps, first["observations"].shape[1], first["actions"].shape[1],
        MemberRandom(seeds, "replay", device), source_of_member,
    )  # fmt: skip
    for source, flat in enumerate(flats):
        left = steps
        for observations, actions in zip(flat.split("observations"), flat.split("actions"), strict=True):
            length = min(left, len(actions))
            if length:
                episodes.add(source, torch.from_numpy(observations[: length + 1]), torch.from_numpy(actions[:length]))
            left -= length
    if not labelled:
        return episodes
    padded = torch.zeros(len(ids), steps, device=device)
    for row, values in zip(padded, rewards, strict=True):
        row[: len(values)] = values[:steps].to(device)
    episodes.rewards = padded
    return episodes
