"""Datasets behind a leaderboard: which records share one, which are here, and what is measured of these, once."""

from __future__ import annotations

import html
import json
import re

import pytest

import cudc_bench
from cudc_bench.artefacts.again import base_id, commands_from_nothing
from cudc_bench.artefacts.manifest import read_manifest
from cudc_bench.artefacts.provenance import is_own_command
from cudc_bench.leaderboard.api import make_leaderboard
from cudc_bench.leaderboard.datasets.behind import Local, datasets_of
from cudc_bench.leaderboard.datasets.diagnostics import diagnostics_path
from cudc_bench.leaderboard.datasets.pair import PairSummary, SideSummary
from cudc_bench.leaderboard.numbers.table import build_tables
from cudc_bench.leaderboard.output import measured as site_datasets
from cudc_bench.leaderboard.output.measured import find_local
from cudc_bench.leaderboard.site.catalogue import Catalogue
from cudc_bench.leaderboard.site.figures import collection
from cudc_bench.leaderboard.site.parts import Site


def of(*records):
    return datasets_of(build_tables(records)[0])


@pytest.fixture
def local(smoke, make_record):
    """Records of the collected dataset's tasks walk and run."""

    def records(**changes):
        return [
            make_record(task=task, dataset_id=f"walker/{task}/cudc-smoke-v0", dataset_profile="smoke", profile="smoke",
                        dataset_fingerprint=read_manifest(f"walker/{task}/cudc-smoke-v0").fingerprint, **changes)
            for task in ("walk", "run")
        ]  # fmt: skip

    return records


@pytest.mark.parametrize(
    ("one", "base"),
    [("walker/walk/cudc-v0", "walker/cudc-v0"), ("dm_control/cheetah_run/walk/cudc-v0", "dm_control/cheetah_run/cudc-v0"),
     ("walker/mine-v3", "walker/mine-v3"), ("walk/mine-v3", None), ("../walk/x-v0", None), ("", None)],
)  # fmt: skip
def test_the_collected_dataset_of_a_labelled_one(make_record, one, base):
    # A namespace that is the task alone leaves none for the base: the dataset is its own.
    assert base_id(make_record(task="walk", dataset_id=one).dataset) == (base if one != "walk/mine-v3" else one)


def test_tasks_and_algorithms_share_a_dataset_and_settings_do_not(make_record):
    same = [make_record(task=task, algorithm=algorithm) for task in ("walk", "run") for algorithm in ("td3", "cql")]
    others = [make_record(seed=2), make_record(dataset_overrides={"steps": 5}), make_record(dataset_profile="demo", profile="demo")]
    found = of(*same, *others)
    assert sorted(len(one.records) for one in found) == [1, 1, 1, 4]
    assert len({one.slug for one in found}) == 4
    (shared,) = [one for one in found if len(one.records) == 4]
    assert [(task, one) for task, one, _ in shared.labelled] == [
        ("run", "walker/run/cudc-seed1-v0"),
        ("walk", "walker/walk/cudc-seed1-v0"),
    ]


def test_commands_make_it_again_under_its_own_name(make_record):
    (plain,) = of(make_record(dataset_id="walker/walk/cudc-v0"))
    assert plain.commands[0] == ("Collect it", "cudc-bench collect --domain walker --method cudc --seed 1 --profile cpu")
    (named,) = of(make_record(dataset_id="walker/walk/mine-v7", dataset_overrides={"k": [1, 2], "note": "$(reboot); <b>"}))
    collect, label = (command for _, command in named.commands)
    assert "--dataset-id walker/mine-v7" in collect
    assert label == "cudc-bench relabel walker/mine-v7"
    assert all(is_own_command(command) for command in (collect, label))
    assert of(make_record(dataset_id="; reboot"))[0].commands == []


def test_a_run_on_a_dataset_with_settings_of_its_own_names_every_command(make_record, save, tmp_path):
    own = "cudc-bench evaluate --algo td3 --profile cpu --dataset-id walker/walk/cudc-v0 --overwrite"
    record = make_record(dataset_id="walker/walk/cudc-v0", dataset_overrides={"steps": 5}, command=own)
    make_leaderboard(save(record), tmp_path / "report", datasets=False)
    (page,) = (tmp_path / "report").rglob("runs-walk.cudc.html")
    commands = [html.unescape(one) for one in re.findall(r"<pre[^>]*>(.*?)</pre>", page.read_text())]
    assert commands == commands_from_nothing(record)
    assert [command.split()[1] for command in commands] == ["collect", "relabel", "evaluate"]
    assert all(is_own_command(command) for command in commands)


