"""The example packages in an environment of their own, as third parties install them: pip, the command line, the data, the batteries."""

from __future__ import annotations

import shutil
import subprocess
import sys
import sysconfig
import venv
from collections.abc import Callable
from pathlib import Path

import pytest

import cudc_bench
from cudc_bench.artefacts.ids import parse_id
from cudc_bench.artefacts.manifest import read_manifest
from cudc_bench.artefacts.records import read_record
from tests import ROOT

from .waiting import PATIENCE

EXAMPLES = ROOT / "examples"
PACKAGES = {"plugin": "test_re3.py", "learner": "test_awac.py", "domain": "test_half_cheetah.py"}  # each with its tests
SITES = [path for path in sys.path if Path(path).name in {"site-packages", "dist-packages"}]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with copies of the examples, and an environment that has them installed beside everything that runs these tests.

    PyTorch and the rest are not installed anew, which would take minutes and a network: the new environment sees the running one's
    packages through a .pth file. One of ``--system-site-packages`` would see those of the interpreter under both.
    """
    folder = tmp_path_factory.mktemp("plugin")
    # Without what may lie about from other tools: a build happens in place.
    for name in PACKAGES:
        shutil.copytree(EXAMPLES / name, folder / name, ignore=shutil.ignore_patterns("build", "*.egg-info", "__pycache__"))
    venv.create(folder / "venv", symlinks=True)
    base = {"base": str(folder / "venv"), "platbase": str(folder / "venv")}
    # addsitedir, unlike a plain path, also runs the .pth files there, which an editable installation consists of.
    lines = "".join(f"import site; site.addsitedir({path!r})\n" for path in SITES)
    Path(sysconfig.get_path("purelib", "venv", base), "running.pth").write_text(lines)
    offline = ("--quiet", "--disable-pip-version-check", "--no-deps", "--no-build-isolation", "--no-index")
    command = [interpreter(folder), "-m", "pip", "install", *offline, *(folder / name for name in PACKAGES)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    return folder


def interpreter(place: Path) -> str:
    return str(place / "venv" / "bin" / "python")


def test_an_installed_method_collects_and_is_named_wherever_methods_are(place: Path, cli: Callable) -> None:
    done = cli("collect", "--method", "re3", "--profile", "smoke", interpreter=interpreter(place))
    assert done.code == 0, done.err

    # The package is not installed where this runs: nobody needs it to use its data.
    data = cudc_bench.load_transitions("walker/re3-smoke-v0", verify=True)
    assert data.observations.shape == (3000, 24)
    assert data.actions.shape == (3000, 6)
    assert not data.rewards.any()
    manifest = read_manifest(parse_id("walker/re3-smoke-v0"))
    assert (manifest.method, manifest.citation, manifest.profile) == ("re3", "Seo et al. 2021", "smoke")
    assert manifest.versions["cudc-bench-re3"] == "0.1.0"
    assert manifest.hyperparameters["neighbours"] == 3
    assert manifest.command == "cudc-bench collect --domain walker --method re3 --seed 1 --profile smoke"
    # The method learnt with its own reward, which lies above 0 and below the largest distance between two vectors of tanh.
    assert 0 < manifest.diagnostics["reward"] < 3

    listed = cli("list", interpreter=interpreter(place))
    assert listed.code == 0, listed.err
    (method,) = [line for line in listed.out.splitlines() if "Seo et al. 2021" in line]
    assert {"re3", "entropy"} <= set(method.replace("│", " ").split())
    assert any("walker/re3-smoke-v0" in line and "smoke" in line for line in listed.out.splitlines())


def test_its_settings_are_checked_like_our_own(place: Path, cli: Callable, datasets: Path) -> None:
    done = cli("collect", "--method", "re3", "--set", "neighbours=500", interpreter=interpreter(place))
    assert done.code == 2
    assert "re3 cannot be built: 500 neighbours cannot be found in a batch_size of" in " ".join(done.err.split())
    assert not datasets.exists()


def test_an_installed_algorithm_trains_on_the_data_of_any_method(place: Path, cli: Callable, smoke: Path, tmp_path: Path) -> None:
    done = cli("evaluate", "--algo", "awac", "--task", "walk", interpreter=interpreter(place))
    assert done.code == 0, done.err
    record = read_record(tmp_path / "results/smoke/walker/walk/cudc-smoke-v0/awac-seed1.json")
    assert (record.algorithm, record.hyperparameters["temperature"]) == ("awac", 1.0)


def test_an_installed_domain_is_collected_labelled_and_proven(place: Path, cli: Callable) -> None:
    for command in (
        ["collect", "--method", "random", "--domain", "half_cheetah", "--profile", "smoke"],
        ["relabel", "half_cheetah/random-smoke-v0", "--task", "run"],
    ):
        done = cli(*command, interpreter=interpreter(place))
        assert done.code == 0, done.err
    done = cli("verify", "half_cheetah/run/random-smoke-v0", interpreter=interpreter(place))
    assert done.code == 0, done.err
    assert "equal to run computed from the states" in done.out
    # Without the package nobody can simulate it, and says so.
    done = cli("verify", "half_cheetah/run/random-smoke-v0")
    assert done.code == 1
    assert "unknown domain 'half_cheetah'" in done.err
    assert len(done.err.splitlines()) == 1


def test_a_name_that_two_packages_register_is_refused(cli: Callable, datasets: Path, tmp_path: Path) -> None:
    rival = tmp_path / "rival" / "rival-1.0.dist-info"
    rival.mkdir(parents=True)
    (rival / "METADATA").write_text("Metadata-Version: 2.1\nName: rival\nVersion: 1.0\n")
    (rival / "entry_points.txt").write_text("[cudc_bench.collectors]\nrandom = rival:Random\n")
    done = cli("collect", "--method", "random", env={"PYTHONPATH": str(rival.parent)})
    assert done.code == 1
    said = " ".join(done.err.split())
    assert "the method 'random' is registered by several installed packages" in said
    assert "cudc-bench (cudc_bench.collectors.random:Random), rival (rival:Random). Uninstall all but one." in said
    assert not datasets.exists()


@pytest.mark.parametrize("package", PACKAGES)
def test_the_battery_and_its_own_tests_pass(package: str, place: Path, environment: dict[str, str]) -> None:
    command = [interpreter(place), "-m", "pytest", "-q", "-p", "no:cacheprovider", PACKAGES[package]]
    # Beside other tests, threads that wait for each other's share of a core take ten times as long.
    alone = environment | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=place / package, env=alone, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "passed" in done.stdout
    assert "skipped" not in done.stdout
