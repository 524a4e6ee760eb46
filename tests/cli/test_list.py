"""``cudc-bench list``: filters, sizes, JSON, widths, and how little it loads."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cudc_bench import plugins
from cudc_bench.artefacts.ids import parse_id
from cudc_bench.artefacts.manifest import read_manifest
from cudc_bench.cli.documents import Listing
from cudc_bench.data.staging import building_path

TASKS = ("stand", "walk", "run", "flip")
BASE = "walker/cudc-smoke-v0"


def document(here: Callable, *options: str) -> dict[str, Any]:
    done = here(["list", "--json", *options])
    assert (done.code, done.err) == (0, "")
    found: dict[str, Any] = json.loads(done.out)
    assert Listing.model_validate(found)
    return found


def ids(found: dict[str, Any]) -> list[str]:
    return [one["id"] for one in found["datasets"]]


def test_a_script_gets_all_that_there_is_and_nothing_else(here: Callable, smoke: Path) -> None:
    building = building_path(parse_id("walker/icm-v0"))
    building.mkdir()
    (building / "shard").write_bytes(b"12345")
    found = document(here)
    assert [one["name"] for one in found["methods"]] == plugins.names("collectors")
    assert {one["name"]: one["same_as"] for one in found["methods"]}["cudc-stopgrad"] == "cudc"
    assert {one["name"]: one["category"] for one in found["methods"]}["cic"] == "competence"
    assert [one["name"] for one in found["algorithms"]] == plugins.names("evaluators")
    assert {one["category"] for one in found["algorithms"]} == {None}
    assert found["domains"][0]["tasks"] == list(TASKS)
    assert found["records"] == {"folder": "results", "records": 0, "references": 0}
    assert found["unfinished"] == [{"id": "walker/icm-v0", "holder": None, "step": None, "bytes": 5}]
    sizes = {one["id"]: one["bytes"] for one in found["datasets"]}
    assert sizes == {one: sum(file.stat().st_size for file in (smoke / one).rglob("*") if file.is_file()) for one in sizes}
    assert found["bytes"] == sum(sizes.values()) + 5
    walk = next(one for one in found["datasets"] if one["id"] == "walker/walk/cudc-smoke-v0")
    manifest = read_manifest("walker/walk/cudc-smoke-v0")
    assert (walk["task"], walk["base"], walk["linked"], walk["fingerprint"]) == ("walk", BASE, True, manifest.fingerprint)
    text = " ".join(here(["list"]).out.split())
    assert f"5 datasets, {sum(sizes.values()) / 1e3:,.0f} kB on disk; unfinished: 1, 0 kB" in text


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--task", "none"], [BASE]),
        (["--task", "walk,run"], ["walker/run/cudc-smoke-v0", "walker/walk/cudc-smoke-v0"]),
        (["--method", "cudc", "--seed", "1-3", "--task", "flip"], ["walker/flip/cudc-smoke-v0"]),
        (["--method", "icm"], []),
        (["--seed", "2"], []),
        (["--profile", "smoke", "--domain", "walker", "--task", "none,stand"], [BASE, "walker/stand/cudc-smoke-v0"]),
        (["--profile", "cpu"], []),
        (["--domain", "quadruped,jaco"], []),
        (["--domain", "dm_control/cheetah-run"], []),
    ],
)
def test_filters_choose_datasets(options: list[str], expected: list[str], here: Callable, smoke: Path) -> None:
    found = document(here, *options)
    assert ids(found) == expected
    assert {name for name, value in found.items() if value is None} == {
        "methods", "domains", "algorithms", "profiles", "records", "unfinished",
    }  # fmt: skip
    shown = here(["list", *options])
    assert (shown.code, shown.err) == (0, "")
    assert all(one in shown.out for one in expected)
    assert f"{len(expected)} dataset{'' if len(expected) == 1 else 's'}, " in shown.out
    assert "Collectors" not in shown.out


def test_kinds_choose_sections(here: Callable, smoke: Path) -> None:
    found = document(here, "--kind", "profiles,records")
    assert [one["name"] for one in found["profiles"]] == ["paper", "cpu", "demo", "smoke"]
    assert found["datasets"] is found["methods"] is found["bytes"] is None
    assert here(["list", "--kind", "profiles"]).out.splitlines()[0] == "Profiles (--profile; auto is paper with CUDA, cpu without)"


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--method", "cudk"], "unknown method 'cudk'; allowed: aps, "),
        (["--task", "wlak"], "unknown task 'wlak'; allowed: flip, jump, none, "),
        (["--domain", "wlaker"], "Did you mean 'walker'?"),
        (["--profile", "smoek"], "unknown profile 'smoek'; allowed: cpu, demo, imported, paper, smoke."),
        (["--seed", "x"], "--seed cannot be 'x'"),
        (["--method", ","], "--method is empty"),
        (["--kind", "nothing"], "unknown kind 'nothing'; allowed: algorithms, datasets, "),
        (["--kind", "methods", "--seed", "1"], "--kind methods has no datasets"),
    ],
)
def test_wrong_filters_are_refused_in_one_line(options: list[str], says: str, here: Callable, smoke: Path) -> None:
    for more in ([], ["--json"]):
        done = here(["list", *options, *more])
        assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
        assert says in done.err


@pytest.mark.parametrize("columns", [60, 80])
def test_narrow_terminals_lose_nothing(columns: int, here: Callable, smoke: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    out = here(["list"]).out
    lines = [line for line in out.splitlines() if not line.startswith(("Datasets in", "Records in", "Unfinished"))]
    assert max(map(len, lines)) <= columns
    words = out.replace(",", " ").split()
    for name in (*plugins.names("collectors"), *plugins.names("evaluators"), BASE, *(f"walker/{task}/cudc-smoke-v0" for task in TASKS)):
        assert name in words


def test_it_loads_no_torch(python: Callable, smoke: Path) -> None:
    script = """
import sys
from cudc_bench.cli.app import main
try:
    main(["list"])
finally:
    print(sorted({name.split(".")[0] for name in sys.modules} & {"torch", "mujoco", "dm_control", "minari"}), file=sys.stderr)
"""
    done = python(script)
    assert (done.code, done.err) == (0, "[]\n")
