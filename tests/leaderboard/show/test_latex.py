"""Every LaTeX file that a leaderboard writes compiles, texts of strangers included, where there is a TeX."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from cudc_bench.artefacts.records import Record
from cudc_bench.leaderboard.api import make_leaderboard

LATEX = shutil.which("pdflatex")
HOSTILE = "\\input{/etc/passwd} % $x^2$ & # _ ~ { } -- ``q'' é \\\\[3pt] \\end{table}"


@pytest.mark.skipif(LATEX is None, reason="there is no pdflatex: apt-get install texlive-latex-recommended")
def test_every_tex_file_compiles(
    example_records: list[Record], make_record: Callable[..., Record], save: Callable[..., Path], tmp_path: Path
) -> None:
    hostile = [make_record(method=m, seed=seed, overrides={"note": HOSTILE}) for m in ("cudc", "cudc-no-pe") for seed in (1, 2)]
    report = make_leaderboard(
        save(*[one for one in example_records if one.dataset.used is None], *hostile), tmp_path / "out", datasets=False
    )
    files = sorted(path for path in report.files if path.suffix == ".tex")
    assert {path.name for path in files} >= {"table.tex", "overall.tex", "paper.tex", "ablation.tex", "k-bound.tex"}
    inputs = "\n".join(f"\\input{{{path.relative_to(tmp_path)}}}\\clearpage" for path in files)
    (tmp_path / "all.tex").write_text(
        f"\\documentclass{{article}}\n\\usepackage{{booktabs}}\n\\begin{{document}}\n{inputs}\n\\end{{document}}\n"
    )
    assert LATEX is not None
    done = subprocess.run(
        [LATEX, "-halt-on-error", "-interaction=nonstopmode", "all.tex"], cwd=tmp_path, capture_output=True, text=True, errors="replace"
    )
    assert done.returncode == 0, done.stdout[-2000:]
    assert "root:" not in done.stdout
