"""``cudc-bench show``: everything that has a name, completely, in any terminal."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import pytest

from cudc_bench import plugins
from cudc_bench.envs.domains import DOMAINS
from cudc_bench.envs.layouts import observation_layout
from cudc_bench.settings.described import default_text
from cudc_bench.settings.profiles import PROFILES

NAMES = {
    **dict.fromkeys(("cudc", "cudc-vary-icm", "random", "apt-ksched"), "collectors"),
    **dict.fromkeys(("td3", "cql-fixed", "rebrac"), "evaluators"),
}


@pytest.mark.parametrize("name", NAMES)
def test_a_method_is_shown_with_every_hyperparameter(name: str, here: Callable) -> None:
    done = here(["show", name])
    assert (done.code, done.err) == (0, "")
    kind = plugins.load(NAMES[name], name)
    words = " ".join(done.out.split())
    assert f"from: {' '.join(kind.citation.split())}" in words
    assert (f"category: {kind.category} " if NAMES[name] == "collectors" else "is: ") in words
    for field in dataclasses.fields(kind.config_class):
        assert f" {field.name}: " in words
        assert f"default {default_text(field.default).strip('`')}" in words
    for one, value in kind.values.items():
        assert f"{one}={default_text(value).strip('`')}" in words


def test_values_are_shown_for_each_profile(here: Callable) -> None:
    lines = [line.strip() for line in here(["show", "cudc-no-vary"]).out.splitlines()]
    width = lines.index("width: integer (≥ 1), default 1024")
    assert lines[width + 1 : width + 3] == ["paper 1024, cpu 128, demo 128, smoke 16", "of the hidden layers"]
    # A variant's own value is the one of its runs.
    assert lines[lines.index("k_max: integer (≥ 1), default 6") + 1] == "3 at every profile"
    assert lines[lines.index("steps: integer (≥ 1), default 1_000_000") + 1] == "paper 1_000_000, cpu 400_000, demo 100_000, smoke 3000"


@pytest.mark.parametrize("name", DOMAINS)
def test_a_domain_is_shown_with_what_its_numbers_are(name: str, here: Callable) -> None:
    done = here(["show", name])
    assert (done.code, done.err) == (0, "")
    words = done.out.replace(",", " ").replace(":", " ").split()
    for block in observation_layout(name):
        assert {block.name, *block.elements} <= set(words)
    assert {*DOMAINS[name].tasks, *DOMAINS[name].quantities} <= set(words)
    assert f"Action ({DOMAINS[name].action_size} numbers" in done.out


def test_a_name_is_shown_in_every_sense_that_it_has(here: Callable) -> None:
    out = here(["show", "walk"]).out
    assert "walk: task of walker (--domain walker --task walk)" in out
    assert "walk: task of quadruped (--domain quadruped --task walk)" in out
    assert "Stand, walk and run are dm_control's" in out


@pytest.mark.parametrize("name", PROFILES)
def test_a_profile_is_shown_with_what_it_changes(name: str, here: Callable) -> None:
    done = here(["show", name])
    assert (done.code, done.err) == (0, "")
    words = " ".join(done.out.split())
    for values in (PROFILES[name].collect, PROFILES[name].evaluate):
        for one, value in values.items():
            assert f"{one} {default_text(value).strip('`')}" in words


def test_what_nobody_knows_is_refused(here: Callable) -> None:
    done = here(["show", "cudk"])
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert "unknown name 'cudk'; allowed: aps, " in done.err
    assert done.err.endswith("Did you mean 'cudc'?\n")


@pytest.mark.parametrize("columns", [60, 80])
def test_it_fits_narrow_terminals(columns: int, here: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    for name in ("cudc", "cql", "quadruped", "walk", "smoke"):
        assert max(map(len, here(["show", name]).out.splitlines())) <= columns


def test_it_loads_no_torch(python: Callable) -> None:
    script = """
import sys
from cudc_bench.cli import show
for name in ("cudc", "td3", "walker", "walk", "smoke"):
    show.show(name)
print(sorted({name.split(".")[0] for name in sys.modules} & {"torch", "minari"}), file=sys.stderr)
"""
    done = python(script)
    assert (done.code, done.err) == (0, "[]\n")
