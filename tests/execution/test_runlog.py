"""Lines of diagnostics and training metrics arrive where --log sends them, and nothing is imported unless asked for."""

from __future__ import annotations

import json
import sys
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import cudc_bench
from cudc_bench.artefacts.records import read_record
from cudc_bench.collectors.running.dataset_sink import DatasetSink
from cudc_bench.errors import RunError, UsageError
from cudc_bench.evaluators.running.loop import Arena
from cudc_bench.execution import interrupts, runlog
from cudc_bench.execution.runlog import LogTarget, open_log

SHORT = {"steps": 1_200, "measure_every": 2}


def scalars(folder: Path) -> dict[int, dict[str, float]]:
    """What TensorBoard itself reads from a run's folder, by step."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder), size_guidance={"scalars": 0}).Reload()
    rows: dict[int, dict[str, float]] = defaultdict(dict)
    for name in events.Tags()["scalars"]:
        for event in events.Scalars(name):
            assert name not in rows[event.step]
            rows[event.step][name] = event.value
    return dict(rows)


def check_rows(found: dict[int, dict[str, float]], expected: dict[int, dict[str, float]]) -> None:
    """TensorBoard keeps float32."""
    assert found.keys() == expected.keys()
    for step, row in expected.items():
        assert found[step] == pytest.approx(row, rel=1e-6)


def diagnostics(root: Path, dataset_id: str) -> dict[int, dict[str, float]]:
    rows = [json.loads(line) for line in (root / dataset_id / "diagnostics.jsonl").read_text().splitlines()]
    return {row.pop("step"): row for row in rows}


def without_speed(found: dict[int, dict[str, float]]) -> dict[int, dict[str, float]]:
    """The rows of a collection, whose speed goes to the log alone."""
    assert all(row.pop("steps_per_second") > 0 for row in found.values())
    return found


def test_tensorboard_reads_back_the_lines_of_each_worker(datasets: Path, tmp_path: Path) -> None:
    ids = cudc_bench.collect("icm", seeds=[1, 2], profile="smoke", settings=SHORT, workers=2, log="tensorboard", log_dir=tmp_path)
    for one in ids:
        check_rows(without_speed(scalars(tmp_path / "collect/smoke" / one)), diagnostics(datasets, one))


def test_a_run_that_is_made_again_takes_the_place_of_the_earlier_one(datasets: Path, tmp_path: Path) -> None:
    for steps in (1_200, 700):
        cudc_bench.collect("random", profile="smoke", settings={"steps": steps}, overwrite=True, log="tensorboard", log_dir=tmp_path)
    found = scalars(tmp_path / "collect/smoke/walker/random-smoke-v0")
    assert list(found) == [500, 700]
    check_rows(without_speed(found), diagnostics(datasets, "walker/random-smoke-v0"))


def test_training_is_logged_as_it_is_recorded(smoke: Path, tmp_path: Path) -> None:
    (path,) = cudc_bench.evaluate(
        "td3", tasks=["walk"], profile="smoke", output=tmp_path / "results", log="tensorboard", log_dir=tmp_path / "runs"
    )
    record = read_record(path)
    expected: dict[int, dict[str, float]] = {one.step: {"return_mean": one.mean} for one in record.curve}
    for one in record.metrics:
        expected[one.step] |= one.values
    for one in record.finals:
        expected[one.step]["final_return_mean"] = one.mean
    check_rows(scalars(tmp_path / "runs/evaluate/smoke/walker/walk/cudc-smoke-v0/td3-seed1"), expected)


def test_a_run_that_goes_on_logs_all_that_was_before(smoke: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The rows before the interruption are there once, those after it follow."""

    def collect() -> None:
        cudc_bench.collect("icm", profile="smoke", settings=SHORT, log="tensorboard", log_dir=tmp_path)

    def evaluate() -> list[Path]:
        return cudc_bench.evaluate("td3", tasks=["walk"], profile="smoke", output=tmp_path, log="tensorboard", log_dir=tmp_path)

    with monkeypatch.context() as patch:
        patch.setattr(DatasetSink, "add_diagnostics", asking(DatasetSink.add_diagnostics, 7))
        patch.setattr(Arena, "returns", asking(Arena.returns, 2))
        for run in (collect, evaluate):
            with pytest.raises(interrupts.Interrupted):
                run()
    collect()
    found = scalars(tmp_path / "collect/smoke/walker/icm-smoke-v0")
    assert [step for step, row in found.items() if "steps_per_second" in row] == [800, 900, 1000, 1100, 1200]
    for row in found.values():
        row.pop("steps_per_second", None)
    check_rows(found, diagnostics(smoke, "walker/icm-smoke-v0"))
    record = read_record(*evaluate())
    found = scalars(tmp_path / "evaluate/smoke/walker/walk/cudc-smoke-v0/td3-seed1")
    assert {step: row["return_mean"] for step, row in found.items()} == pytest.approx({one.step: one.mean for one in record.curve})
    for one in record.metrics:
        assert {name: found[one.step][name] for name in one.values} == pytest.approx(one.values)


def asking(method: Callable[..., Any], call: int) -> Callable[..., Any]:
    """A method that asks the process to leave when it has been called so many times."""
    calls = []

    def ask(*arguments: Any, **options: Any) -> Any:
        result = method(*arguments, **options)
        calls.append(1)
        if len(calls) == call:
            interrupts.request_stop()
        return result

    return ask


