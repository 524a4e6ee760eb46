"""Checkpoints are whole or absent, belong to one run, and run no code."""

import os
import pickle

import pytest
import torch

from cudc_bench.checkpoints import KEPT, Checkpoints
from cudc_bench.errors import RunError

STATE = {"weights": torch.arange(5.0), "outcomes": [(1, [0.5, -2.0]), (2, {"q": 1.0})], "steps": 7, "name": "ä", "none": None}


def test_what_was_saved_last_comes_back(tmp_path):
    ours = Checkpoints(tmp_path, {"seed": 1})
    assert ours.load() is None
    for step in (10, 20, 30):
        ours.save(step, STATE | {"steps": step})
    step, state = Checkpoints(tmp_path, {"seed": 1}).load()
    assert step == state["steps"] == 30
    assert torch.equal(state.pop("weights"), STATE["weights"])
    assert state == {key: value for key, value in STATE.items() if key != "weights"} | {"steps": 30}
    assert len(list(ours.folder.iterdir())) == KEPT == 2


def test_other_runs_never_meet_it(tmp_path):
    Checkpoints(tmp_path, {"seed": 1}).save(1, STATE)
    assert Checkpoints(tmp_path, {"seed": 2}).load() is None
    # Not even by moving files about.
    other = Checkpoints(tmp_path, {"seed": 2})
    Checkpoints(tmp_path, {"seed": 1}).folder.rename(other.folder)
    assert other.load() is None


@pytest.mark.parametrize("cut", [0, 1, 100, -1])
def test_a_damaged_one_falls_back_to_the_one_before(tmp_path, cut):
    ours = Checkpoints(tmp_path, {})
    ours.save(1, STATE)
    ours.save(2, STATE)
    newest = max(ours.folder.iterdir())
    newest.write_bytes(newest.read_bytes()[:cut])
    assert ours.load()[0] == 1
    for path in ours.folder.iterdir():
        path.write_bytes(b"nothing of the kind")
    assert ours.load() is None


def test_code_in_a_checkpoint_is_not_run(tmp_path):
    class Hostile:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "done"),)

    ours = Checkpoints(tmp_path, {})
    ours.save(1, STATE)
    (path,) = ours.folder.iterdir()
    torch.save({"run": {}, "step": 1, "state": Hostile()}, path)
    assert ours.load() is None
    path.write_bytes(pickle.dumps(Hostile()))
    assert ours.load() is None
    assert not (tmp_path / "done").exists()


def test_they_come_by_time(tmp_path, monkeypatch):
    now = [100.0]
    monkeypatch.setattr("cudc_bench.checkpoints.time.monotonic", lambda: now[0])
    ours = Checkpoints(tmp_path, {}, every=60)
    assert not ours.due()
    now[0] = 161.0
    assert ours.due()
    ours.save(1, STATE)
    assert not ours.due()


def test_nothing_is_left_when_they_are_removed(tmp_path):
    folder = tmp_path / ".checkpoints"
    first, second = Checkpoints(folder, {"seed": 1}), Checkpoints(folder, {"seed": 2})
    first.remove()
    first.save(1, STATE)
    second.save(1, STATE)
    first.remove()
    assert second.load() is not None
    second.remove()
    assert not folder.exists()


def test_a_place_that_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match=r"cannot write a checkpoint into .*: Not a directory"):
        Checkpoints(tmp_path / "file", {}).save(1, STATE)
