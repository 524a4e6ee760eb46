"""Mixtures: which episodes they have, that these are their parts' own, and that all who read manifests know what a mixture is."""

from __future__ import annotations

import json
import shutil
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import minari
import numpy as np
import pytest

import cudc_bench
from cudc_bench.artefacts.again import commands_from_nothing
from cudc_bench.artefacts.manifest import KEY, Manifest, read_manifest
from cudc_bench.artefacts.records import read_record
from cudc_bench.cli.app import main
from cudc_bench.data.deletion import plan_deletion
from cudc_bench.data.mixing import draw_episodes
from cudc_bench.errors import RunError, UsageError
from cudc_bench.leaderboard.intake.load import load_records
from cudc_bench.leaderboard.numbers.columns import column, is_own
from cudc_bench.stages import check_profile

# At the smoke profile: two whole episodes and a part of one; of the last one three whole ones.
A, B, SKILLED = "jaco/random-smoke-v0", "jaco/random-smoke-seed2-v0", "jaco/diayn-smoke-v0"
MIXED, LABELLED = "jaco/mixture-smoke-v0", "jaco/reach_top_left/mixture-smoke-v0"
SHORT = {"gradient_steps": 4, "evaluate_every": 2, "milestones": [2, 4], "final_episodes": 1, "final_evaluations": 1}
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


