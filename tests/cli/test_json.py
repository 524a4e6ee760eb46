"""``--json``: one document on standard output, whatever else there is to say."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from pydantic import BaseModel

from cudc_bench.artefacts.manifest import read_manifest
from cudc_bench.cli.documents import Document, Number, VerifyDocument, to_json
from cudc_bench.cli.verify import _show as show
from cudc_bench.data.verification import Check, Verification
from cudc_bench.leaderboard import api
from cudc_bench.leaderboard.show.documents import StatsDocument
from tests import ROOT

from ..documents.test_reference_pages import generate

BASE, WALK = "walker/cudc-smoke-v0", "walker/walk/cudc-smoke-v0"


def test_verify_tells_a_script_what_it_tells_people(here: Callable, smoke: Path) -> None:
    done = here(["verify", BASE, WALK, "--sample", "1", "--seed", "3", "--json"])
    assert done.code == 0, done.err
    found = VerifyDocument.model_validate_json(done.out)
    assert [one.id for one in found.datasets] == [BASE, WALK]
    assert found.ok
    base = found.datasets[0]
    assert (base.fingerprint, base.seed, base.problem) == (read_manifest(BASE).fingerprint, 3, None)
    shown = here(["verify", BASE, "--sample", "1", "--seed", "3"])
    words = " ".join(shown.out.split())
    for check in base.checks:
        assert f"ok {check.name} {check.detail.split()[0]}" in words
    assert f"proven: {'; '.join(base.proven)}" in words


def test_what_fails_is_in_the_document_and_the_status_is_the_same(here: Callable, smoke: Path) -> None:
    (smoke / WALK / "data/main_data.hdf5").write_bytes(b"nothing")
    (smoke / "walker/run/cudc-smoke-v0/data/main_data.hdf5").unlink()
    for words, failed in (([WALK], 1), ([WALK, "walker/run/cudc-smoke-v0"], 2)):
        plain, done = here(["verify", *words]), here(["verify", *words, "--json"])
        assert plain.code == done.code == 1
        assert done.err.splitlines()[-1].startswith("cudc-bench: error: ")
        found = VerifyDocument.model_validate_json(done.out)
        assert not found.ok
        assert sum(not one.ok for one in found.datasets) == failed
        assert all(bool(one.problem) != one.ok for one in found.datasets)
        assert all(one.problem in plain.err for one in found.datasets if one.problem)


@pytest.mark.parametrize("columns", [60, 80])
def test_what_is_proven_fits_narrow_terminals(columns: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    checks = tuple(
        Check(name, f"{name} of 1,234,567 steps in 400 episodes; the largest difference is 1.25e-06") for name in ("bounds", "states")
    )
    show(Verification(BASE, "0" * 64, checks, ("it is whole",), ("who chose the actions",), 7))
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= columns
    assert out.count("1,234,567") == out.count("1.25e-06") == 2
    assert out.splitlines()[0] == f"{BASE} passes all checks"


def test_stats_prints_a_document_and_refuses_as_without(here: Callable, smoke: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(api, "quality_files", lambda table: {"quality.md": table.domain})  # to draw them takes seconds
    done = here(["stats", "--output", "report", "--json"])
    assert done.code == 0, done.err
    found = StatsDocument.model_validate_json(done.out)
    assert [(one.id, one.seed) for one in found.tables[0].datasets] == [(BASE, 1)]
    assert found.files
    assert all(Path(file).exists() for file in found.files)
    refused = here(["stats", WALK, "--json"])
    assert (refused.code, refused.out, refused.err.count("\n")) == (2, "", 1)


class Example(Document):
    """For a test.

    Attributes:
        number, text: are shown.
    """

    number: Number
    text: str


def test_a_document_is_ascii_and_has_no_number_that_json_lacks() -> None:
    for number in (math.nan, math.inf, 1.5):
        text = to_json(Example(number=number, text="é\x1b\udcff"))
        assert text.isascii()
        assert json.loads(text) == {"number": number if number == 1.5 else None, "text": "é\x1b\udcff"}


def models() -> Iterator[type[BaseModel]]:
    for _, module, name in generate.DOCUMENTS:
        yield from generate._with_parts(getattr(__import__(module, fromlist=[name]), name))


def test_every_field_of_every_document_is_described() -> None:
    text = generate.PARTS["json"]()
    for one in models():
        assert f"### {one.__name__}\n" in text
        meanings = generate.attributes(one)
        assert [name for name in one.model_fields if not meanings.get(name)] == [], one.__name__
    assert "<!-- generated: json -->" in (ROOT / "docs/reference/json.md").read_text()
