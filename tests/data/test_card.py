"""A dataset's card: what it says is true, and nothing in it is taken for markup."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import minari
import numpy as np
import pytest
from markdown_it import MarkdownIt
from markdown_it.token import Token

from cudc_bench.artefacts.k_schedule import k_schedule
from cudc_bench.artefacts.manifest import Base, Manifest, read_manifest
from cudc_bench.data.card import render_card
from cudc_bench.data.layout import MAIN_FILE
from cudc_bench.data.measure import measure_coverage, reward_statistics
from cudc_bench.data.reader import load_episodes

from ..conftest import TASKS

BASE, WALK = "walker/cudc-smoke-v0", "walker/walk/cudc-smoke-v0"


def card(root: Path, dataset_id: str) -> str:
    return (root / dataset_id / "README.md").read_text(encoding="utf-8")


def cells(text: str) -> dict[str, list[str]]:
    """The rows of all tables by their first cell, as a reader sees them."""
    rows: dict[str, list[str]] = {}
    tokens = MarkdownIt("commonmark").enable("table").parse(text)
    inline: list[str] = []
    for token in tokens:
        if token.type == "tr_open":
            inline = []
        elif token.type == "inline":
            inline.append("".join(child.content for child in token.children or []))
        elif token.type == "tr_close":
            rows[inline[0]] = inline[1:]
    return rows


def test_every_dataset_has_a_card(smoke: Path) -> None:
    for one in (BASE, WALK):
        text = card(smoke, one)
        assert text.startswith(f'---\npretty_name: "{one}: ')
        for tag in ("minari", "offline-reinforcement-learning"):
            assert f"\n- {tag}\n" in text
        assert "\nlicense: mit\n" in text
        assert read_manifest(one).fingerprint in text
        assert f"    {read_manifest(one).command}\n" in text
        assert f"    cudc-bench verify {one}\n" in text
        assert "Sun, Qian, Miao 2024" in text
        assert cells(text)["batch_size"] == ["32"]
        assert not re.search(r"<<|>>|<%|%>|None|nan", text)
    assert "    cudc-bench relabel walker/cudc-smoke-v0\n" in card(smoke, BASE)
    assert "must lie below the same dataset root" in card(smoke, WALK)
    assert sorted(minari.list_local_datasets()) == sorted([BASE, *(f"walker/{task}/cudc-smoke-v0" for task in TASKS)])


def test_what_it_says_about_rewards_is_minaris(smoke: Path) -> None:
    episodes = [episode.rewards.astype(np.float64) for episode in minari.load_dataset(WALK).iterate_episodes()]
    steps, returns = np.concatenate(episodes), np.array([episode.sum() for episode in episodes])
    rows = cells(card(smoke, WALK))
    assert rows["steps"] == [f"{value:.4g}" for value in (steps.mean(), steps.std(), steps.min(), steps.max())]
    assert rows["returns of 3 full episodes"] == [f"{returns.mean():.4g}", f"{returns.std():.4g}", "", f"{returns.max():.4g}"]
    assert "All rewards are 0: this dataset belongs to no task." in card(smoke, BASE)


def test_coverage_is_that_of_all_observations(smoke: Path) -> None:
    """Against one matrix of all observations, in one go."""
    manifest = read_manifest(BASE)
    found = measure_coverage(smoke / BASE / "data" / MAIN_FILE, manifest)
    flat = load_episodes(BASE, ("observations", "actions"))
    observations, actions = flat.arrays["observations"].astype(np.float64), np.abs(flat.arrays["actions"])
    np.testing.assert_allclose(found.mean, observations.mean(0), rtol=1e-9)
    np.testing.assert_allclose(found.std, observations.std(0), rtol=1e-9)
    assert found.min.tolist() == observations.min(0).tolist()
    assert found.max.tolist() == observations.max(0).tolist()
    singular = np.linalg.svd(observations - observations.mean(0), compute_uv=False) ** 2
    shares = singular / singular.sum()
    assert found.effective_rank == pytest.approx(np.exp(-(shares * np.log(shares)).sum()), rel=1e-9)
    assert found.action_size == pytest.approx(actions.mean(dtype=np.float64), rel=1e-6)
    assert found.saturated == (actions >= 0.99).mean()
    points = observations[::2]
    assert found.points == len(points) == 1502
    distances = [np.sort(np.linalg.norm(points - point, axis=1))[12] for point in points]
    assert found.log_distance == pytest.approx(np.log(np.maximum(distances, 1e-3)).mean(), rel=1e-6)
    assert cells(card(smoke, BASE))["effective rank of the observations' covariance"] == [f"{found.effective_rank:.4g} of 24"]
    # A linked dataset's come through its links and are the same.
    assert measure_coverage(smoke / WALK / "data" / MAIN_FILE, read_manifest(WALK)).log_distance == found.log_distance


def test_uniform_actions_and_known_shapes(make_dataset: Callable, make_episodes: Callable, datasets: Path) -> None:
    """Isotropic observations have full rank; a dataset too small for neighbours or returns says so."""
    manifest = make_dataset("walker/made-v0", make_episodes([1000, 1000, 400], rewards=False))
    found = measure_coverage(datasets / "walker/made-v0" / "data" / MAIN_FILE, manifest)
    assert 23.5 < found.effective_rank <= 24.0
    assert found.action_size == pytest.approx(0.5, abs=0.01)
    assert found.saturated == pytest.approx(0.01, abs=0.003)
    small = make_dataset("walker/small-v0", make_episodes([4]))
    file = datasets / "walker/small-v0" / "data" / MAIN_FILE
    assert measure_coverage(file, small).log_distance is None
    assert reward_statistics(file, small).episodes == 0
    assert reward_statistics(file, small).return_mean is None
    assert cells(card(datasets, "walker/small-v0"))["mean log distance to the 12th-nearest of 5 observations"] == ["–"]


def test_the_card_follows_from_the_manifest_and_the_arrays(smoke: Path) -> None:
    manifest = read_manifest(BASE)
    file = smoke / BASE / "data" / MAIN_FILE
    description = minari.load_dataset(BASE).storage.metadata["description"]
    again = render_card(manifest, BASE, description, reward_statistics(file, manifest), measure_coverage(file, manifest))
    assert again == card(smoke, BASE)


def with_schedule(manifest: Manifest, steps: list[int], suspect: bool) -> Manifest:
    """The manifest of a collection in which k grew at those steps."""
    increments = [{"step": step, "old_k": 3 + row, "new_k": 4 + row, "p": 0.6, "mean_w": 0.1} for row, step in enumerate(steps)]
    return manifest.model_copy(update={"diagnostics": {"k_increments": increments, "k_schedule_suspect": suspect}})


@pytest.mark.parametrize("one", [BASE, WALK])
@pytest.mark.parametrize(("steps", "suspect"), [([84_000, 120_008], False), ([30_000, 84_000], True), ([], False)])
def test_when_k_grew_and_whether_that_is_suspect(one: str, steps: list[int], suspect: bool, smoke: Path) -> None:
    manifest = read_manifest(one)
    file = smoke / one / "data" / MAIN_FILE
    statistics = reward_statistics(file, manifest), measure_coverage(file, manifest)
    text = render_card(with_schedule(manifest, steps, suspect), one, "words", *statistics)
    growth = ", ".join(f"{3 + row}→{4 + row} at {step:,}" for row, step in enumerate(steps))
    assert cells(text).get("k grew") == ([growth] if growth else None)
    (caveats,) = re.findall(r"## Caveats\n\n(.*?)\n\n##", text, re.DOTALL)
    found = [line for line in caveats.splitlines() if "suspect" in line]
    assert len(found) == suspect
    if suspect:
        # Of a run of 3,000 steps.
        assert "k grew before 150 environment steps, or reached its bound within 300 steps" in found[0]
        assert f"({growth})" in found[0].replace("\\", "")


@pytest.mark.parametrize(
    "diagnostics",
    [
        {"k_increments": "x", "k_schedule_suspect": "yes"},
        {"k_increments": [1, None, {}, {"step": "<b>", "old_k": 3, "new_k": 4}, {"step": True, "old_k": 3, "new_k": 4}]},
        {"k_increments": {"step": 1}, "k_schedule_suspect": 1},
        {"k_increments": [{"step": 10**30, "old_k": 3, "new_k": 4}, {"step": -1, "old_k": 3, "new_k": 4}]},
    ],
)
def test_malformed_schedules_are_none(diagnostics: dict[str, object], smoke: Path) -> None:
    manifest = read_manifest(BASE).model_copy(update={"diagnostics": diagnostics})
    found = k_schedule(manifest.diagnostics)
    assert (found.growth, str(found), found.note) == ((), "", "")
    file = smoke / BASE / "data" / MAIN_FILE
    text = render_card(manifest, BASE, "words", reward_statistics(file, manifest), measure_coverage(file, manifest))
    assert "k grew" not in text


HOSTILE = [
    "<script>alert(1)</script>",
    "| a | b |",
    "**bold** [x](http://e) `c`",
    "line\nbreak\n# head",
    "<img src=x onerror=y>",
    "---\nx: y",
]


@pytest.mark.parametrize("text", HOSTILE)
def test_nothing_from_a_manifest_is_markup(text: str, smoke: Path) -> None:
    manifest = read_manifest(WALK)
    assert manifest.base is not None
    spoiled = manifest.model_copy(
        update={
            "method": text, "citation": text, "profile": text, "overrides": {text: text}, "hyperparameters": {text: [text]},
            "machine": {"processor": text}, "commit": text, "created": text, "versions": {text: text}, "command": text, "task": text,
            "base": Base(id=text, fingerprint=manifest.fingerprint, linked=True),
        }
    )  # fmt: skip
    file = smoke / WALK / "data" / MAIN_FILE
    statistics = reward_statistics(file, manifest), measure_coverage(file, manifest)
    plain, rendered = render_card(manifest, WALK, "words", *statistics), render_card(spoiled, WALK, text, *statistics)
    # The same blocks, but that one hyperparameter takes the place of many and one row tells of the overrides.
    row = ["tr_open", "td_open", "td_close", "td_open", "td_close", "tr_close"]
    blocks = [[token.type for token in parsed(one) if token.type != "inline"] for one in (plain, rendered)]
    assert len(blocks[0]) - len(manifest.hyperparameters) * len(row) == len(blocks[1]) - 2 * len(row)
    assert set(blocks[0]) == set(blocks[1])
    marks = [sorted({child.type for token in parsed(one) for child in token.children or []}) for one in (plain, rendered)]
    assert set(marks[1]) <= set(marks[0])
    assert "html_inline" not in marks[1]
    # The front matter stays one mapping: its title is one quoted line.
    head = rendered.split("\n---\n", 1)[0].splitlines()
    assert head[0] == "---"
    assert isinstance(json.loads(head[1].removeprefix("pretty_name: ")), str)
    assert head[2] == "license: mit"


def parsed(text: str) -> list[Token]:
    """The blocks of a card, without its front matter."""
    return MarkdownIt("commonmark").enable("table").parse(text.split("\n---\n", 1)[1])
