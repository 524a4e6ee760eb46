"""Pictures of the leaderboard's site for the README: ``make screenshots RECORDS=results``. Needs Chromium and the extra [dev].

``python docs/screenshots.py domains leaderboard/site/pictures`` draws the site's pictures of the domains, still and moving; needs EGL or
OSMesa.
"""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

from playwright.sync_api import sync_playwright

import cudc_bench
from cudc_bench.envs.domains import DOMAINS

WIDTH, HEIGHT = 1200, 1000
SECONDS, RATE = 5, 10  # of a moving picture, and frames in each of them
HELD = 12  # steps that a random action lasts in it
SETTLED = 8  # steps without an action, after which a body stands or falls as it does


def main(records: str, output: str) -> None:
    """The comparison with the most methods in daylight, and the first task's page of it in the dark."""
    chromium = shutil.which("chromium")
    if chromium is None:
        sys.exit("there is no chromium; install it with: apt-get install chromium")
    folder = Path(output)
    folder.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory() as place, sync_playwright() as driver:
        report = cudc_bench.make_leaderboard(records, place, datasets=False)
        table = max(report.tables, key=lambda one: len(one.headings))
        task = next(line.labels[0] for line in table.grid.parts[-1].lines if any(line.entries))
        browser = driver.chromium.launch(executable_path=chromium, args=["--no-sandbox"] if os.geteuid() == 0 else [])
        pages: tuple[tuple[str, str, Literal["light", "dark"]], ...] = (
            ("overview", f"{table.slug.rpartition('.')[0]}/index.html", "light"),
            ("task", f"{table.slug}/task-{task}.html", "dark"),
        )
        for name, page, mode in pages:
            context = browser.new_context(
                viewport={"width": WIDTH, "height": HEIGHT}, device_scale_factor=2, color_scheme=mode, offline=True
            )  # fmt: skip
            shown = context.new_page()
            shown.goto((Path(place) / page).as_uri())
            shown.screenshot(path=folder / f"{name}.png")
            print(folder / f"{name}.png")
            context.close()
        browser.close()


def draw_domains(output: str) -> None:
    """Each domain a few steps after a reset, and how it moves by random actions from there on."""
    import gymnasium
    import numpy as np
    from PIL import Image

    for name in DOMAINS:
        environment = gymnasium.make(f"cudc_bench/{name}-v0", render_mode="rgb_array", width=480, height=360)
        environment.reset(seed=3)
        for _ in range(SETTLED):
            environment.step(np.zeros(environment.action_space.shape, np.float32))
        path = Path(output) / f"{name}.webp"
        Image.fromarray(environment.render()).save(path, quality=82, method=6)
        print(path)
        rng, step = np.random.default_rng(1), 1 / environment.metadata["render_fps"]
        frames, action, shown = [], np.zeros(environment.action_space.shape, np.float32), 0
        for t in range(round(SECONDS / step)):
            if t % HELD == 0:
                action = np.asarray(rng.uniform(-1, 1, action.shape), np.float32)
            environment.step(action)
            if (t + 1) * step * RATE >= shown + 1:
                frames.append(Image.fromarray(environment.render()).resize((280, 210), Image.Resampling.LANCZOS))
                shown += 1
        path = path.with_name(f"{name}-moving.webp")
        frames[0].save(path, save_all=True, append_images=frames[1:], duration=round(1000 / RATE), loop=0, quality=40, method=6)
        print(path)


if __name__ == "__main__":
    if sys.argv[1] == "domains":
        draw_domains(sys.argv[2])
    else:
        main(*sys.argv[1:3])
