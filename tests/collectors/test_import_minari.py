"""What Minari's own tools make becomes a dataset like any other here; whatever does not fit is refused in one line, with nothing left."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import h5py
import minari
import numpy as np
import pytest
from minari.data_collector import EpisodeBuffer

import cudc_bench
from cudc_bench.artefacts.manifest import read_manifest
from cudc_bench.cli.app import main
from cudc_bench.envs import env_id
from cudc_bench.errors import RunError, UsageError

MINE, BOTH = "walker/mine-v0", "walker/both-v0"
STEPS = (30, 12)
# Minari's advice on what its metadata could hold, and on collectors' options.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


def record(domain: str, task: str | None, steps: tuple[int, ...], first_seed: int) -> list[EpisodeBuffer]:
    """Episodes as Minari's DataCollector buffers them with ``record_infos=True``."""
    environment, buffers = gymnasium.make(env_id(domain, task)), []
    generator = np.random.default_rng(first_seed)
    for index, length in enumerate(steps):
        observation, info = environment.reset(seed=first_seed + index)
        rows: dict[str, list[Any]] = {"observations": [observation], "physics": [info["physics"]], "actions": [], "rewards": []}
        for _ in range(length):
            rows["actions"].append(generator.uniform(-1, 1, environment.action_space.shape).astype(np.float32))
            observation, reward, _, _, info = environment.step(rows["actions"][-1])
            rows["rewards"].append(reward)
            rows["observations"].append(observation)
            rows["physics"].append(info["physics"])
        ends = [False] * (length - 1) + [True]
        buffers.append(
            EpisodeBuffer(
                id=None, seed=first_seed + index, observations=rows["observations"], actions=rows["actions"], rewards=rows["rewards"],
                terminations=[False] * length, truncations=ends,
                infos={"physics": rows["physics"], "speed": np.arange(length + 1.0)[:, None]},
            )
        )  # fmt: skip
    return buffers


def create(name: str, domain: str = "walker", task: str | None = "walk", first_seed: int = 0) -> minari.MinariDataset:
    environment = gymnasium.make(env_id(domain, task))
    return minari.create_dataset_from_buffers(name, record(domain, task, STEPS, first_seed), env=environment)


@pytest.fixture(scope="module")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("made") / "datasets"
    root.mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        minari.combine_datasets([create(MINE), create("walker/more-v0", first_seed=7)], BOTH)
    return root


@pytest.fixture
def made(made_once: Path, datasets: Path) -> Path:
    """The test's own root, with ``walker/mine-v0`` and, combined of it and another one, ``walker/both-v0``."""
    shutil.copytree(made_once, datasets)
    return datasets


def everything(root: Path) -> list[str]:
    return sorted(path.relative_to(root).as_posix() for path in root.rglob("*"))


def test_what_minari_combined_can_be_labelled_and_stands_the_test_of_the_simulation(made: Path) -> None:
    assert cudc_bench.import_minari(BOTH, "theirs") == "walker/theirs-v0"
    manifest = read_manifest("walker/theirs-v0")
    assert (manifest.steps, manifest.episodes, manifest.task, manifest.label) == (2 * sum(STEPS), 4, None, "theirs (Minari)")
    assert manifest.command == "cudc-bench import-minari --method theirs --seed 1 walker/both-v0"
    for original, copy in zip(minari.load_dataset(BOTH), minari.load_dataset("walker/theirs-v0"), strict=True):
        for name in ("observations", "actions"):
            assert getattr(copy, name).tobytes() == getattr(original, name).tobytes()
        for name in ("physics", "speed"):
            assert copy.infos[name].tobytes() == original.infos[name].tobytes()
        assert not copy.rewards.any()
    (labelled,) = cudc_bench.relabel("walker/theirs-v0", ["walk"])
    for original, copy in zip(minari.load_dataset(BOTH), minari.load_dataset(labelled), strict=True):
        # The rewards that Minari recorded are those of the states.
        np.testing.assert_allclose(copy.rewards, original.rewards, rtol=0, atol=1e-6)
    for one in ("walker/theirs-v0", labelled):
        checks = cudc_bench.verify(one, sample=None).checks
        assert "84 transitions (all): 4 episodes step by step" in str(checks)


def test_with_a_task_the_rewards_are_kept(made: Path) -> None:
    assert cudc_bench.import_minari(MINE, "theirs", task="walk") == "walker/walk/theirs-v0"
    for original, copy in zip(minari.load_dataset(MINE), minari.load_dataset("walker/walk/theirs-v0"), strict=True):
        np.testing.assert_array_equal(copy.rewards, original.rewards.astype(np.float32))
        assert copy.rewards.any()


