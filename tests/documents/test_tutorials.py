"""What the documents tell people to run runs, at the smoke profile, and leaves what they say."""

from __future__ import annotations

import importlib.util
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import pytest

import cudc_bench
from cudc_bench.cli.app import main
from cudc_bench.envs.drawing import probe

from .. import served
from ..waiting import PATIENCE
from .pages import PAGES, ROOT, block, blocks, commands

FIRST, LEARNER, METHOD = (f"docs/tutorials/{name}.md" for name in ("first-number", "own-learner", "own-method"))
REWARD, DOMAIN, DATA = (f"docs/tutorials/{name}.md" for name in ("own-reward", "own-domain", "read-data"))
CHEETAH = "docs/tutorials/gymnasium-domain.md"
POLICIES = "docs/how-to/policies.md"
pytestmark = pytest.mark.slow
# Every block of Python in the documents, by a text that it alone contains, and what runs it.
RUN = {
    ("README.md", "__main__"): "test_the_readmes_program",
    (FIRST, "total_steps"): "test_a_first_number",
    (FIRST, "read_record"): "test_a_first_number",
    (FIRST, "__main__"): "test_a_first_number_from_python",
    (REWARD, "def hop"): "test_own_rewards",
    (REWARD, "def careful"): "test_own_rewards",
    (DOMAIN, "__main__"): "test_another_domain",
    (DATA, "rewards.sum"): "test_minari_reads",
    (DATA, "options="): "test_an_episode_goes_on",
    (DATA, "to_d3rlpy"): "tests/data/test_exports.py::test_the_documents_exports_run",
    (DATA, "import jax"): "test_jax_trains",
    (POLICIES, "torch.export.load"): "test_policies_leave",
    (POLICIES, "render_policy"): "test_policies_leave",
    (
        "docs/how-to/zero-shot.md",
        "ask_policy",
    ): "tests/evaluators/zero_shot/test_running.py::test_a_user_asks_and_sees_the_video",
    (METHOD, "class RE3("): "tests/test_plugin.py",
    (METHOD, "class TestRE3"): "tests/test_plugin.py",
    (LEARNER, "class AWAC("): "tests/test_plugin.py",
    (LEARNER, "class TestAWAC"): "tests/test_plugin.py",
    (CHEETAH, "class HalfCheetah"): "tests/test_plugin.py",
    (CHEETAH, "class TestHalfCheetah"): "tests/test_plugin.py",
}


def at_smoke(text: str) -> str:
    """What a page says, with the profile that takes seconds, and ids of datasets that were collected at it."""
    text = re.sub(r"\b(cudc|random)(?:-demo|-smoke)?-v0", r"\1-smoke-v0", text)
    return re.sub(r"(results/)(?:demo|cpu)\b", r"\1smoke", "smoke" if text in {"demo", "cpu"} else text)


@pytest.fixture
def run(environment: dict[str, str], tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., str]:
    """Runs a program's text as a file in ``tmp_path``, in a new process or in a forked one, and returns what it printed."""

    def done(code: str, anew: bool = False, brief: bool = False) -> str:
        program = tmp_path / "program.py"
        program.write_text(at_smoke(code))
        if not anew and served.can_serve(environment):
            found = served.run_program(program, environment, tmp_path_factory.mktemp("said"), brief)
            assert found.code == 0, found.err
            return found.out
        command = [sys.executable, "program.py"]
        found = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=PATIENCE)
        assert found.returncode == 0, found.stderr
        return found.stdout

    return done


