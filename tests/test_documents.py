"""The code in the documents runs."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from cudc_bench.collectors.base import Space
from tests.collectors.helpers import batch_for

ROOT = Path(__file__).resolve().parent.parent


def blocks(name, language="python"):
    found = re.findall(rf"^( *)```{language}\n(.*?)^ *```", (ROOT / name).read_text(), re.DOTALL | re.MULTILINE)
    return [re.sub(rf"^{indent}", "", code, flags=re.MULTILINE) for indent, code in found]


def test_the_readmes_python_runs_as_a_program(tmp_path):
    (code,) = blocks("README.md")
    program = tmp_path / "program.py"
    program.write_text(code)
    done = subprocess.run([sys.executable, program], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("(3000, 24) (3000, 6) 0.0")
    assert len(list((tmp_path / "results").rglob("*.json"))) == 1


def test_the_example_of_a_collector_learns():
    (code,) = blocks("CONTRIBUTING.md")
    names: dict = {"__name__": "example"}
    exec(compile(code, "CONTRIBUTING.md", "exec"), names)
    kind = names["Surprise"]
    collector = kind(Space("walker", 24, 6, 1000, 4000, 2), kind.config_class(width=32, batch_size=64, learning_rate=1e-3), [1, 2])
    batch = batch_for(collector, size=64, measure=True)
    first = collector.update(batch)["loss_forward"]
    for _ in range(100):
        last = collector.update(batch)["loss_forward"]
    # The surprise of what is seen again and again falls.
    assert (last < 0.8 * first).all()
    assert collector.act(torch.randn(2, 24)).shape == (2, 6)


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md", "docs/architecture.md", "benchmarks/README.md"])
def test_links_and_paths_of_the_documents_exist(name):
    text = (ROOT / name).read_text()
    links = [link for link in re.findall(r"\]\(([^)#]+)\)", text) if "://" not in link]
    paths = re.findall(r"`((?:cudc_bench|collectors|relabelers|evaluators|leaderboard|benchmarks|tests|docs)/[\w/.]*)`", text)
    assert links + paths
    missing = [link for link in links if not ((ROOT / name).parent / link).exists()] + [p for p in paths if not (ROOT / p).exists()]
    assert not missing