def test_a_dataset_that_is_here_is_measured(local, tmp_path):
    (dataset,) = of(*local())
    found, remarks = find_local([dataset], tmp_path)
    assert remarks == []
    one = found[dataset.slug]
    assert (one.id, one.manifest) == ("walker/cudc-smoke-v0", read_manifest("walker/cudc-smoke-v0"))
    # Episodes are equally long, so that the mean over trajectories is that over steps; rewards were computed when it was labelled.
    for task in ("stand", "walk", "run", "flip"):
        expected = cudc_bench.load_transitions(f"walker/{task}/cudc-smoke-v0").rewards.mean()
        assert one.quality.rewards[task].mean == pytest.approx(expected, rel=1e-5)
    assert one.quality.coverage.coverage_cells == cudc_bench.coverage("walker/cudc-smoke-v0").coverage_cells
    assert set(collection(one.collection)) == {"k", "losses", "representation"}


def test_what_was_measured_is_kept_until_something_changes(local, tmp_path, monkeypatch):
    (dataset,) = of(*local())
    output = tmp_path / "report"
    first, _ = find_local([dataset], output)
    kept = (output / "datasets" / "measures.json").read_bytes()
    calls = []
    measure = site_datasets.measure
    monkeypatch.setattr(site_datasets, "measure", lambda *a: calls.append("measured") or measure(*a))
    again, _ = find_local([dataset], output)
    assert calls == []
    assert again == first
    assert (output / "datasets" / "measures.json").read_bytes() == kept
    # A damaged file of measures is made again; changed diagnostics are drawn and not measured.
    (output / "datasets" / "measures.json").write_text('{"measures": {"x": 1}}')
    assert find_local([dataset], output)[0] == first
    assert calls == ["measured"]
    with diagnostics_path(again[dataset.slug].id).open("a") as file:
        file.write("\n")
    assert find_local([dataset], output)[0][dataset.slug].digest != first[dataset.slug].digest
    assert calls == ["measured"]


@pytest.mark.parametrize("changed", [{"dataset_fingerprint": "b" * 64}, {"dataset_id": "walker/walk/gone-v0"}, {"dataset_id": "../../x"}])
def test_only_the_very_data_of_the_records_are_measured(smoke, make_record, tmp_path, changed):
    fingerprint = read_manifest("walker/walk/cudc-smoke-v0").fingerprint
    here = {"dataset_id": "walker/walk/cudc-smoke-v0", "dataset_fingerprint": fingerprint}
    assert find_local(of(make_record(**here | changed)), tmp_path) == ({}, [])


def test_a_damaged_dataset_is_a_line_and_stops_nothing(local, smoke, tmp_path):
    path = smoke / "walker" / "cudc-smoke-v0" / "data" / "main_data.hdf5"
    path.write_bytes(path.read_bytes()[:5000])
    found, remarks = find_local(of(*local()), tmp_path)
    assert found == {}
    assert len(remarks) == 1
    assert "walker/cudc-smoke-v0" in remarks[0]


def test_its_page_shows_what_was_measured(local, save, tmp_path):
    output = tmp_path / "report"
    report = make_leaderboard(save(*local()), output)
    (dataset,) = datasets_of(report.tables)
    page = (output / "datasets" / f"{dataset.slug}.html").read_text()
    for name in ("Density of the rewards", "k over environment steps", "Losses of the collector", "What shows whether"):
        assert f'aria-label="{name}' in page
    assert page.count('<svg class="plot"') > 4 + 1
    assert "was not measured" not in page
    manifest = read_manifest("walker/cudc-smoke-v0")
    assert manifest.created in page
    measures = json.loads((output / "datasets" / "measures.json").read_text())["measures"]
    assert set(measures) == {manifest.fingerprint}
    assert str(tmp_path) not in page
    before = {file: file.read_bytes() for file in report.files}
    assert {file: file.read_bytes() for file in make_leaderboard(tmp_path / "results", output).files} == before


@pytest.mark.parametrize("same", [True, False])
def test_a_dataset_leads_to_what_its_very_data_were_compared_in(local, same):
    tables = build_tables(local())[0]
    (dataset,) = datasets_of(tables)
    here = Local("walker/cudc-smoke-v0", read_manifest("walker/cudc-smoke-v0"), None)
    sides = [
        SideSummary(id=one, fingerprint=fingerprint, method="cudc", seed=1, steps=3000, rewards={})
        for one, fingerprint in (("walker/gone-v0", "a" * 64), (here.id, here.manifest.fingerprint if same else "b" * 64))
    ]
    pair = PairSummary(quantities=("x", "y"), shared=0.5, sides=tuple(sides))
    site = Catalogue(Site(tables, [], local={dataset.slug: here}, pairs=[pair]))
    lines = [line for section in site.dataset(dataset).sections if section.title == "Side by side" for line in section.lines]
    page = f"{pair.slug}/index.html"
    assert [line.link for line in lines] == ([page] if same else [])
    heads = [row.head.link for row in site.pair(pair).sections[0].grids[0].lines]
    assert heads == [None, f"datasets/{dataset.slug}.html" if same else None]
    assert [line.link for section in site.datasets_page().sections for line in section.lines] == [page]
