"""Where a result came from."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from cudc_bench.artefacts import provenance


def test_the_commit_is_that_of_the_code_whatever_a_hook_has_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    repository = tmp_path / "code"
    folder = repository / "cudc_bench" / "artefacts"
    folder.mkdir(parents=True)
    for words in ("init -q", "-c user.name=a -c user.email=a@b commit -q --allow-empty -m one"):
        subprocess.run(["git", *words.split()], cwd=repository, check=True)
    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=repository, check=True, capture_output=True, text=True).stdout.strip()
    monkeypatch.setattr(provenance, "__file__", str(folder / "provenance.py"))
    for name, value in {"GIT_DIR": str(tmp_path / "nowhere"), "GIT_WORK_TREE": str(tmp_path), "GIT_INDEX_FILE": "/dev/null"}.items():
        monkeypatch.setenv(name, value)
    assert provenance.commit.__wrapped__() == (head, False)
    assert provenance.knows_commit(head)
