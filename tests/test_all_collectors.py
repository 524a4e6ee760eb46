"""Every registered collector through the whole chain, as users call it: collect, relabel, evaluate, leaderboard, verify."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import minari
import numpy as np

import cudc_bench
from cudc_bench import plugins
from cudc_bench.manifest import read_manifest
from cudc_bench.records import read_record

OURS = {"aps", "apt", "be", "cic", "cudc", "diayn", "disagreement", "icm", "proto", "random", "rnd", "smm"}
SKILLS = {"aps": 10, "cic": 64, "diayn": 16, "smm": 4}


def test_the_whole_chain(cli: Callable, datasets: Path, tmp_path: Path) -> None:
    names = plugins.names("collectors")
    assert set(names) >= OURS
    done = cli("evaluate", "--method", ",".join(names), "--tasks", "walk", "--workers", "1")
    assert done.code == 0, done.err
    records = [read_record(tmp_path / line) for line in done.out.split()]
    assert [record.dataset.method for record in records] == list(names)
    report = cudc_bench.make_leaderboard(tmp_path / "results", tmp_path / "report", profile="smoke")
    (table,) = report.tables
    assert set(table.methods) == set(names)
    for name in names:
        dataset = minari.load_dataset(f"walker/{name}-v0")
        manifest = read_manifest(f"walker/{name}-v0")
        assert dataset.total_steps == manifest.steps == 3000
        skills = [episode.infos.get("skill") for episode in dataset.iterate_episodes()]
        if name in SKILLS:
            assert manifest.fields.keys() == read_manifest(f"walker/walk/{name}-v0").fields.keys()
            assert all(skill.shape == (1001, SKILLS[name]) and skill.dtype == np.float32 for skill in skills)
        elif name in OURS:
            assert skills == [None] * 3
    ids = [one for name in names for one in (f"walker/{name}-v0", f"walker/walk/{name}-v0")]
    done = cli("verify", *ids, "--sample", "1000")
    assert done.code == 0, done.err


def test_methods_differ_from_one_another(cli: Callable, datasets: Path) -> None:
    names = [name for name in plugins.names("collectors") if name in OURS]
    done = cli("collect", "--method", ",".join(names))
    assert done.code == 0, done.err
    prints = {name: read_manifest(f"walker/{name}-v0").fingerprint for name in names}
    assert len(set(prints.values())) == len(names)
    listed = cli("list").out
    for name in names:
        kind = plugins.load("collectors", name)
        assert name in listed
        assert kind.family.split()[0] in listed
        assert kind.citation.split()[0] in listed