FAKE = """
import json
from pathlib import Path

class Error(Exception):
    pass

class Settings:
    def __init__(self, **values):
        self.values = values

class Run:
    def __init__(self, file):
        self.file = file
    def note(self, *what):
        with self.file.open("a") as file:
            file.write(json.dumps(what) + "\\n")
    def log(self, row, step):
        self.note("log", step, row)
    def finish(self, exit_code=None):
        self.note("finish", exit_code)

def init(*, project, name, group, job_type, config, dir, mode, reinit, settings):
    if mode == "online":
        raise Error("no\\nnetwork")
    run = Run(Path(dir, f"{job_type}-{name}.jsonl"))
    run.note("init", project, name, group, job_type, config["width"], mode, reinit)
    return run
"""


@pytest.fixture
def wandb(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of logs, for a module that notes what Weights & Biases is told."""
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules/wandb.py").write_text(FAKE)
    monkeypatch.syspath_prepend(tmp_path / "modules")
    monkeypatch.delitem(sys.modules, "wandb", raising=False)
    monkeypatch.delenv("WANDB_MODE", raising=False)
    return tmp_path / "logs"


def notes(file: Path) -> list[Any]:
    return [json.loads(line) for line in file.read_text().splitlines()]


def test_wandb_gets_the_lines_offline(wandb: Path, datasets: Path, tmp_path: Path) -> None:
    (one,) = cudc_bench.collect("icm", seeds=[3], profile="smoke", settings=SHORT, log="wandb", log_dir=wandb)
    first, *rows, last = notes(wandb / "collect-icm-seed3.jsonl")
    assert first == ["init", "cudc-bench-walker", "icm-seed3", "smoke", "collect", 16, "offline", "create_new"]
    assert [row[0] for row in rows] == ["log"] * len(rows)
    assert without_speed({row[1]: row[2] for row in rows}) == diagnostics(datasets, one)
    assert last == ["finish", None]
    cudc_bench.evaluate(
        "td3", tasks=["walk"], profile="smoke", dataset_id=cudc_bench.relabel(one, ["walk"])[0], output=tmp_path / "results", log="wandb",
        log_dir=wandb,
    )  # fmt: skip
    rows = notes(wandb / "evaluate-walk-icm-td3-seed3.jsonl")
    steps = [row[1] for row in rows if row[0] == "log"]
    assert steps == sorted(steps)  # Weights & Biases drops rows that go back
    assert {name for row in rows if row[0] == "log" for name in row[2]} >= {"return_mean", "final_return_mean", "critic_loss"}


def test_wandb_ends_with_the_run(wandb: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = LogTarget("wandb", wandb, "collect", "smoke", "dm_control/cheetah-run", "x", "random-seed1", {"width": 1})
    with pytest.raises(RunError, match="broke"), open_log(target):
        raise RunError("broke")
    assert notes(wandb / "collect-random-seed1.jsonl")[0][1] == "cudc-bench-dm_control.cheetah-run"
    assert notes(wandb / "collect-random-seed1.jsonl")[-1] == ["finish", 1]
    monkeypatch.setenv("WANDB_MODE", "online")
    with pytest.raises(RunError, match=r"^Weights & Biases did not start \(no network\); set WANDB_MODE=offline\.$"), open_log(target):
        pass


@pytest.mark.parametrize("log", runlog.LOGS)
def test_a_missing_package_is_refused_before_any_work(log: str, smoke: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runlog, "find_spec", lambda name: None)
    line = rf"^--log {log} needs a package that is not installed; pip install 'cudc-bench\[{log}\]', or leave out --log\.$"
    before = sorted(smoke.rglob("*"))
    with pytest.raises(UsageError, match=line):
        cudc_bench.collect("random", profile="smoke", log=log, log_dir=tmp_path / "runs")
    with pytest.raises(UsageError, match=line):
        cudc_bench.evaluate("td3", profile="smoke", log=log, log_dir=tmp_path / "runs", output=tmp_path / "results")
    assert sorted(smoke.rglob("*")) == before
    assert list(tmp_path.iterdir()) == []


def test_wrong_input_is_refused_in_one_line(cli: Callable, datasets: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    done = cli("collect", "--method", "random", "--log", "tensorboard", "--log-dir", "file")
    assert (done.code, done.out) == (2, "")
    assert done.err == "cudc-bench: error: the log folder 'file' cannot be a folder: 'file' is a file.\n"
    with pytest.raises(UsageError, match=r"^unknown log 'tensorbord'; allowed: tensorboard, wandb\. Did you mean 'tensorboard'\?$"):
        cudc_bench.collect("random", profile="smoke", log="tensorbord")
    assert not datasets.exists()


def test_neither_package_is_imported_unless_asked_for(python: Callable, datasets: Path) -> None:
    done = python(
        "import sys, cudc_bench\n"
        "if __name__ == '__main__':\n"
        "    cudc_bench.collect('random', profile='smoke', settings={'steps': 100})\n"
        "    print({'tensorboard', 'wandb'} & set(sys.modules))"
    )
    assert (done.code, done.out) == (0, "set()\n"), done.err