@pytest.fixture
def here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], ready_command_line: None
) -> Callable[..., str]:
    """Gives a command of ours in this process, which spares the seconds of loading PyTorch, in ``tmp_path`` at the smoke profile; returns
    what it printed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CUDC_BENCH_PROFILE", "smoke")

    def done(*words: str) -> str:
        capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            main(list(words))
        found = capfd.readouterr()
        assert ended.value.code == 0, (words, found.err)
        return found.out

    return done


@pytest.fixture
def follow(here: Callable[..., str]) -> Callable[..., list[str]]:
    """Gives all commands of ours in a page, in their order, at the smoke profile and with short films; returns what they printed.

    One command may be ``brief``, see :func:`served.briefly`."""

    def done(page: str, brief: str = "") -> list[str]:
        found = []
        for _, (program, *words) in commands(page):
            if program == "cudc-bench":
                with served.briefly() if words[0] == brief else nullcontext():
                    found.append(here(*map(at_smoke, words), *(("--seconds", "0.2") if words[0] == "compare" else ())))
        return found

    return done


def test_every_block_of_python_is_run_somewhere() -> None:
    everywhere = [(one.page, one.code) for page in PAGES for one in blocks(page, "python")]
    for page, code in everywhere:
        assert sum(where == page and text in code for where, text in RUN) == 1, f"of {page} nobody runs:\n{code}"
    assert len(everywhere) == len(RUN)
    for test in RUN.values():
        path, _, name = test.rpartition("::") if "::" in test else ("", "", test)
        assert (ROOT / test).exists() if test.endswith(".py") else f"def {name}" in (ROOT / path if path else Path(__file__)).read_text()


def test_the_readmes_program(run: Callable[..., str], tmp_path: Path) -> None:
    assert run(block("README.md", "__main__"), anew=True).startswith("(3000, 24) (3000, 6) 0.0")
    assert len(list((tmp_path / "results").rglob("*.json"))) == 1


def test_a_first_number(follow: Callable[[str], list[str]], run: Callable[..., str], tmp_path: Path) -> None:
    printed = follow(FIRST)
    assert "random" in printed[-1]
    assert (tmp_path / "report" / "index.html").exists()
    assert run(block(FIRST, "total_steps")).splitlines() == ["3000 3", "(1001, 24) (1000, 6)"]
    record = json.loads((tmp_path / "results/smoke/walker/walk/cudc-smoke-v0/td3-seed1.json").read_text())
    shown = float(run(block(FIRST, "read_record")))
    returns = [value for one in [*record["late"], record["final"]] for value in one["returns"]]
    assert shown == pytest.approx(sum(returns) / len(returns))


def test_a_first_number_from_python(run: Callable[..., str]) -> None:
    assert run(block(FIRST, "__main__")).startswith("(3000, 24) (3000, 6) 0.0")


def test_own_rewards(follow: Callable[[str], list[str]], here: Callable[..., str], tmp_path: Path) -> None:
    (tmp_path / "my_rewards.py").write_text(block(REWARD, "def hop") + block(REWARD, "def careful"))
    follow(REWARD)
    assert (tmp_path / "results/smoke/walker/hop/cudc-smoke-v0/td3-seed1.json").exists()
    here("relabel", "walker/cudc-smoke-v0", "--reward", "my_rewards:careful")


def test_another_domain(follow: Callable[[str], list[str]], run: Callable[..., str]) -> None:
    follow(DOMAIN)
    assert "dm_control/cheetah_run/run/random-smoke-v0" in run(block(DOMAIN, "__main__"))


def test_minari_reads(run: Callable[..., str], smoke: Path) -> None:
    assert run(block(DATA, "rewards.sum")).startswith("(1001, 24) (1000, 6) ")


def test_an_episode_goes_on(run: Callable[..., str], smoke: Path) -> None:
    code = block(DATA, "options=")
    if probe() is None:
        code = code.replace("environment.render().shape", "(480, 480, 3)")
    assert run(code) == "True (480, 480, 3)\n"


def test_jax_trains(run: Callable[..., str], smoke: Path) -> None:
    if importlib.util.find_spec("jax") is None:
        pytest.skip("JAX is not installed")
    assert 0 < float(run(block(DATA, "import jax"))) < 1


def test_policies_leave(here: Callable[..., str], run: Callable[..., str], smoke: Path, tmp_path: Path) -> None:
    with served.briefly():  # a film lasts as long as the episode
        here("evaluate", "--algo", "td3", "--task", "walk")
    folder = tmp_path / "results/smoke/walker/walk/cudc-smoke-v0"
    code = block(POLICIES, "render_policy")
    if probe() is None:
        code = re.sub(r".*render_policy.*\n", "", code)
    given = "import numpy as np\n\nobservation = np.zeros((2, 24), np.float32)\n"
    assert run(f"{given}{code}print(action.shape)", brief=True).strip() == "(2, 6)"
    assert probe() is None or (tmp_path / "walk.gif").exists()
    shutil.copy(folder / "td3-seed1.pt2", tmp_path)
    given = "import torch\n\nobservation = torch.zeros(2, 24)\n"
    assert run(f"{given}{block(POLICIES, 'torch.export.load')}print(tuple(action.shape))", anew=True).strip() == "(2, 6)"


def test_what_looks_at_results_looks(here: Callable[..., str], follow: Callable[[str], list[str]], smoke: Path, tmp_path: Path) -> None:
    here("collect", "--method", "random")
    with served.briefly():
        here("evaluate", "--algo", "td3", "--task", "walk")
    for name in ("diagnostics", "leaderboard", "verify"):
        follow(f"docs/how-to/{name}.md", brief="rerun")
        assert name == "verify" or list((tmp_path / "report").iterdir())
        shutil.rmtree(tmp_path / "report", ignore_errors=True)


def test_what_is_published_stands_by_itself(here: Callable[..., str], smoke: Path) -> None:
    ours = [words[1:] for _, words in commands("docs/how-to/publish.md") if words[0] == "cudc-bench"]
    for words in ours[:2]:
        here(*map(at_smoke, words))
    shutil.rmtree(smoke / "walker" / "cudc-smoke-v0")
    assert cudc_bench.load_transitions("walker/walk/cudc-smoke-v0", verify=True).rewards.shape == (3000,)


def test_a_suite_of_ones_own_is_planned(here: Callable[..., str], tmp_path: Path) -> None:
    (code,) = [one.code for one in blocks("docs/how-to/studies.md", "toml")]
    (tmp_path / "my.toml").write_text(code)
    for suite in ("my.toml", "main"):
        here("run", suite, "--dry-run")
