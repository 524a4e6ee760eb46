"""Two datasets side by side against independent routes: counts by hand, a sine whose spectrum is known, datasets that are the same."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image, ImageSequence

import cudc_bench
from cudc_bench import plugins
from cudc_bench.artefacts.ids import rooted_at
from cudc_bench.artefacts.manifest import read_manifest
from cudc_bench.data.reader import load_episodes
from cudc_bench.envs import check_domain
from cudc_bench.errors import RunError, UsageError
from cudc_bench.leaderboard.datasets.pair import Axis, Pair, Side, _Spectrum, _visits, compare_pair
from cudc_bench.leaderboard.datasets.quality import Quality
from cudc_bench.leaderboard.output import film
from cudc_bench.leaderboard.output.media import find_pairs
from cudc_bench.leaderboard.show.figures.drawing import figure_files
from cudc_bench.leaderboard.show.figures.pair import draw_spectra
from cudc_bench.settings.seeding import episode_seed

FIRST, SECOND = "walker/cudc-smoke-v0", "walker/random-smoke-v0"


class Sketch:
    """Draws one grey picture for each state, as bright as the seed is large."""

    backend = "none"

    def __init__(self, domain: str, task: str | None, camera: str, width: int, height: int, gl: str | None) -> None:
        self._shape = (height, width, 3)
        self.asked: list[tuple[int, NDArray[np.float64]]] = []

    def __enter__(self) -> Sketch:
        return self

    def __exit__(self, *_: object) -> None:
        drawn.append(self)

    def frames(self, seed: int, states: NDArray[np.float64]) -> Iterator[NDArray[np.uint8]]:
        self.asked.append((seed, states))
        for index in range(len(states)):
            yield np.full(self._shape, (40 * len(self.asked) + index) % 256, np.uint8)


drawn: list[Sketch] = []


@pytest.fixture(scope="module")
def both(collected_once: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A root with datasets of two methods."""
    root = tmp_path_factory.mktemp("both") / "datasets"
    shutil.copytree(collected_once, root)
    with rooted_at(root):
        cudc_bench.collect("random", "walker", [1], profile="smoke", workers=1)
    return root


@pytest.fixture(autouse=True)
def here(both: Path, datasets: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(both))


@pytest.fixture(scope="module")
def pair(both: Path) -> Pair:
    with rooted_at(both):
        return compare_pair(FIRST, SECOND, ["com_velocity_x", "torso_height"])