def test_every_domain_says_itself_which_it_is(datasets: Path) -> None:
    create("arm/mine-v0", "jaco", None)
    assert cudc_bench.import_minari("arm/mine-v0", "theirs") == "jaco/theirs-v0"
    assert read_manifest("jaco/theirs-v0").command.endswith("--seed 1 arm/mine-v0")


def test_a_collectors_own_recording_is_taken(datasets: Path) -> None:
    """Minari's DataCollector itself, which needs JAX, with seeds of its own and an episode that was left in the middle."""
    pytest.importorskip("jax")
    datasets.mkdir(parents=True)
    collector = minari.DataCollector(gymnasium.make("cudc_bench/walker-v0"), record_infos=True)
    for _ in range(2):
        collector.reset(options={"minari_autoseed": True})
        for _ in range(8):
            collector.step(collector.action_space.sample())
    collector.create_dataset(MINE)
    collector.close()
    cudc_bench.import_minari(MINE, "theirs")
    assert read_manifest("walker/theirs-v0").steps == 16
    assert "16 transitions (all)" in str(cudc_bench.verify("walker/theirs-v0", sample=None).checks)


def test_without_states_it_says_what_cannot_be_done(made: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with h5py.File(made / MINE / "data" / "main_data.hdf5", "a") as file:
        for index in range(len(STEPS)):
            del file[f"episode_{index}/infos"]
    cudc_bench.import_minari(MINE, "theirs")
    assert "no physics states are in it (DataCollector keeps them with record_infos=True)" in capfd.readouterr().err
    with pytest.raises(UsageError, match="no physics states"):
        cudc_bench.relabel("walker/theirs-v0")


def replace(group: h5py.Group, name: str, value: Any, **options: Any) -> None:
    del group[name]
    group.create_dataset(name, data=value, **options)


def scaled(group: h5py.Group) -> None:
    group["actions"][3] = 1.5


FAULTS: dict[str, tuple[Callable[[h5py.Group], Any], str]] = {
    "action": (scaled, "has an action of size 1.5; all must be within [-1, 1]"),
    "no last observation": (lambda g: replace(g, "observations", g["observations"][:-1]), "has 'observations' of shape"),
    "another domain": (lambda g: replace(g, "observations", np.zeros((len(g["actions"]) + 1, 78), np.float32)), "of walker have"),
    "terminated": (lambda g: replace(g, "terminations", np.ones(len(g["actions"]), bool)), "was terminated"),
    "not finite": (lambda g: replace(g, "rewards", np.full(len(g["actions"]), np.nan)), "a number in 'rewards' that is not finite"),
    "complex": (lambda g: replace(g, "rewards", np.ones(len(g["actions"]), complex)), "which are no plain numbers"),
    "too large": (
        lambda g: replace(g, "observations", g["observations"][:].astype(float) * 1e60), "number in 'observations' that float32 cannot hold"
    ),
    "big-endian": (lambda g: replace(g, "actions", g["actions"][:].astype(">f4")), "which are no plain numbers"),
    "narrow states": (lambda g: replace(g["infos"], "physics", g["infos/physics"][:].astype(np.float32)), "has 'infos/physics' of float32"),
    "infinite states": (lambda g: replace(g["infos"], "physics", g["infos/physics"][:] + np.inf), "that is not finite"),
    "missing": (lambda g: g.pop("truncations"), "there is no /episode_"),
    "dictionary": (lambda g: (g.pop("observations"), g.create_group("observations")), "that is no array"),
    "link": (lambda g: (g.pop("actions"), g.__setitem__("actions", h5py.ExternalLink("/etc/passwd", "/x"))), "is a link to somewhere else"),
    "gone": (lambda g: g.parent.pop(g.name), "that cannot be read"),
    "long": (lambda g: replace(g, "actions", np.zeros((1001, 6), np.float32)), "has 1,001 steps; one of walker has 1 to 1,000"),
    "empty": (lambda g: replace(g, "actions", np.zeros((0, 6), np.float32)), "has 0 steps"),
    "large": (
        lambda g: (g.pop("rewards"), g.create_dataset("rewards", (2**40,), np.float64, chunks=(2**10,))),
        "the limit for an episode of states",
    ),
    "unwritten": (
        lambda g: (g.pop("rewards"), g.create_dataset("rewards", (len(g["actions"]),), np.float64, chunks=(4,))), "its file does not have"
    ),
}  # fmt: skip


@pytest.mark.parametrize("episode", [0, 1])
@pytest.mark.parametrize("fault", FAULTS)
def test_an_episode_that_does_not_fit_ends_the_import_with_nothing_left(fault: str, episode: int, made: Path) -> None:
    change, message = FAULTS[fault]
    with h5py.File(made / MINE / "data" / "main_data.hdf5", "a") as file:
        change(file[f"episode_{episode}"])
    before = everything(made)
    with pytest.raises(RunError if episode else UsageError) as refused:
        cudc_bench.import_minari(MINE, "theirs")
    text = str(refused.value)
    assert message in text
    assert f"episode_{episode}" in text
    assert "\n" not in text
    assert everything(made) == before


def test_compressed_arrays_are_read(made: Path) -> None:
    with h5py.File(made / MINE / "data" / "main_data.hdf5", "a") as file:
        for index in range(len(STEPS)):
            group = file[f"episode_{index}"]
            replace(group, "observations", group["observations"][:], compression="gzip", shuffle=True)
    cudc_bench.import_minari(MINE, "theirs")
    for original, copy in zip(minari.load_dataset(MINE), minari.load_dataset("walker/theirs-v0"), strict=True):
        assert copy.observations.tobytes() == original.observations.tobytes()


def test_all_episodes_hold_the_same_infos(made: Path) -> None:
    with h5py.File(made / MINE / "data" / "main_data.hdf5", "a") as file:
        del file["episode_1/infos/speed"]
    with pytest.raises(RunError, match=r"episode_1 with other infos \(physics\) than episode_0 \(physics, speed\)"):
        cudc_bench.import_minari(MINE, "theirs")


def edit(root: Path, **changes: Any) -> None:
    path = root / MINE / "data" / "metadata.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"data_format": "arrow"}, "only hdf5 is read"),
        ({"total_episodes": -1}, "has -1 episodes by its metadata"),
        ({"total_episodes": 10**9}, "episodes by its metadata"),
        ({"total_episodes": 5}, "holds an episode_2 that cannot be read"),
        ({"env_spec": None}, "does not say of which domain it is; give --domain, such as walker, quadruped, jaco"),
        ({"env_spec": json.dumps({"entry_point": "os:system", "kwargs": {"domain": "walker"}})}, "does not say of which domain it is"),
        ({"env_spec": json.dumps({"entry_point": "cudc_bench.envs.gym:SimulatorEnv", "kwargs": {"domain": "x"}})}, "unknown domain 'x'"),
    ],
)
def test_metadata_that_do_not_fit_are_refused(changes: dict[str, Any], message: str, made: Path) -> None:
    edit(made, **changes)
    with pytest.raises((UsageError, RunError), match=message):
        cudc_bench.import_minari(MINE, "theirs")


