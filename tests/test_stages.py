"""What one stage takes from another."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import cudc_bench
from cudc_bench.collectors.cudc import CUDC
from cudc_bench.collectors.running import run_spec
from cudc_bench.errors import UsageError
from cudc_bench.stages import ensure_collected

from .served import briefly


def test_a_dataset_of_values_that_its_method_has_no_more_is_refused_by_name_and_taken_by_its_id(
    smoke: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert ensure_collected("cudc", "walker", [1], profile="smoke") == ["walker/cudc-smoke-v0"]
    monkeypatch.setattr(CUDC, "values", {"state_target": "momentum", "keys": 64})
    changed = r"\(state_target=stopgrad, which is momentum now, keys=None, which is 64 now\)"
    with pytest.raises(UsageError, match=rf"'walker/cudc-smoke-v0' was collected with other settings than cudc has by now {changed}"):
        cudc_bench.evaluate("td3", methods=["cudc"], tasks=["walk"], profile="smoke", output=tmp_path)
    with briefly():
        assert len(cudc_bench.evaluate("td3", dataset_id="walker/walk/cudc-smoke-v0", profile="smoke", output=tmp_path)) == 1


def refuse(*arguments: Any) -> None:
    raise UsageError("there is no such setting")


def test_settings_of_its_own_and_what_cannot_be_asked_are_no_difference(datasets: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cudc_bench.collect("random", profile="smoke", settings={"steps": 1000})
    assert ensure_collected("random", "walker", [1], profile="smoke") == ["walker/random-smoke-v0"]
    # Its method waits for a pilot, or refuses what it was collected with.
    monkeypatch.setattr(run_spec, "resolve", refuse)
    assert ensure_collected("random", "walker", [1], profile="smoke") == ["walker/random-smoke-v0"]
