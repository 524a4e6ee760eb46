"""Every registered collector through the whole chain, as users call it: collect, relabel, evaluate, leaderboard, verify."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import minari
import numpy as np
import pytest

import cudc_bench
from cudc_bench import plugins
from cudc_bench.artefacts.manifest import read_manifest
from cudc_bench.artefacts.records import read_record

from .served import briefly

OURS = {"aps", "apt", "be", "cic", "ctec", "cudc", "diayn", "disagreement", "icm", "metra", "moss", "proto", "random", "rnd", "smm"}
STUDIED = {
    "cudc-vary-icm", "cudc-vary-apt", "cudc-reward", "cudc-reach", "cudc-no-entropy", "cudc-no-pe", "cudc-no-regularize", "cudc-no-vary",
    "cudc-no-reach", "cudc-no-inverse", "cudc-uniform-k", "cudc-normal-k", "cudc-kmax3", "cudc-kmax4", "cudc-kmax5", "cudc-kmax6",
    "cudc-kmax7", "cudc-kmax8", "cudc-one-setting", "cudc-live", "cudc-stopgrad", "cudc-momentum",
    "cudc-literal", "cudc-kmix", "apt-k6", "apt-ksched",
}  # fmt: skip
# Names whose datasets on Walker are the same: aliases, and what one setting for all domains is there (see collectors/variants.py).
SAME = {
    "cudc-no-regularize": "cudc-reach", "cudc-kmax3": "cudc-no-vary", "cudc-kmax6": "cudc", "cudc-stopgrad": "cudc",
    "cudc-one-setting": "cudc",
}  # fmt: skip
SKILLS = {"aps": 10, "cic": 64, "diayn": 16, "metra": 4, "moss": 32, "smm": 4}


NAMES = plugins.names("collectors")
# The chain after a collection knows nothing of a method but its name, its skills, whether it learns and whether it is a study's: those
# with skills, two without, and of the studied ones CUDC's own alias, one that needs a pilot, and one with code of its own go through all of
# it, and whatever else is installed. All are collected below.
CHAINED = [
    name for name in NAMES if name in {*SKILLS, "random", "cudc", "cudc-kmax6", "cudc-vary-icm", "apt-ksched"} or name not in OURS | STUDIED
]
# One evaluation of one episode, before training and at its end.
SHORT = {"evaluate_every": "20", "milestones": "[20]", "evaluation_episodes": "1", "final_episodes": "1"}


def test_all_are_registered() -> None:
    assert set(NAMES) >= OURS | STUDIED


@pytest.mark.parametrize("name", CHAINED)
def test_the_whole_chain(name: str, tmp_path: Path) -> None:
    cudc_bench.relabel(*cudc_bench.collect(name, profile="smoke"), ["walk"])
    with briefly():
        (path,) = cudc_bench.evaluate(
            methods=[name], tasks=["walk"], profile="smoke", output=tmp_path / "results", steps=20, settings=SHORT
        )
    assert read_record(Path(path)).dataset.method == name
    report = cudc_bench.make_leaderboard(tmp_path / "results", None)
    if name in STUDIED:
        # Main tables have none of these, but for the one that is CUDC itself.
        assert [table.methods for table in report.tables] == ([("cudc",)] if name == "cudc-kmax6" else [])
        assert {line.labels[0] for study in report.studies for line in study.tables[-1].parts[0].lines} >= {name}
    else:
        assert [table.methods for table in report.tables] == [(name,)]
        assert len(report.tables[0].cells) == 1  # one task at one milestone
    ids = (f"walker/{name}-smoke-v0", f"walker/walk/{name}-smoke-v0")
    unlabelled, labelled = (read_manifest(one) for one in ids)
    dataset = minari.load_dataset(ids[0])
    assert dataset.total_steps == unlabelled.steps == 3000
    skills = [episode.infos.get("skill") for episode in dataset.iterate_episodes()]
    if name in SKILLS:
        assert unlabelled.fields.keys() == labelled.fields.keys()
        assert all(skill.shape == (1001, SKILLS[name]) and skill.dtype == np.float32 for skill in skills)
    elif name in OURS | STUDIED:
        assert skills == [None] * 3
    for one in ids:
        cudc_bench.verify(one, sample=1000)


def test_several_methods_in_one_command(cli: Callable, datasets: Path, tmp_path: Path) -> None:
    names = ["cudc-no-vary", "diayn", "random"]
    short = [word for name, value in SHORT.items() for word in ("--set", f"{name}={value}")]
    done = cli("evaluate", "--method", ",".join(names), "--tasks", "walk", "--workers", "1", "--steps", "20", *short)
    assert done.code == 0, done.err
    done = cli("leaderboard")
    assert done.code == 0, done.err
    assert all(name in done.out for name in names)
    done = cli("verify", *(one for name in names for one in (f"walker/{name}-smoke-v0", f"walker/walk/{name}-smoke-v0")), "--sample", "100")
    assert done.code == 0, done.err


def test_methods_differ_from_one_another(cli: Callable, datasets: Path) -> None:
    names = [name for name in NAMES if name in OURS | STUDIED]
    for name in names:
        # Long enough for a scheduled k to have grown (at 1,350 steps), and for actions to have followed from that.
        kind = plugins.load("collectors", name)
        settings = {"steps": 1500} | ({"seed_steps": 1000, "update_every": 25} if kind.learns else {})
        if (threshold := kind.measured_by_pilot(kind.configure("walker"))) is not None:
            settings[threshold] = 0.5
        cudc_bench.collect(name, profile="smoke", settings=settings)
    manifests = {name: read_manifest(f"walker/{name}-smoke-v0") for name in names}
    prints = {name: manifest.fingerprint for name, manifest in manifests.items()}
    for name, other in SAME.items():
        assert prints.pop(name) == prints[other]
        same_values = manifests[name].hyperparameters_hash == manifests[other].hyperparameters_hash
        assert same_values == (name != "cudc-one-setting")
    assert len(set(prints.values())) == len(prints)
    listed = cli("list").out
    for name in names:
        kind = plugins.load("collectors", name)
        assert name in listed
        assert kind.family.split()[0] in listed
        assert kind.citation.split()[0] in listed