def test_a_map_has_the_shares_of_states(pair: Pair) -> None:
    """Counted here one by one, from the states' quantities."""
    domain = check_domain("walker")
    relabeler = plugins.load("relabelers", "walker")(domain)
    for side in pair.sides:
        flat = load_episodes(side.quality.id, ("infos/physics", "actions"))
        counts = np.zeros((32, 20))
        for physics, actions in zip(flat.split("infos/physics"), flat.split("actions"), strict=True):
            for height, _, speed, _ in relabeler.quantities(physics[1:], actions):
                counts[min(max(int((speed + 8) // 0.5), 0), 31), min(max(int(height // 0.1), 0), 19)] += 1
        assert counts.sum() == side.manifest.steps
        np.testing.assert_allclose(side.visits, counts / counts.sum(), atol=2 / counts.sum())
    assert 0.0 < pair.shared < 1.0


def test_each_side_is_what_stats_measures(pair: Pair) -> None:
    (table,) = cudc_bench.measure_quality([FIRST, SECOND], None).tables
    assert [side.quality for side in pair.sides] == list(table.datasets)[::-1]
    assert pair.table.group == table.group == "smoke"


def test_what_is_spread_alike_is_shared() -> None:
    states = np.random.default_rng(0).uniform(0, 1, (500, 2))
    x = y = Axis("one", np.linspace(0, 1, 6))
    visits = _visits(x, y, states)
    apart = _visits(x, y, np.full((3, 2), 7.0))  # beyond the range, and so in the last cell
    assert apart[-1, -1] == 1.0
    facts = check_domain("walker")

    def shared(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
        nothing = Quality("a", None, {}, None, None, (), 0.0, None)  # type: ignore[arg-type]
        return Pair(facts, x, y, np.zeros(0), (Side(nothing, first, None), Side(nothing, second, None))).shared

    assert shared(visits, visits) == pytest.approx(1.0)
    assert shared(visits, apart) == pytest.approx(visits[-1, -1])


def test_a_spectrum_finds_a_sine_and_keeps_the_variance() -> None:
    """The variance of 0.5 sin is 1/8, all of it near 3 Hz; noise has its own in all bands alike."""
    generator = np.random.default_rng(0)
    seconds = np.arange(1000) * 0.025
    found, noise = _Spectrum(256), _Spectrum(256)
    found.add((0.5 * np.sin(2 * np.pi * 3.0 * seconds)[:, None] + [0.3, 0.3]).astype(np.float32))
    for _ in range(20):
        noise.add(generator.normal(0, 0.2, (1000, 3)).astype(np.float32))
        noise.add(np.ones((100, 3), np.float32))  # shorter than a piece
    assert found.mean is not None
    assert noise.mean is not None
    frequencies = np.fft.rfftfreq(256, 0.025)
    assert frequencies[found.mean.argmax()] == pytest.approx(3.0, abs=0.1)
    assert found.mean.sum() == pytest.approx(0.125, rel=0.02)
    assert found.mean[np.abs(frequencies - 3.0) < 0.5].sum() == pytest.approx(found.mean.sum(), rel=1e-3)
    assert noise.mean.sum() == pytest.approx(0.04, rel=0.05)
    assert noise.mean[2:-1].std() < 0.15 * noise.mean[2:-1].mean()
    assert _Spectrum(256).mean is None


@pytest.mark.parametrize(
    ("first", "second", "quantities", "message"),
    [
        (FIRST, FIRST, None, "with itself"),
        (FIRST, "walker/nothing-v0", None, "there is no dataset"),
        (FIRST, "walker/run/cudc-smoke-v0", None, "is labelled for run; name its base"),
        (FIRST, SECOND, ["torso_hight", "torso_upright"], "Did you mean 'torso_height'"),
        (FIRST, SECOND, ["torso_height"], "two different quantities, not torso_height"),
        (FIRST, SECOND, ["torso_height", "torso_height"], "two different quantities"),
    ],
)
def test_what_cannot_be_compared_is_refused(first: str, second: str, quantities: list[str] | None, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        compare_pair(first, second, quantities)


@pytest.mark.parametrize("seconds", [-1.0, 61.0, float("nan")])
def test_the_length_of_a_scene_is_checked(seconds: float) -> None:
    with pytest.raises(UsageError, match="--seconds takes 0 to 60"):
        cudc_bench.compare_datasets(FIRST, SECOND, None, seconds=seconds)


def test_a_film_shows_the_middle_of_three_episodes_of_each(pair: Pair, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(film, "Drawer", Sketch)
    monkeypatch.setattr(film, "find_ffmpeg", lambda: None)
    path = film.write_film(tmp_path, pair, 0.4)
    with Image.open(path) as picture:
        assert picture.size == (648, 240)
        # Equal frames are one that stays longer.
        assert sum(frame.info["duration"] for frame in ImageSequence.Iterator(picture)) == 3 * 11 * 40
    asked = drawn.pop().asked
    assert len(asked) == 6
    for place, side in enumerate(pair.sides):
        states = load_episodes(side.quality.id, ("infos/physics",)).split("infos/physics")
        for scene, index in enumerate((0, 1, 2)):
            seed, shown = asked[2 * scene + place]
            assert seed == episode_seed(1, "environment", index)
            np.testing.assert_array_equal(shown, list(states)[index][492 + np.round(np.arange(11) * 1.6).astype(int)])


def test_where_nothing_draws_there_is_a_remark(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*_: object) -> None:
        raise RunError("nothing here can draw.")

    monkeypatch.setattr(film, "Drawer", none)
    report = cudc_bench.compare_datasets(FIRST, SECOND, tmp_path)
    assert report.remarks == ["there is no film: nothing here can draw."]
    assert {file.name for file in report.files} == {
        "quality.md", "quality.csv", "pair.json", *(f"{name}.{kind}" for name in ("map", "density", "spectra") for kind in ("svg", "pdf")),
    }  # fmt: skip
    ((kept, names),) = find_pairs(tmp_path).values()
    assert kept == report.pair.summary
    assert "map.svg" in names
    for side, one in zip(kept.sides, (FIRST, SECOND), strict=True):
        assert (side.id, side.fingerprint, side.method) == (one, read_manifest(one).fingerprint, one.split("/")[1].split("-")[0])
    assert list(kept.sides[0].rewards) == ["stand", "walk", "run", "flip"]


def test_an_axis_of_less_than_a_power_has_no_formulas(pair: Pair) -> None:
    flat = np.linspace(1.2e-3, 4e-3, len(pair.frequencies))
    close = replace(pair, sides=(replace(pair.sides[0], spectrum=flat), replace(pair.sides[1], spectrum=flat[::-1])))
    shown = figure_files("spectra", lambda: draw_spectra(close), ["svg"])["spectra.svg"].decode()
    assert "mathdefault" not in shown
    assert {">0.001<", ">0.01<"} <= set(re.findall(">[0-9.]+<", shown))


def test_the_command_says_what_there_is(both: Path, cli: Callable[..., Any], tmp_path: Path) -> None:
    done = cli("compare", FIRST, SECOND, "--seconds", "0", "--output", str(tmp_path), env={"MINARI_DATASETS_PATH": str(both)})
    assert done.code == 0, done.err
    assert "of the states are in the same cells of torso_height and torso_upright" in done.out
    assert (tmp_path / "walker.cudc-smoke-v0.walker.random-smoke-v0.pair" / "map.svg").is_file()
