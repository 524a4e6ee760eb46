"""An exported policy works without this project and says what it is."""

import hashlib
import io
import json
import zipfile

import numpy as np
import pytest
import torch

import cudc_bench
from cudc_bench import plugins
from cudc_bench.envs.layouts import observation_layout
from cudc_bench.errors import RunError, UsageError
from cudc_bench.evaluators.policies.exporting import to_bytes
from cudc_bench.evaluators.policies.stored import load_policy, policy_path

from .runs import write_run

ELSEWHERE = """
import sys
import numpy as np
import torch

policy = torch.export.load(sys.argv[1]).module()
for n in (1, 7):
    np.save(f"{sys.argv[2]}/actions{n}.npy", policy(torch.from_numpy(np.load(f"{sys.argv[2]}/observations{n}.npy"))).numpy())
print([name for name in sys.modules if name.split(".")[0] in ("cudc_bench", "mujoco", "dm_control", "gymnasium")])
"""


def test_another_process_gets_the_same_actions_without_this_project(tmp_path, python):
    path, _ = write_run(tmp_path, domain="quadruped")
    file = cudc_bench.export_policy(path)
    assert file == tmp_path / "td3-seed1.pt2"
    policy = load_policy(path)
    for n in (1, 7):
        np.save(tmp_path / f"observations{n}.npy", np.random.default_rng(n).normal(size=(n, 78), scale=3.0).astype(np.float32))
    # The editable installation is not what makes it work.
    done = python(ELSEWHERE, str(file), str(tmp_path))
    assert (done.code, done.out) == (0, "[]\n"), done.err
    for n in (1, 7):
        actions, expected = np.load(tmp_path / f"actions{n}.npy"), policy.act(np.load(tmp_path / f"observations{n}.npy"))
        assert actions.shape == (n, 12)
        assert actions.dtype == np.float32
        assert np.abs(actions).max() <= 1.0
        assert actions.tobytes() == expected.tobytes()


@pytest.mark.parametrize("name", plugins.names("evaluators"))
def test_every_algorithms_policy_can_be_exported(name, tmp_path):
    path, _ = write_run(tmp_path, name)
    policy = load_policy(path)
    module = torch.export.load(io.BytesIO(to_bytes(policy, {}))).module()
    for n in (1, 2, 50):
        observation = torch.randn(n, 24)
        assert torch.equal(module(observation), policy(observation))


def test_the_specification_inside_says_what_it_is(tmp_path):
    path, _ = write_run(tmp_path, returns=(10.0, 20.0), seed=3)
    file = cudc_bench.export_policy(path, tmp_path / "my policy.pt2")
    extra = {"spec.json": ""}
    torch.export.load(file, extra_files=extra)
    spec = json.loads(extra["spec.json"])
    # Also without PyTorch.
    with zipfile.ZipFile(file) as archive:
        (inside,) = [name for name in archive.namelist() if name.endswith("/spec.json")]
        assert json.loads(archive.read(inside)) == spec
    observation, action = spec["observation"], spec["action"]
    assert (observation["size"], action["size"], action["low"], action["high"]) == (24, 6, -1.0, 1.0)
    assert [(part["name"], part["start"], part["size"]) for part in observation["parts"]] == [
        ("orientations", 0, 14), ("height", 14, 1), ("velocity", 15, 9),
    ]  # fmt: skip
    assert [element for part in observation["parts"] for element in part["elements"]][14] == "torso.z"
    assert action["names"][0] == "right_hip"
    environment, training = spec["environment"], spec["training"]
    assert (environment["domain"], environment["task"], environment["control_timestep"]) == ("walker", "walk", 0.025)
    assert environment["gymnasium_id"] == "cudc_bench/walker-walk-v0"
    assert (training["algorithm"], training["seed"], training["gradient_steps"]) == ("td3", 3, 40)
    assert (training["dataset"]["id"], training["dataset"]["fingerprint"]) == ("walker/walk/cudc-smoke-v0", "0" * 64)
    assert (spec["result"]["return"], spec["result"]["episodes"]) == (15.0, 2)
    assert spec["record"] == {"file": "td3-seed3.json", "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    assert training["versions"]["torch"] == spec["exported_with"]["torch"]
    found = {"observation": torch.zeros(2, 24)}
    lines = [line.replace("my policy.pt2", str(file)) for line in spec["load"]]
    exec("\n".join(lines), found)
    assert found["action"].shape == (2, 6)


def test_the_same_policy_gives_the_same_file_which_names_no_place_of_this_machine(tmp_path):
    path, _ = write_run(tmp_path)
    first = cudc_bench.export_policy(path).read_bytes()
    assert cudc_bench.export_policy(path).read_bytes() == first
    with zipfile.ZipFile(io.BytesIO(first)) as archive:
        everything = b"".join(archive.read(name) for name in archive.namelist())
    assert str(tmp_path).encode() not in everything
    assert b".py" not in everything
    assert b"stack_trace" not in everything


def test_what_cannot_be_exported_is_refused_in_one_line(tmp_path, cli):
    path, _ = write_run(tmp_path)
    for output, match in ((tmp_path / "policy.onnx", "must end in .pt2"), (path / "x.pt2", "is a file")):
        with pytest.raises(UsageError, match=match):
            cudc_bench.export_policy(path, output)
    (tmp_path / "folder.pt2").mkdir()
    with pytest.raises(UsageError, match="is a folder"):
        cudc_bench.export_policy(path, tmp_path / "folder.pt2")
    done = cli("export", str(path))
    assert (done.code, done.out) == (0, f"{tmp_path / 'td3-seed1.pt2'}\n")
    assert "torch.export.load" in done.err
    policy_path(path).unlink()
    with pytest.raises(RunError, match="train it again with"):
        cudc_bench.export_policy(path)
    done = cli("export", str(path), "--output", "there.pt2")
    assert done.code == 1
    assert done.err.startswith("cudc-bench: error: ")
    assert done.err.count("\n") == 1
    assert not (tmp_path / "there.pt2").exists()


def test_the_layouts_of_other_domains_name_what_their_observations_are_made_of():
    blocks = observation_layout("dm_control/cheetah-run")
    assert [(block.name, len(block.elements)) for block in blocks] == [("position", 8), ("velocity", 9)]
