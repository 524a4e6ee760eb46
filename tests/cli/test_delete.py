"""``cudc-bench delete``: what goes, what stays, and what it refuses to touch."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import minari
import pytest

import cudc_bench
from cudc_bench.artefacts.ids import dataset_path, parse_id
from cudc_bench.artefacts.manifest import metadata_path
from cudc_bench.cli import delete as command
from cudc_bench.data import staging as room
from cudc_bench.data.staging import building_path, staging
from cudc_bench.execution.locks import locked

from .test_cli import tree

BASE, WALK = "walker/cudc-smoke-v0", "walker/walk/cudc-smoke-v0"
LABELLED = [f"walker/{task}/cudc-smoke-v0" for task in ("flip", "run", "stand", "walk")]


def there() -> list[str]:
    return sorted(minari.list_local_datasets())


def test_a_labelled_dataset_goes_alone(here: Callable, smoke: Path) -> None:
    done = here(["delete", WALK, "--yes"])
    assert (done.code, done.out) == (0, f"{WALK}\n")
    assert done.err.startswith("deleted 1, ")
    assert there() == sorted([BASE, *LABELLED[:3]])
    assert not list(smoke.rglob(".*"))
    # The base is as it was, and can be labelled again.
    assert cudc_bench.relabel(BASE, tasks=["walk"]) == [WALK]


def test_a_base_goes_only_with_what_links_to_it(here: Callable, smoke: Path) -> None:
    before = tree(smoke)
    for words in ([BASE], [BASE, *LABELLED[1:]]):
        done = here(["delete", *words, "--yes"])
        assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
        assert f"'{BASE}' is what '{LABELLED[0]}'" in done.err
        assert "name" in done.err
        assert "or give --with-labelled." in done.err
        assert tree(smoke) == before
    done = here(["delete", BASE, "--with-labelled", "--yes"])
    # What links to it goes before it.
    assert (done.code, done.out.split()) == (0, [*LABELLED, BASE])
    assert there() == []


def test_named_together_they_go_in_the_order_that_leaves_no_link_into_nothing(here: Callable, smoke: Path) -> None:
    assert here(["delete", BASE, *LABELLED, "--yes"]).out.split() == [*LABELLED, BASE]


def test_a_copy_of_its_own_stays(here: Callable, smoke: Path) -> None:
    cudc_bench.relabel(BASE, tasks=["walk"], standalone=True, overwrite=True)
    assert here(["delete", *LABELLED[:3], "--yes"]).code == 0
    done = here(["delete", BASE, "--yes"])
    assert (done.code, done.out) == (0, f"{BASE}\n")
    assert f"note: '{WALK}' holds a copy of its own, and stays" in done.err
    assert cudc_bench.load_transitions(WALK, verify=True).rewards.any()


def test_a_dry_run_says_all_and_deletes_nothing(here: Callable, smoke: Path, tmp_path: Path) -> None:
    for name in (f"smoke/{WALK}/td3-seed1.json", f"submitted/ann/smoke/{WALK}/td3-seed1.json", "smoke/walker/walk/icm-v0/td3-seed1.json"):
        (tmp_path / "results" / name).parent.mkdir(parents=True)
        (tmp_path / "results" / name).write_text("{}")
    begun = tmp_path / "results/.checkpoints/stacks/td3-x"
    begun.mkdir(parents=True)
    (begun / "run.json").write_text(json.dumps({"datasets": {WALK: "0"}}))
    before = tree(smoke, tmp_path)
    done = here(["delete", WALK, "--dry-run"])
    assert (done.code, done.err) == (0, "")
    first, *notes = done.out.splitlines()
    assert first.startswith(f"{WALK}: cudc, profile smoke, seed 1, 3,000 steps, labelled for walk, ")
    assert notes == [
        "note: 2 records in results were made of them, and stay",
        "note: 1 interrupted training in results can go on only when the same data are there again",
    ]
    assert tree(smoke, tmp_path) == before


def test_nobody_is_asked_where_there_is_no_terminal(here: Callable, smoke: Path) -> None:
    done = here(["delete", WALK])
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert "nothing was deleted; give --yes" in done.err
    assert WALK in there()


@pytest.mark.parametrize(("answer", "code"), [(True, 0), (False, 1)])
def test_who_sits_at_a_terminal_is_asked(answer: bool, code: int, here: Callable, smoke: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def confirm(question: str, **_: Any) -> bool:
        asked.append(question)
        return answer

    monkeypatch.setattr(command, "_can_ask", lambda: True)
    monkeypatch.setattr(command.typer, "confirm", confirm)
    done = here(["delete", WALK])
    assert (done.code, WALK in there()) == (code, not answer)
    (question,) = asked
    assert question.startswith("Delete 1 dataset (")
    assert done.err.startswith(f"{WALK}: cudc, profile smoke, ")


def test_what_changed_while_somebody_thought_is_not_deleted(here: Callable, smoke: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def confirm(*_: Any, **__: Any) -> bool:
        cudc_bench.relabel(BASE, tasks=["walk"], overwrite=True, standalone=True)
        return True

    monkeypatch.setattr(command, "_can_ask", lambda: True)
    monkeypatch.setattr(command.typer, "confirm", confirm)
    done = here(["delete", WALK])
    assert done.code == 1
    assert "what is there has changed meanwhile: nothing was deleted" in done.err
    assert WALK in there()


def test_a_strangers_dataset_goes_only_by_its_id_and_that_is_said(here: Callable, smoke: Path) -> None:
    theirs = metadata_path("walker/run/theirs-v0")
    theirs.parent.mkdir(parents=True)
    theirs.write_text(json.dumps({"dataset_id": "walker/run/theirs-v0", "combined_datasets": [BASE]}))
    assert here(["delete", BASE, "--with-labelled", "--yes"]).code == 0
    assert theirs.exists()
    assert "walker/run/theirs-v0: not made by cudc-bench, " in here(["delete", "walker/run/theirs-v0", "--dry-run"]).out
    assert here(["delete", "walker/run/theirs-v0", "--yes"]).code == 0
    assert not theirs.exists()


def test_a_damaged_labelled_dataset_is_one_that_needs_its_base(here: Callable, smoke: Path) -> None:
    assert here(["delete", *LABELLED[:3], "--yes"]).code == 0
    content = json.loads(metadata_path(WALK).read_text())
    content["cudc_bench"]["steps"] = "many"
    metadata_path(WALK).write_text(json.dumps(content))
    done = here(["delete", BASE, "--yes"])
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert f"'{WALK}' links to" in done.err
    assert here(["delete", BASE, "--with-labelled", "--yes"]).out.split() == [WALK, BASE]


def test_of_a_link_only_the_link_goes(here: Callable, smoke: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    shutil.move(smoke / WALK, elsewhere)
    dataset_path(WALK).symlink_to(elsewhere)
    before = tree(elsewhere)
    assert f"{WALK}: a symbolic link to {elsewhere}, which stays, " in here(["delete", WALK, "--dry-run"]).out
    assert here(["delete", WALK, "--yes"]).code == 0
    assert not dataset_path(WALK).is_symlink()
    assert tree(elsewhere) == before


def test_what_somebody_is_at_work_on_stays(here: Callable, smoke: Path, tmp_path: Path) -> None:
    before = tree(smoke)

    def refused(says: str, *words: str) -> None:
        done = here(["delete", *words, "--yes"])
        assert (done.code, done.out, done.err.count("\n")) == (1, "", 1)
        assert says in done.err
        assert {path for path in tree(smoke) if path in before} == set(before)

    with staging(parse_id(WALK)):
        refused(f"is writing '{WALK}'; wait for it to end.", WALK)
        refused(f"is writing '{WALK}'; wait for it to end.", BASE, "--with-labelled")
    with staging(parse_id("walker/hop/cudc-smoke-v0")):
        refused(f"is labelling '{BASE}' as 'walker/hop/cudc-smoke-v0'", BASE, "--with-labelled")
    with locked(tmp_path / f"results/.checkpoints/smoke/{WALK}/td3-seed1.lock", "it"):
        refused(f"is training on '{WALK}'; wait for it to end, or stop it.", WALK)
        refused(f"is training on '{WALK}'; wait for it to end, or stop it.", BASE, "--with-labelled")
    note = tmp_path / f"results/.suite/datasets/{WALK}.json"
    note.parent.mkdir(parents=True)
    note.write_text("{}")
    with locked(tmp_path / "results/.suite/lock", "it"):
        refused(f"is running a suite that made '{WALK}'; wait for it to end, or stop it.", WALK)
    assert tree(smoke) == before


def test_what_an_interrupted_command_left_goes_by_its_id(here: Callable, smoke: Path) -> None:
    left = building_path(parse_id("walker/icm-v0"))
    left.mkdir()
    (left / "shard").write_text("some")
    assert "walker/icm-v0: what an interrupted command left of it, 0 kB" in here(["delete", "walker/icm-v0", "--dry-run"]).out
    assert here(["delete", "walker/icm-v0", "--yes"]).out == "walker/icm-v0\n"
    assert not left.exists()
    done = here(["delete", "walker/icm-v0", "--yes"])
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "there is no dataset 'walker/icm-v0' in " in done.err


def test_a_process_that_dies_in_the_middle_leaves_no_half_of_a_dataset(
    here: Callable, smoke: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Killed(BaseException):
        pass

    def die(path: Path, *_: Any, **__: Any) -> None:
        if any(path.iterdir() if path.exists() else ()):
            raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(room.shutil, "rmtree", die)
        with pytest.raises(Killed):
            command.delete([WALK], yes=True, results="results")
    assert WALK not in there()
    assert not dataset_path(WALK).exists()
    assert building_path(parse_id(WALK)).exists()
    assert f"Unfinished: {WALK}: was interrupted; no checkpoint yet" in here(["list", "--kind", "datasets"]).out
    assert here(["delete", WALK, "--yes"]).out == f"{WALK}\n"
    assert not building_path(parse_id(WALK)).exists()