@pytest.fixture(scope="module")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A root with three collections, and a mixture of the first and the last at two episodes of each, labelled for a task."""
    root = tmp_path_factory.mktemp("mixed") / "datasets"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        cudc_bench.collect("random", "jaco", seeds=(1, 2), profile="smoke", settings={"steps": 550})
        cudc_bench.collect("diayn", "jaco", profile="smoke", settings={"steps": 750, "seed_steps": 500})
        assert cudc_bench.mix([A, SKILLED], 1000) == MIXED
        assert cudc_bench.relabel(MIXED, ["reach_top_left"]) == [LABELLED]
    return root


@pytest.fixture
def made(made_once: Path, datasets: Path) -> Path:
    shutil.copytree(made_once, datasets)
    return datasets


def drawn(whole: int, count: int, seed: int, fingerprint: str) -> list[int]:
    """The same by NumPy alone."""
    sequence = np.random.SeedSequence(entropy=seed, spawn_key=(zlib.crc32(b"mixture"), int(fingerprint, 16)))
    state = int(sequence.generate_state(1, np.uint64)[0]) // 2
    return np.random.default_rng(state).permutation(np.arange(whole))[:count].tolist()


def test_equal_parts_of_whole_episodes_take_turns(made: Path) -> None:
    manifest = read_manifest(MIXED)
    assert (manifest.method, manifest.label, manifest.task, manifest.profile) == ("mixture", "mixture (diayn, random)", None, "smoke")
    assert (manifest.steps, manifest.episodes) == (1000, 4)
    assert manifest.mixture is not None
    assert [part.id for part in manifest.mixture.parts] == [A, SKILLED]
    for part, whole in zip(manifest.mixture.parts, (2, 3), strict=True):
        source = read_manifest(part.id)
        assert part.episodes == drawn(whole, 2, 1, source.fingerprint)
        kept = (part.fingerprint, part.method, part.seed, part.profile, part.hyperparameters, part.collected.machine)
        assert kept == (source.fingerprint, source.method, 1, "smoke", source.hyperparameters, source.machine)
    sources = {one: list(minari.load_dataset(one)) for one in (A, SKILLED)}
    first, last = manifest.mixture.parts
    order = [(first, 0), (last, 0), (first, 1), (last, 1)]
    mixed = minari.load_dataset(MIXED)
    assert mixed.spec.combined_datasets == [A, SKILLED]
    for episode, (part, number) in zip(mixed, order, strict=True):
        original = sources[part.id][part.episodes[number]]
        assert len(episode.actions) == 250
        for name in ("observations", "actions"):
            assert getattr(episode, name).tobytes() == getattr(original, name).tobytes()
        assert episode.infos["physics"].tobytes() == original.infos["physics"].tobytes()
        assert episode.truncations[-1]
        assert not episode.rewards.any()
    # Only one part has skills.
    assert set(sources[SKILLED][0].infos) == {"physics", "skill"}
    assert (manifest.mixture.ignored, "infos/skill" in manifest.fields) == (["skill"], False)


def test_which_episodes_they_are_depends_on_the_seed_and_each_part_alone(made: Path) -> None:
    def episodes(one: str) -> dict[str, list[int]]:
        mixture = read_manifest(one).mixture
        assert mixture is not None
        return {part.id: part.episodes for part in mixture.parts}

    before = read_manifest(MIXED)
    assert cudc_bench.mix([SKILLED, A], 1000, dataset_id="jaco/turned-v0") == "jaco/turned-v0"
    assert episodes("jaco/turned-v0") == episodes(MIXED)
    three = episodes(cudc_bench.mix([A, SKILLED, B], 750, dataset_id="jaco/three-v0"))
    assert {one: three[one] for one in (A, SKILLED)} == {one: found[:1] for one, found in episodes(MIXED).items()}
    cudc_bench.mix([A, SKILLED], 1000, dataset_id="jaco/again-v0")
    assert read_manifest("jaco/again-v0").fingerprint == before.fingerprint
    # What is there of the very same parts is kept; what is of others is not replaced.
    cudc_bench.mix([A, SKILLED], 1000)
    assert read_manifest(MIXED) == before
    with pytest.raises(UsageError, match=f"'{MIXED}' exists .*, profile smoke, seed 1, 1,000 steps.; use --overwrite"):
        cudc_bench.mix([A, B], 1000)


def test_draws_of_other_seeds_and_parts_differ() -> None:
    fingerprints = ["ab" * 32, "cd" * 32]
    draws = {(seed, one): draw_episodes(range(500), 250, seed, one) for seed in (1, 2) for one in fingerprints}
    for (seed, one), found in draws.items():
        assert found == drawn(500, 250, seed, one)
        assert len(set(found)) == 250
    assert len({tuple(found) for found in draws.values()}) == 4


def test_a_mixture_is_as_large_as_its_smallest_part(made: Path, capfd: pytest.CaptureFixture[str]) -> None:
    one = cudc_bench.mix([A, SKILLED], dataset_id="jaco/small-v0")
    manifest, said = read_manifest(one), capfd.readouterr().err
    assert (manifest.steps, manifest.hyperparameters["steps"]) == (500, 550)
    assert "250 steps of each (550 are not 2 parts of whole episodes of 250)" in said
    assert "left out, since not all parts have them in one form: infos/skill" in said
    # Its size, and the settings of its parts, keep it from tables of the profile.
    assert manifest.overrides == {"steps": 550, "random.steps": 550, "diayn.steps": 750, "diayn.seed_steps": 500}
    assert manifest.command == f"cudc-bench mix {A} {SKILLED} --steps 550 --seed 1 --dataset-id jaco/small-v0"


def test_it_is_proven_with_its_parts_and_without_them(made: Path) -> None:
    for one, sample, repeated in ((MIXED, None, 4), (LABELLED, 1, 1)):
        found = cudc_bench.verify(one, sample=sample)
        checks = {check.name: check.detail for check in found.checks}
        assert checks["seeds"] == "4, each that of its part's seed for its episode there"
        assert checks["mixture"] == "4 of 4 episodes equal those of the parts that are here, as its seed draws them"
        assert f"{repeated} episodes repeated from their seeds bit for bit" in checks["simulation"]
    # Measured while it was mixed, of the same states.
    assert cudc_bench.coverage(MIXED).as_row() == read_manifest(MIXED).diagnostics
    shutil.rmtree(made / A)
    found = cudc_bench.verify(MIXED, sample=1)
    assert "2 of 4 episodes are those that its seed draws of its parts" in found.proven
    assert f"that its other episodes are those of {A}: not here with the fingerprints that it names" in found.unproven


def changed(root: Path, one: str, change: Callable[[dict[str, Any]], None]) -> None:
    """Change a dataset's manifest."""
    path = root / one / "data" / "metadata.json"
    metadata = json.loads(path.read_text())
    change(metadata[KEY])
    Manifest.model_validate(metadata[KEY])
    path.write_text(json.dumps(metadata))


def parts_of(manifest: dict[str, Any]) -> list[dict[str, Any]]:
    return manifest["mixture"]["parts"]


