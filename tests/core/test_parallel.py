"""Jobs in other processes."""

import pytest

from cudc_bench import parallel


def test_a_worker_leaves_at_its_next_report_if_the_signal_was_swallowed(monkeypatch):
    """As in a finaliser, where Python reports what was raised and goes on."""
    said = []
    monkeypatch.setattr(parallel, "_queue", type("Queue", (), {"put": staticmethod(said.append)}))
    monkeypatch.setattr(parallel, "_leaving", False)
    parallel._report(3, 200)
    with pytest.raises(SystemExit):
        parallel._leave()
    with pytest.raises(SystemExit):
        parallel._report(3, 200)
    assert said == [(3, 200)]
