"""The code in the documents runs."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from .waiting import PATIENCE

ROOT = Path(__file__).resolve().parent.parent


def blocks(name, language="python"):
    found = re.findall(rf"^( *)```{language}\n(.*?)^ *```", (ROOT / name).read_text(), re.DOTALL | re.MULTILINE)
    return [re.sub(rf"^{indent}", "", code, flags=re.MULTILINE) for indent, code in found]


def test_the_readmes_python_runs_as_a_program(tmp_path):
    (code,) = [code for code in blocks("README.md") if "__main__" in code]
    program = tmp_path / "program.py"
    program.write_text(code)
    done = subprocess.run([sys.executable, program], cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("(3000, 24) (3000, 6) 0.0")
    assert len(list((tmp_path / "results").rglob("*.json"))) == 1


def test_the_readme_shows_the_example_package_as_it_is():
    named = [code.split("\n", 1) for language in ("python", "toml") for code in blocks("README.md", language)]
    shown = {first.removeprefix("# "): code for first, code in named if first.startswith("# examples/")}
    assert set(shown) == {f"examples/plugin/{name}" for name in ("cudc_bench_re3.py", "pyproject.toml", "test_re3.py")}
    for path, code in shown.items():
        # Of the tests only the part that every package needs is shown.
        whole = (ROOT / path).read_text()
        assert code in whole if path.endswith("test_re3.py") else code == whole, path


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md", "docs/architecture.md", "benchmarks/README.md"])
def test_links_and_paths_of_the_documents_exist(name):
    text = (ROOT / name).read_text()
    links = [link for link in re.findall(r"\]\(([^)#]+)\)", text) if "://" not in link]
    paths = re.findall(r"`((?:cudc_bench|collectors|relabelers|evaluators|leaderboard|benchmarks|tests|docs|examples)/[\w/.]*)`", text)
    assert links + paths
    missing = [link for link in links if not ((ROOT / name).parent / link).exists()] + [p for p in paths if not (ROOT / p).exists()]
    assert not missing


def test_every_test_that_a_promise_names_exists():
    named = re.findall(r"`([a-z_/]+\.py)::(test_[a-z_]+)`", (ROOT / "docs" / "trust.md").read_text())
    rows = [line for line in (ROOT / "docs" / "trust.md").read_text().splitlines() if line.startswith("| ") and "---" not in line]
    assert sum("::test_" in row for row in rows) == len(rows) - 7  # the heads of the tables
    for path, test in named:
        assert f"def {test}(" in (ROOT / path).read_text(), (path, test)
