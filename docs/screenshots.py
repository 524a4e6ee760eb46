"""Pictures of the leaderboard's site for the README: ``make screenshots RECORDS=results``. Needs Chromium and the extra [dev]."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

from playwright.sync_api import sync_playwright

import cudc_bench

WIDTH, HEIGHT = 1200, 1000


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


if __name__ == "__main__":
    main(*sys.argv[1:3])