LIES: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "other seed": (lambda m: m.update(seed=2), "its command says --seed 1, and it has 2"),
    "other order": (lambda m: parts_of(m)[0]["episodes"].reverse(), r"check 'seeds' in episode 0: the stored seed is \d+, but the seed of"),
    "other parts": (lambda m: parts_of(m).reverse(), "Minari's metadata have combined_datasets"),
    "other name": (lambda m: parts_of(m)[0].update(id=B), "Minari's metadata have combined_datasets"),
    "other command": (lambda m: m.update(command=m["command"].replace(A, B)), "its command does not name its parts"),
    "other size": (lambda m: m.update(command=m["command"].replace("1000", "1001")), "its command says --steps 1001, and it has 1000"),
    "other collector's seed": (lambda m: parts_of(m)[1].update(seed=3), "check 'seeds' in episode 1"),
    "uneven": (lambda m: parts_of(m)[0]["episodes"].append(0), "not equally many different episodes, but 3, 2"),
    "twice": (lambda m: parts_of(m)[0].update(episodes=[1, 1]), "not equally many different episodes"),
    "fewer": (lambda m: [one.update(episodes=one["episodes"][:1]) for one in parts_of(m)], "its parts have 2 episodes of 250 steps"),
    "part twice": (lambda m: parts_of(m)[0].update(fingerprint=parts_of(m)[1]["fingerprint"]), "one of its parts is there twice"),
}  # fmt: skip


@pytest.mark.parametrize("lie", LIES)
def test_a_manifest_that_says_otherwise_is_found(lie: str, made: Path) -> None:
    change, message = LIES[lie]
    changed(made, MIXED, change)
    with pytest.raises(RunError, match=message):
        cudc_bench.verify(MIXED)


def test_episodes_that_are_not_its_parts_are_found(made: Path) -> None:
    """As whoever changes the arrays would do it: with the hashes of the change."""
    with h5py.File(made / MIXED / "data" / "main_data.hdf5", "a") as file:
        file["episode_1/actions"][7, 2] += 0.25 if file["episode_1/actions"][7, 2] < 0 else -0.25
    hasher = cudc_bench.artefacts.manifest.FieldHasher()
    for episode in minari.load_dataset(MIXED):
        hasher.update("actions", episode.actions)

    def rehash(manifest: dict[str, Any]) -> None:
        manifest["fields"] |= hasher.digests()
        manifest["fingerprint"] = cudc_bench.artefacts.manifest.fingerprint(manifest["fields"])

    changed(made, MIXED, rehash)
    with pytest.raises(RunError, match=f"check 'mixture' in episode 1 at step 7: actions are not those of episode . of '{SKILLED}'"):
        cudc_bench.verify(MIXED)


def imported_as(root: Path, one: str, method: str) -> str:
    """A collection as others have it, without a manifest, imported."""
    theirs = root / "jaco" / f"{method}-theirs-v0"
    shutil.copytree(root / one, theirs)
    path = theirs / "data" / "metadata.json"
    metadata = json.loads(path.read_text())
    del metadata[KEY]
    path.write_text(json.dumps(metadata | {"dataset_id": f"jaco/{theirs.name}"}))
    return cudc_bench.import_minari(f"jaco/{theirs.name}", method, source="ExORL")


def test_imported_parts_have_no_seeds(made: Path) -> None:
    imported = imported_as(made, B, "proto")
    one = cudc_bench.mix([A, imported], 1000, 2)
    manifest = read_manifest(one)
    assert (one, manifest.label, manifest.profile) == ("jaco/mixture-smoke-seed2-v0", "mixture (proto (ExORL), random)", "smoke")
    with h5py.File(made / one / "data" / "main_data.hdf5") as file:
        assert ["seed" in file[f"episode_{index}"].attrs for index in range(4)] == [True, False, True, False]
    assert len(list(minari.load_dataset(one))) == 4
    found = cudc_bench.verify(one, sample=None)
    simulated = next(check.detail for check in found.checks if check.name == "simulation")
    assert "2 episodes repeated from their seeds bit for bit, 2 episodes step by step" in simulated
    card = (made / one / "README.md").read_text()
    assert "license: unknown" in card
    assert "It holds data of ExORL, whose terms apply" in card
    # Of others' data alone it goes with every profile.
    one = cudc_bench.mix([imported, imported_as(made, A, "icm")], 500)
    manifest = read_manifest(one)
    assert (one, manifest.profile, manifest.label) == ("jaco/mixture-v0", "imported", "mixture (icm (ExORL), proto (ExORL))")
    for profile in ("cpu", "smoke"):
        check_profile(manifest, one, profile)
    assert "seeds" not in {check.name for check in cudc_bench.verify(one, sample=1).checks}
    # The same data under another name.
    with pytest.raises(UsageError, match=f"'{imported_as(made, B, 'rnd')}' has the same data as '{imported}'"):
        cudc_bench.mix([imported, "jaco/rnd-v0"])


