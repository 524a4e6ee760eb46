"""Checkpoints are whole or absent, belong to one run, and run no code."""

import json
import os
import pickle

import pytest
import torch

from cudc_bench.errors import RunError, UnusableError, UsageError
from cudc_bench.execution.checkpoints import KEPT, Checkpoints, digest
from cudc_bench.execution.parallel import torch_threads


def loaded(checkpoints):
    """What is restored, as (step, state), or None."""
    found = []
    step = checkpoints.load(lambda step, state: found.append((step, state)))
    assert step == (found[0][0] if found else 0)
    return found[0] if found else None


STATE = {"weights": torch.arange(5.0), "outcomes": [(1, [0.5, -2.0]), (2, {"q": 1.0})], "steps": 7, "name": "ä", "none": None}


def test_what_was_saved_last_comes_back(tmp_path):
    ours = Checkpoints(tmp_path, {"seed": 1})
    assert loaded(ours) is None
    assert not ours.check("it", "collect")
    for step in (10, 20, 30):
        ours.save(step, STATE | {"steps": step})
    again = Checkpoints(tmp_path, {"seed": 1})
    assert again.check("it", "collect")
    step, state = loaded(again)
    assert step == state["steps"] == 30
    assert torch.equal(state.pop("weights"), STATE["weights"])
    assert state == {key: value for key, value in STATE.items() if key != "weights"} | {"steps": 30}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["000000000020.pt", "000000000030.pt", "run.json"]
    assert KEPT == 2


def test_another_run_is_refused_with_what_differs(tmp_path):
    Checkpoints(tmp_path, {"seeds": [1], "hyperparameters": {"width": 128, "gamma": 0.9}}).save(1, STATE)
    other = Checkpoints(tmp_path, {"seeds": [1, 2], "hyperparameters": {"width": 256, "gamma": 0.9}})
    line = r"^an interrupted run of 'it' had other settings: hyperparameters.width 128, not 256; seeds \[1\], not \[1, 2\]\. Use those"
    with pytest.raises(UsageError, match=line):
        other.check("'it'", "collect")
    # Not even by changing what is written beside it.
    (tmp_path / "run.json").write_text(json.dumps({"seeds": [1, 2], "hyperparameters": {"width": 256, "gamma": 0.9}}))
    assert loaded(other) is None
    many = Checkpoints(tmp_path, {str(name): 0 for name in range(9)})
    with pytest.raises(
        UsageError, match=r'"?0"? null, not 0; .*, and 7 more\. Use those to continue it, or cudc-bench collect --fresh to start over\.$'
    ):
        many.check("'it'", "collect")


def test_the_one_before_serves_where_the_newest_refers_to_what_is_gone(tmp_path, capsys):
    ours = Checkpoints(tmp_path, {})
    for step in (1, 2):
        ours.save(step, STATE)
    tried = []

    def restore(step, state):
        tried.append(step)
        if step == 2:
            raise UnusableError

    assert ours.load(restore) == 1
    assert tried == [2, 1]
    assert capsys.readouterr().err == ""

    def refuse(step, state):
        raise UnusableError

    assert ours.load(refuse) == 0
    assert capsys.readouterr().err == f"no checkpoint in {tmp_path} can be used any more: the run starts over\n"


def test_threads_and_time_go_on(tmp_path, monkeypatch):
    before = torch.get_num_threads()
    now = [100.0]
    monkeypatch.setattr("cudc_bench.execution.checkpoints.time.monotonic", lambda: now[0])
    first = Checkpoints(tmp_path, {})
    now[0] = 107.0
    with torch_threads(2):
        first.save(1, STATE)
    again = Checkpoints(tmp_path, {})
    now[0] = 110.0
    with torch_threads(1):
        loaded(again)
        assert torch.get_num_threads() == 2
    assert again.seconds == 7.0 + 3.0
    assert torch.get_num_threads() == before


def test_a_digest_tells_states_apart():
    state = {"b": [torch.arange(3.0), {"n": 1}], "a": (None, "x", 0.5)}
    same = {"a": [None, "x", 0.5], "b": [torch.arange(3.0), {"n": 1}]}
    assert digest(state) == digest(same)
    others = [
        {**same, "a": [None, "x", 0.25]},
        {**same, "b": [torch.arange(3.0).double(), {"n": 1}]},
        {**same, "b": [torch.tensor([0.0, 1.0, torch.nextafter(torch.tensor(2.0), torch.tensor(3.0))]), {"n": 1}]},
        {**same, "b": [torch.arange(3.0)[None], {"n": 1}]},
        {**same, "b": [torch.arange(3.0), {"m": 1}]},
        {**same, "c": None},
    ]
    assert len({digest(one) for one in [state, *others]}) == len(others) + 1


@pytest.mark.parametrize("cut", [0, 1, 100, -1])
def test_a_damaged_one_falls_back_to_the_one_before(tmp_path, cut):
    ours = Checkpoints(tmp_path, {})
    ours.save(1, STATE)
    ours.save(2, STATE)
    newest = max(ours.folder.glob("*.pt"))
    newest.write_bytes(newest.read_bytes()[:cut])
    assert loaded(ours)[0] == 1
    for path in ours.folder.glob("*.pt"):
        path.write_bytes(b"nothing of the kind")
    assert loaded(ours) is None


def test_code_in_a_checkpoint_is_not_run(tmp_path):
    class Hostile:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "done"),)

    ours = Checkpoints(tmp_path, {})
    ours.save(1, STATE)
    (path,) = ours.folder.glob("*.pt")
    torch.save({"run": {}, "step": 1, "state": Hostile()}, path)
    assert loaded(ours) is None
    path.write_bytes(pickle.dumps(Hostile()))
    assert loaded(ours) is None
    assert not (tmp_path / "done").exists()


def test_they_come_by_time(tmp_path, monkeypatch):
    now = [100.0]
    monkeypatch.setattr("cudc_bench.execution.checkpoints.time.monotonic", lambda: now[0])
    ours = Checkpoints(tmp_path, {}, every=60)
    assert not ours.due()
    now[0] = 161.0
    assert ours.due()
    ours.save(1, STATE)
    assert not ours.due()


def test_nothing_is_left_when_they_are_removed(tmp_path):
    first, second = Checkpoints(tmp_path / "a", {"seed": 1}), Checkpoints(tmp_path / "b", {"seed": 2})
    first.remove()
    first.save(1, STATE)
    second.save(1, STATE)
    first.remove()
    assert [path.name for path in tmp_path.iterdir()] == ["b"]
    assert loaded(second) is not None


def test_a_place_that_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match=r"cannot write a checkpoint into .*: Not a directory"):
        Checkpoints(tmp_path / "file" / "run", {}).save(1, STATE)