def test_metadata_without_an_environment_need_the_domain(made: Path) -> None:
    edit(made, env_spec=None)
    assert cudc_bench.import_minari(MINE, "theirs", "walker") == "walker/theirs-v0"
    assert "--domain walker" in read_manifest("walker/theirs-v0").command


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (f"{MINE} --method mine", "'walker/mine-v0' itself would be replaced; give --dataset-id or another --method."),
        (f"{MINE} --method theirs --domain jaco", "was recorded in 'walker', not in 'jaco'; leave out --domain."),
        (f"{MINE} --method theirs --task wlak", "unknown walker task 'wlak'"),
        (f"{MINE} --method a,b", "--method takes one here, since a dataset is one collection; import others separately."),
        (f"{MINE} --method Theirs!", "the method cannot be 'Theirs!'"),
        ("walker/none-v0 --method theirs", "there is no dataset 'walker/none-v0'"),
        ("../mine-v0 --method theirs", "'../mine-v0' is not the id of a Minari dataset"),
    ],
)
def test_wrong_input_is_refused_in_one_line(options: str, message: str, made: Path, capfd: pytest.CaptureFixture[str]) -> None:
    before = everything(made)
    with pytest.raises(SystemExit) as ended:
        main(["import-minari", *options.split()])
    out, err = capfd.readouterr()
    assert (ended.value.code, out, len(err.splitlines())) == (2, "", 1)
    assert message in err
    assert everything(made) == before


def test_what_is_ours_already_is_told_so_and_what_is_not_how_to_bring_it_in(made: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UsageError, match=f"cudc-bench import-minari {MINE} --method NAME"):
        cudc_bench.relabel(MINE)
    with pytest.raises(SystemExit) as ended:
        main(["import-minari", MINE, "--method", "theirs"])
    assert (ended.value.code, capfd.readouterr().out) == (0, "walker/theirs-v0\n")
    with pytest.raises(UsageError, match="is a dataset of cudc-bench already"):
        cudc_bench.import_minari("walker/theirs-v0", "again")