def test_a_record_names_the_parts_and_is_made_again_from_them(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    ours = cudc_bench.mix([A, B], 500, dataset_id="jaco/ours-v0")
    (labelled,) = cudc_bench.relabel(ours, ["reach_top_left"])
    (path,) = cudc_bench.evaluate("bc", dataset_id=labelled, profile="smoke", settings=SHORT, policies=False)
    record = read_record(path)
    assert [part.id for part in record.dataset.parts] == [A, B]
    assert (column(record), is_own(record), record.dataset.method) == ("mixture (random)", False, "mixture")
    assert commands_from_nothing(record) == [
        "cudc-bench collect --domain jaco --method random --seed 1 --profile smoke --set steps=550",
        "cudc-bench collect --domain jaco --method random --seed 2 --profile smoke --set steps=550",
        f"cudc-bench mix {A} {B} --steps 500 --seed 1 --dataset-id {ours}",
        f"cudc-bench relabel {ours} --task reach_top_left",
        record.command,
    ]
    assert load_records([path]).problems == ()
    shutil.rmtree(made)
    (found,) = cudc_bench.rerun(path, collect=True)
    assert (found.collected, found.differences) == (True, ())


def test_who_asks_for_what_only_collections_have_is_told_so(made: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=f"'{MIXED}' has no diagnostics: it was mixed of '{A}', '{SKILLED}', which have their own"):
        cudc_bench.draw_diagnostics(MIXED, output=tmp_path / "out")
    assert f"'{MIXED}' holds a copy of its own, and stays" in plan_deletion([A], False, tmp_path).remarks


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (A, "a mixture has two parts at least; name two datasets or more"),
        (f"{A} {A}", f"'{A}' was named twice; name it once."),
        (f"{A} {LABELLED}", f"is labelled for reach_top_left, and a mixture is of task-agnostic datasets; name its base '{MIXED}'"),
        (f"{A} {MIXED}", f"'{MIXED}' is a mixture itself; name its parts {A}, {SKILLED}."),
        (f"{A} jaco/none-v0", "there is no dataset 'jaco/none-v0'"),
        (f"{A} {B} --steps 499", "499 steps are too few for a mixture of these: 2 parts of whole episodes have 500 at least"),
        (f"{A} {SKILLED} --steps 1500", f"'{A}' has 2 whole episodes of 250 steps, and 3 are needed; --steps can be 1,000 at most."),
        (f"{A} {B} --dataset-id {B}", f"'{B}' itself would be replaced; give another --dataset-id."),
        (f"{A} {B} --seeds 1,2 --dataset-id jaco/x-v0", "--dataset-id names one dataset, but there are 2 seeds; leave it out."),
        (f"{A} Nonsense!", "is not a dataset id"),
    ],
)
def test_wrong_input_is_refused_in_one_line(options: str, message: str, made: Path, capfd: pytest.CaptureFixture[str]) -> None:
    before = sorted(made.rglob("*"))
    with pytest.raises(SystemExit) as ended:
        main(["mix", *options.split()])
    out, err = capfd.readouterr()
    assert (ended.value.code, out, len(err.splitlines())) == (2, "", 1)
    assert message in err
    assert sorted(made.rglob("*")) == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.update(domain="walker"), f"'{A}' is of jaco and '{B}' of walker; a mixture is of one domain."),
        (lambda m: m.update(profile="cpu"), f"'{A}' is of profile smoke and '{B}' of cpu; a mixture is of one profile."),
        (lambda m: m["fields"].pop("infos/physics"), f"'{B}' holds no physics states and others do: nothing could label the mixture"),
    ],
)
def test_datasets_that_do_not_go_together_are_refused(change: Callable[[dict[str, Any]], Any], message: str, made: Path) -> None:
    changed(made, B, change)
    with pytest.raises(UsageError, match=message):
        cudc_bench.mix([A, B])


def test_what_is_missing_is_not_taken_for_a_collector(datasets: Path) -> None:
    with pytest.raises(UsageError, match="there is no dataset 'jaco/mixture-smoke-v0'; make it of several: cudc-bench mix"):
        cudc_bench.evaluate("bc", "jaco", methods=["mixture"], profile="smoke")


def test_a_damaged_part_is_not_mixed(made: Path) -> None:
    with h5py.File(made / B / "data" / "main_data.hdf5", "a") as file:
        file["episode_0/observations"][3, 1] += 1e-3
    before = sorted(made.rglob("*"))
    with pytest.raises(RunError, match=f"'{B}' does not fit its fingerprint: observations changed"):
        cudc_bench.mix([A, B], seed=2)
    assert sorted(made.rglob("*")) == before
