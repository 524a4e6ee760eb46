"""The whole chain on domains of dm_control's suite, as users call it, and what it leaves."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import html5lib
import numpy as np
import pytest
from dm_control import suite

import cudc_bench
from cudc_bench.artefacts.manifest import read_manifest
from cudc_bench.artefacts.records import read_record
from cudc_bench.errors import UsageError

DOMAIN = "dm_control/cheetah-run"
BASE, LABELLED = "dm_control/cheetah_run/random-smoke-v0", "dm_control/cheetah_run/run/random-smoke-v0"
REPLAY = """
import json, sys
import minari
import numpy as np

datasets = [minari.load_dataset(name) for name in sys.argv[1:]]
assert not {one.split(".")[0] for one in sys.modules} & {"cudc_bench", "dm_control", "mujoco"}
for dataset in datasets:
    episode = next(dataset.iterate_episodes([1]))
    environment = dataset.recover_environment()
    (metadata,) = dataset.storage.get_episode_metadata([1])
    observation, info = environment.reset(seed=int(metadata["seed"]))
    observations, physics, rewards, ends = [observation], [info["physics"]], [], []
    for action in episode.actions:
        observation, reward, terminated, truncated, info = environment.step(action)
        observations.append(observation)
        physics.append(info["physics"])
        rewards.append(np.float32(reward))
        ends.append(terminated or truncated)
    same = [
        np.stack(observations).tobytes() == episode.observations.tobytes(),
        np.stack(physics).tobytes() == episode.infos["physics"].tobytes(),
        np.stack(rewards).tobytes() == episode.rewards.tobytes(),
    ]
    print(json.dumps([environment.spec.id, same, len(rewards), ends.index(True)]))
"""


def test_from_collection_to_the_table(cli: Callable, python: Callable, datasets: Path, tmp_path: Path) -> None:
    options = ("--domain", DOMAIN, "--method", "random")
    done = cli("collect", *options)
    assert (done.code, done.out) == (0, f"{BASE}\n")
    assert f"cudc-bench relabel {BASE}" in done.err
    assert (datasets / BASE / "data" / "main_data.hdf5").is_file()
    assert "dm_control's cheetah-run through Shimmy" in json.loads((datasets / BASE / "data" / "metadata.json").read_text())["description"]
    done = cli("relabel", BASE)
    assert (done.code, done.out) == (0, f"{LABELLED}\n")
    done = cli("evaluate", *options, "--workers", "1")
    assert done.code == 0, done.err
    path = Path(done.out.strip())
    assert path == Path("results/smoke/dm_control/cheetah_run/run/random-smoke-v0/td3-seed1.json")
    record = read_record(tmp_path / path)
    assert (record.dataset.domain, record.dataset.task, record.dataset.id) == (DOMAIN, "run", LABELLED)
    assert f"--domain {DOMAIN} --method random --seed 1 --task run" in record.command
    done = cli("leaderboard", "--domain", DOMAIN)
    assert done.code == 0, done.err
    assert {"index.html", "smoke.td3", "smoke.td3.dm_control.cheetah-run"} <= {one.name for one in (tmp_path / "report").iterdir()}
    # Real records make pages that HTML allows, the dataset's with what was measured of it.
    pages = list((tmp_path / "report").rglob("*.html"))
    for page in pages:
        html5lib.HTMLParser(strict=True).parse(page.read_text())
    assert any("top 1 % of steps" in page.read_text() for page in pages if page.parent.name == "datasets")
    assert f"{DOMAIN}, td3, profile smoke" in done.out

    done = python(REPLAY, BASE, LABELLED)
    assert (done.code, done.err) == (0, "")
    ids = ("cudc_bench/dm_control.cheetah-run-v0", "cudc_bench/dm_control.cheetah-run-run-v0")
    assert [json.loads(line) for line in done.out.splitlines()] == [[one, [True] * 3, 1000, 999] for one in ids]
    labelled = cudc_bench.load_transitions(LABELLED, verify=True)
    best = int(labelled.rewards.argmax())
    environment = suite.load("cheetah", "run")
    environment.reset()
    with environment.physics.reset_context():
        environment.physics.set_state(_state(datasets, best))
    assert labelled.rewards[best] == np.float32(environment.task.get_reward(environment.physics)) > 0


def _state(datasets: Path, step: int) -> np.ndarray:
    """The state that a step led to, read without any code of ours."""
    import h5py

    with h5py.File(datasets / BASE / "data" / "main_data.hdf5") as file:
        return np.array(file[f"episode_{step // 1000}/infos/physics"][step % 1000 + 1])


def test_a_domain_whose_rewards_no_state_tells_is_collected_and_says_so(datasets: Path) -> None:
    reason = "easy, hard: its reward depends on more than state and action (a target drawn at reset, a sensor that lags)"
    cudc_bench.collect("random", "dm_control/reacher-easy", profile="smoke", settings={"steps": 1200})
    one = "dm_control/reacher_easy/random-smoke-v0"
    assert read_manifest(one).domain == "dm_control/reacher-easy"
    assert reason in json.loads((datasets / one / "data" / "metadata.json").read_text())["description"]
    before = sorted(datasets.rglob("*"))
    for refused in (
        lambda: cudc_bench.relabel(one),
        lambda: cudc_bench.relabel(one, ["easy"]),
        lambda: cudc_bench.evaluate(domain="dm_control/reacher-easy", methods=["random"], profile="smoke"),
        lambda: cudc_bench.evaluate(dataset_id=one, domain="dm_control/reacher-easy", profile="smoke"),
        lambda: cudc_bench.evaluate(dataset_id=one, profile="smoke"),
    ):
        with pytest.raises(UsageError) as refusal:
            refused()
        assert "has no task that can be relabelled" in str(refusal.value)
        assert reason in str(refusal.value)
    assert sorted(datasets.rglob("*")) == before


def test_a_method_says_that_it_has_no_values_for_a_domain(capsys: pytest.CaptureFixture) -> None:
    cudc_bench.collect("cudc", DOMAIN, profile="smoke", settings={"steps": 1100})
    assert f"cudc has no values of its own for {DOMAIN}; it takes those for walker\n" in capsys.readouterr().err
    values = read_manifest("dm_control/cheetah_run/cudc-smoke-v0").hyperparameters
    assert (values["alpha"], values["beta"], values["c_w"]) == (1e-3, 1e-2, 0.02)
