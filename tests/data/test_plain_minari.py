"""A dataset needs nothing of ours: plain Minari opens it in a process that has not imported this package."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from cudc_bench.artefacts.manifest import read_manifest

TASKS = {f"walker/{task}/cudc-smoke-v0": f"cudc_bench/walker-{task}-v0" for task in ("stand", "walk", "run", "flip")}
IDS = {"walker/cudc-smoke-v0": "cudc_bench/walker-v0"} | TASKS
SCRIPT = """
import hashlib, json, sys
import minari
import numpy as np

datasets = {name: minari.load_dataset(name) for name in sys.argv[1:]}
episodes = {name: list(dataset.iterate_episodes()) for name, dataset in datasets.items()}
steps = {name: sum(len(episode.actions) for episode in found) for name, found in episodes.items()}
heavy = {name.split(".")[0] for name in sys.modules} & {"cudc_bench", "dm_control", "torch", "mujoco"}
assert heavy == set(), heavy

def difference(live, stored):
    live = np.asarray(live)
    assert live.shape == stored.shape
    return float(np.abs(live - stored).max())

for name, dataset in datasets.items():
    environment = dataset.recover_environment()
    assert "cudc_bench" in sys.modules
    differences = []
    for metadata, episode in zip(dataset.storage.get_episode_metadata(range(len(episodes[name]))), episodes[name], strict=True):
        observation, info = environment.reset(seed=int(metadata["seed"]))
        observations, physics, rewards, ends = [observation], [info["physics"]], [], []
        for action in episode.actions:
            observation, reward, terminated, truncated, info = environment.step(action)
            observations.append(observation)
            physics.append(info["physics"])
            rewards.append(np.float32(reward))
            ends.append((terminated, truncated))
        assert ends == list(zip(episode.terminations, episode.truncations, strict=True))
        differences.append([
            difference(observations, episode.observations),
            difference(physics, episode.infos["physics"]),
            difference(rewards, episode.rewards),
        ])
    observed = hashlib.sha256(b"".join(episode.observations.tobytes() for episode in episodes[name])).hexdigest()
    print(json.dumps([name, environment.spec.id, steps[name], observed, differences]))
"""


def test_a_fresh_process_opens_recovers_and_replays_them(smoke: Path, python: Callable) -> None:
    done = python(SCRIPT, *IDS)
    assert (done.code, done.err) == (0, "")
    found = [json.loads(line) for line in done.out.splitlines()]
    assert {name: environment for name, environment, *_ in found} == IDS
    for name, _, steps, _, differences in found:
        assert steps == read_manifest(name).steps == 3000
        assert differences == [[0.0, 0.0, 0.0]] * 3
    assert len({observed for *_, observed, _ in found}) == 1
