"""Pilots measure what they say, and methods read what pilots measured."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given
from hypothesis import settings as limits
from hypothesis import strategies as st

import cudc_bench
from cudc_bench import plugins
from cudc_bench.artefacts.manifest import read_manifest
from cudc_bench.collectors.running.loop import run_collection
from cudc_bench.collectors.running.pilot import FIRST, LAST, QUANTILE, SEED
from cudc_bench.collectors.running.run_spec import resolve
from cudc_bench.collectors.running.thresholds import OURS, find_threshold, read_thresholds, settings_key
from cudc_bench.envs import DOMAINS
from cudc_bench.errors import RunError, UsageError
from cudc_bench.settings.profiles import PROFILES

NEEDY = ["cudc-no-reach", "cudc-reward", "cudc-vary-apt", "cudc-vary-icm"]
SMOKE = PROFILES["smoke"]


@pytest.fixture
def own_file(datasets: Path) -> Path:
    """Where the test's thresholds go."""
    return Path(os.environ["CUDC_BENCH_THRESHOLDS"])


@pytest.fixture
def none_of_ours(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """As if the package brought no thresholds along."""
    monkeypatch.setattr("cudc_bench.collectors.running.thresholds.OURS", tmp_path / "nothing.json")


class Ignores:
    def add_episode(self, *arguments):
        pass

    def add_diagnostics(self, row, steps_per_second):
        pass


def test_exactly_these_need_one():
    kinds = {name: plugins.load("collectors", name) for name in plugins.names("collectors")}
    assert [name for name, kind in kinds.items() if kind.measured_by_pilot(kind.configure("walker")) is not None] == NEEDY


@pytest.mark.parametrize("method", NEEDY)
def test_the_threshold_is_the_quantile_of_medians(method, own_file):
    (found,) = cudc_bench.pilot([method], profile="smoke")
    setting = resolve(method, "walker", SMOKE, piloting=True)
    loop = replace(setting.loop, steps=round(LAST * setting.loop.steps))
    collector = setting.kind(setting.sizes, setting.config, [SEED])
    torch.set_num_threads(1)
    rows, update = [], collector.update

    def watched(batch):
        metrics = update(batch)
        f = batch.cache
        error = (f.z_next - f.predicted).norm(dim=-1)[0]
        if method == "cudc-no-reach":
            signal = error
        elif method == "cudc-vary-icm":
            signal = error.log1p()
        else:
            points = f.z[0] if method == "cudc-vary-apt" else torch.cat([f.z[0], f.action[0]], -1)
            nearest = torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist").sort(-1).values[:, :12]
            signal = nearest.mean(-1).log1p()
            if method == "cudc-reward":
                signal = signal + collector.config.alpha * error + collector.config.beta
        rows.append(sorted(signal.tolist())[15])  # PyTorch's median of 32 values is the lower of the middle ones
        return metrics

    collector.update = watched
    run_collection(collector, loop, DOMAINS["walker"], [Ignores()], lambda n: None)
    assert found.value == pytest.approx(np.quantile(rows, QUANTILE), rel=1e-4)
    assert (found.updates, found.first_step, found.last_step) == (len(rows), round(FIRST * 3000), round(LAST * 3000))
    assert collector.horizon.tolist() == [3]  # whatever happens, k stays in a pilot


def test_updates_before_the_window_do_not_count(own_file):
    every = {"seed_steps": 1000, "steps": 30_000, "update_every": 500, "width": 8, "batch_size": 16, "feature_dim": 8}
    (found,) = cudc_bench.pilot(["cudc-vary-icm"], profile="smoke", settings=every)
    # From step 1,500 to 13,500 at one update in 500; the updates at 1,000 is the only one before.
    assert (found.first_step, found.last_step, found.updates) == (1500, 13_500, 24)


def test_collect_reads_what_a_pilot_measured(own_file, none_of_ours):
    with pytest.raises(UsageError, match="cudc-vary-icm needs c_r, which nobody measured for walker yet; run: cudc-bench pilot --method"):
        cudc_bench.collect("cudc-vary-icm", profile="smoke")
    (found,) = cudc_bench.pilot(["cudc-vary-icm"], profile="smoke")
    assert read_thresholds(own_file) == [found]
    (one,) = cudc_bench.collect("cudc-vary-icm", profile="smoke")
    manifest = read_manifest(one)
    assert manifest.pilot == found
    assert manifest.hyperparameters["c_r"] == found.value
    assert manifest.overrides == {}
    assert f"= {found.value:.6g}, measured by a pilot" in (Path(os.environ["MINARI_DATASETS_PATH"]) / one / "README.md").read_text()
    # A labelled dataset knows it, too.
    (labelled,) = cudc_bench.relabel(one, ["walk"])
    assert read_manifest(labelled).pilot == found


def test_a_threshold_belongs_to_its_settings(own_file, none_of_ours):
    (first,) = cudc_bench.pilot(["cudc-vary-icm"], profile="smoke")

    def found(**settings):
        try:
            return resolve("cudc-vary-icm", "walker", SMOKE, settings).pilot
        except UsageError:
            return None

    for settings in ({"width": 32}, {"learning_rate": 1e-4}, {"k_max": 5}, {"update_every": 25}):
        assert found(**settings) is None
    # The length of a run and the rest of the rule change nothing in a pilot.
    for settings in ({"steps": 5000}, {"measure_every": 3}, {"c_k": 0.7}, {"patience": 4}, {"threshold_dwell": 1}):
        assert found(**settings) == first
    (wide,) = cudc_bench.pilot(["cudc-vary-icm"], profile="smoke", settings={"width": 32})
    assert wide.overrides == {"width": 32}
    assert found(width=32) == wide
    assert found() == first
    assert len(read_thresholds(own_file)) == 2
    (again,) = cudc_bench.pilot(["cudc-vary-icm"], profile="smoke")
    assert again.value == first.value
    assert len(read_thresholds(own_file)) == 2


def test_a_users_own_number_needs_no_pilot(none_of_ours):
    setting = resolve("cudc-no-reach", "walker", SMOKE, {"c_e": "0.25"})
    assert (setting.config.c_e, setting.overrides, setting.pilot) == (0.25, {"c_e": 0.25}, None)


def test_a_users_own_pilot_wins_over_ours(own_file):
    setting = resolve("cudc-vary-icm", "walker", SMOKE)
    assert setting.pilot in read_thresholds(OURS)
    mine = setting.pilot.model_copy(update={"value": 123.0})
    own_file.write_text(json.dumps({"thresholds": [mine.model_dump()]}))
    assert resolve("cudc-vary-icm", "walker", SMOKE).config.c_r == 123.0


@pytest.mark.parametrize("domain", DOMAINS)
@pytest.mark.parametrize("profile", ["cpu", "demo", "smoke"])
@pytest.mark.parametrize("method", NEEDY)
def test_thresholds_of_the_small_profiles_come_along(method, profile, domain):
    setting = resolve(method, domain, PROFILES[profile])
    assert setting.pilot in read_thresholds(OURS)
    pilot = setting.pilot
    assert (pilot.method, pilot.domain, pilot.seed, pilot.overrides) == (method, domain, 0, {})
    assert not pilot.dirty
    assert pilot.value > 0


def test_what_comes_along_is_what_the_pilot_command_gives():
    """Smoke pilots take a second; that the numbers are near proves that they were not written by hand for other code."""
    (found,) = cudc_bench.pilot(["cudc-vary-icm"], profile="smoke")
    ours = resolve("cudc-vary-icm", "walker", SMOKE).pilot
    assert ours.key == found.key
    assert ours.value == pytest.approx(found.value, rel=0.05)


def test_the_cpus_thresholds_are_the_cpu_profiles():
    kind = plugins.load("collectors", "cudc-vary-icm")
    cpu, demo = (resolve("cudc-vary-icm", "walker", PROFILES[name]) for name in ("cpu", "demo"))
    # The demo is the cpu profile cut short.
    assert cpu.pilot == demo.pilot
    assert cpu.pilot.profile == "cpu"
    assert cpu.pilot.key == settings_key(kind, "cudc-vary-icm", "walker", cpu.loop, cpu.config)
    assert find_threshold(kind, "cudc-vary-icm", "walker", cpu.loop, cpu.config) == cpu.pilot


@pytest.mark.parametrize(
    "content",
    ["", "{", "[]", '{"thresholds": [{}]}', '{"schema_version": 2, "thresholds": []}', '{"thresholds": [], "more": 1}', "\x00\xff"],
)
def test_a_damaged_file_is_one_line(own_file, content):
    own_file.write_bytes(content.encode("latin-1"))
    with pytest.raises(RunError, match=r"the thresholds in .* are damaged: .*; mend or remove it\."):
        resolve("cudc-vary-icm", "walker", SMOKE)


@limits(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_any_file_is_read_right_or_refused_in_one_line(own_file, data):
    content = bytearray(OURS.read_bytes()[:6000])
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.integers(0, len(content)))
        content[place : place + data.draw(st.integers(0, 9))] = data.draw(st.binary(max_size=9))
    whole = data.draw(st.sampled_from([bytes(content), b"[" * 10_000, b'{"thresholds": ' * 5_000, b"\xff", b"9" * 9_000]))
    own_file.write_bytes(whole)
    with pytest.raises(RunError, match=r"the thresholds in .* are damaged: .*; mend or remove it\.") as caught:
        read_thresholds(own_file)
    assert len(str(caught.value)) < 1000


def test_a_damaged_file_is_found_before_the_pilot_runs(own_file, monkeypatch):
    monkeypatch.setattr("cudc_bench.runs.execution.run_jobs", lambda *_, **__: pytest.fail("it ran"))
    own_file.write_text("{")
    with pytest.raises(RunError, match="are damaged"):
        cudc_bench.pilot(["cudc-vary-icm"], profile="smoke")
    own_file.unlink()
    os.mkfifo(own_file)
    with pytest.raises(RunError, match="cannot be read: it is a pipe or a device"):
        cudc_bench.pilot(["cudc-vary-icm"], profile="smoke")


def test_the_command(cli, tmp_path, datasets):
    own = {"CUDC_BENCH_THRESHOLDS": ""}
    done = cli("pilot", "--method", "cudc-vary-icm,cudc-no-reach", "--domain", "jaco", "--workers", "1", env=own)
    assert done.code == 0, done.err
    assert done.out == "thresholds.json\n"
    found = {pilot.method: pilot for pilot in read_thresholds(tmp_path / "thresholds.json")}
    assert set(found) == {"cudc-vary-icm", "cudc-no-reach"}
    assert f"cudc-no-reach on jaco: c_e = {found['cudc-no-reach'].value:.6g}" in done.err
    done = cli("collect", "--method", "cudc-no-reach", "--domain", "jaco", env=own)
    assert done.code == 0, done.err
    assert read_manifest("jaco/cudc-no-reach-smoke-v0").pilot == found["cudc-no-reach"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--method", "cudc"], "cudc needs no pilot; leave --method out for all that need one."),
        (["--method", "cudc-vary"], "unknown method 'cudc-vary'"),
        (["--method", ","], "--method is empty"),
        (["--domain", "moon"], "unknown domain 'moon'"),
        (["--set", "c_q=1"], "nothing here is called 'c_q'"),
        (["--set", "width=-1"], "'width' cannot be '-1'"),
        (["--method", "cudc-no-reach", "--set", "k_max=2"], "k_max=2 is below the first horizon 3"),
    ],
)
def test_wrong_input_is_one_line(cli, tmp_path, arguments, said):
    done = cli("pilot", *arguments)
    assert done.code == 2
    assert said in done.err
    assert done.err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_run_too_short_to_learn_says_so(own_file):
    with pytest.raises(RunError, match="the pilot of cudc-vary-icm learnt nothing within 900 steps"):
        cudc_bench.pilot(["cudc-vary-icm"], profile="smoke", settings={"steps": 2000})
    assert not own_file.exists()
