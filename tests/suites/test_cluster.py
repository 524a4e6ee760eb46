"""A suite on two Ray nodes of one machine, one of which is killed while it works, makes the records that it makes without Ray."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

import cudc_bench
from cudc_bench.errors import RunError, UsageError

from ..waiting import PATIENCE
from .test_run import TINY, records

SUITE = TINY.replace('["random"]', '["random", "icm", "cudc"]').replace("seeds = 1", "seeds = [1, 2]").replace(
    "steps = 1000", "steps = 6000, seed_steps = 500, update_every = 10"
)  # fmt: skip

# Two nodes with one CPU each; the second is killed as soon as a dataset is being collected on each.
DRIVER = """
import json, sys, threading, time
from pathlib import Path
import ray
from ray.cluster_utils import Cluster
import cudc_bench

def main():
    root = Path(sys.argv[1])
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    second = cluster.add_node(num_cpus=1)
    ray.init(address=cluster.address, log_to_driver=False)
    killed = []

    def kill():
        while len({path.parent for path in root.rglob(".*.building/checkpoints/*.pt")}) < 2:
            time.sleep(0.05)
        cluster.remove_node(second, allow_graceful=False)
        killed.append(True)

    thread = threading.Thread(target=kill, daemon=True)
    thread.start()
    report = cudc_bench.run_suite(
        "my.toml", output="results", ray=cluster.address, ray_root=root, checkpoint_every=0.0, keep=sys.argv[2]
    )
    alive = sum(node["Alive"] for node in ray.nodes())
    print(json.dumps([report.jobs, report.kept, report.failed, report.removed, len(killed), alive]))
    ray.shutdown()
    cluster.shutdown()

if __name__ == "__main__":
    main()
"""


@pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed; pip install 'cudc-bench[ray]'")
def test_two_nodes_of_which_one_is_lost_make_the_same_records(environment: dict[str, str], tmp_path: Path, datasets: Path) -> None:
    (tmp_path / "my.toml").write_text(SUITE)
    (tmp_path / "driver.py").write_text(DRIVER)
    command = [sys.executable, "driver.py", str(tmp_path / "shared"), "records"]
    # Ray's own words about the lost node go to standard error.
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr[-3000:]
    jobs, kept, failed, removed, killed, alive = json.loads(done.stdout.splitlines()[-1])
    assert (jobs, kept, failed, killed, alive) == (18, 0, [], 1, 1)
    assert len(removed) == 12
    shared = tmp_path / "shared"
    assert not [path for path in shared.rglob("*") if path.suffix in {".hdf5", ".pt", ".lock"}]

    cudc_bench.run_suite(str(tmp_path / "my.toml"), output=tmp_path / "local", report=tmp_path / "local-report", workers=1)
    local = records(tmp_path / "local")
    assert len(local) == 6
    assert records(tmp_path / "results") == local
    assert {path.name for path in (tmp_path / "results").rglob("*.policy.pt")} == {path.name for path in (tmp_path / "local").rglob("*.pt")}


def test_without_ray_its_options_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, datasets: Path) -> None:
    output = tmp_path / "results"
    with pytest.raises(UsageError, match="are for a Ray cluster; give --ray, too"):
        cudc_bench.run_suite("main", output=output, ray_root=tmp_path)
    monkeypatch.setattr("cudc_bench.suites.cluster.find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"pip install 'cudc-bench\[ray\]'"):
        cudc_bench.run_suite("main", output=output, ray="auto")
    assert not output.exists()


@pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed; pip install 'cudc-bench[ray]'")
def test_a_cluster_that_is_not_there_is_named(tmp_path: Path, datasets: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{taken.getsockname()[1]}"  # nobody listens there
        (tmp_path / "my.toml").write_text(TINY)
        with pytest.raises(RunError, match=f"there is no Ray cluster at '{address}': .*refused"):
            cudc_bench.run_suite(str(tmp_path / "my.toml"), output=tmp_path / "results", ray=address)


@pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed; pip install 'cudc-bench[ray]'")
@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"ray": "ray://head:10001"}, "--ray cannot be 'ray://head:10001'; give auto, local, or host:port."),
        ({"ray": "somewhere"}, "--ray cannot be 'somewhere'; give auto, local, or host:port."),
        ({"ray": "auto", "ray_cpus": 0}, "--ray-cpus takes 1 or more, not 0."),
        ({"ray": "auto", "ray_gpus": -1.0}, "--ray-gpus takes 0, a fraction or a number of GPUs, not -1."),
        ({"ray": "auto", "device": "quantum"}, "unknown device 'quantum'"),
        ({"ray": "auto", "suite": "density", "methods": ["random"], "profile": "smoke"}, "--ray does not measure datasets"),
    ],
)
def test_what_no_cluster_can_do_is_refused(options: dict[str, Any], says: str, tmp_path: Path, datasets: Path) -> None:
    with pytest.raises(UsageError) as refused:
        cudc_bench.run_suite(**{"suite": "main", "output": tmp_path / "results"} | options)
    assert says in str(refused.value)
    assert list(tmp_path.iterdir()) == []
