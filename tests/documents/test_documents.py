"""The code in the documents fits the code of the project: commands parse, imports resolve, files that are shown are as they are.

What takes longer, running it, is in ``test_tutorials.py``.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import typer

from cudc_bench import plugins
from cudc_bench.envs import check_domain
from cudc_bench.errors import CudcBenchError
from cudc_bench.settings.collect_config import CollectConfig
from cudc_bench.settings.config import check_settings, parse_settings
from cudc_bench.settings.evaluate_config import EvaluateConfig, OnlineConfig
from cudc_bench.settings.profiles import PROFILES
from cudc_bench.settings.seeds import parse_seeds
from cudc_bench.suites.definition import load_suite, suite_names

from .pages import PAGES, ROOT, blocks, commands, spans

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
# What a page may import that the tests' environment lacks: extras, and a library that is no part of any.
OPTIONAL = {"d3rlpy", "torchrl", "jax"}
# Programs that are not ours, whose arguments nothing here can check, and why they are not run.
UNCHECKED = {
    "#!/bin/bash": "begins a script of Slurm",
    "#SBATCH": "an option of Slurm, which needs a cluster",
    "head=$(scontrol": "needs a cluster of Slurm",
    "head": "takes what the one before it says",
    "srun": "needs a cluster of Slurm",
    "ray": "needs a cluster, or starts one; tests/suites/test_cluster.py runs a suite on one",
    "source": "changes the shell that it is given to",
}  # fmt: skip
# Names that stand for somebody's own, and where they come from.
PLACEHOLDERS = {
    "re3": "examples/plugin",
    "awac": "examples/learner",
    "half_cheetah": "examples/domain",
    "my_rewards:hop": "docs/tutorials/own-reward.md",
    "all": "every one",
    "mixture": "what mix makes of several",
    "expert": "what tiers makes of a training",
    "medium": "what tiers makes of a training",
}
_CLICK: type[Exception] = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")


def known(kind: str, names: str) -> None:
    for name in names.split(","):
        if name not in PLACEHOLDERS:
            plugins.check_name(kind, name)


def check_command(words: list[str], group: Any) -> None:
    """Refuse a command line of ours that the command line would refuse before it looks at any file."""
    if words[1] == "COMMAND":
        return
    name, *arguments = [word for word in words[1:] if word not in {"--debug", "--quiet", "-q", "…"}] or ["--help"]
    if name in {"--help", "--version", "--install-completion", "--show-completion"}:
        return
    assert name in group.commands, f"there is no command {name}"
    if "--help" in arguments:
        return
    values = group.commands[name].make_context(name, [*arguments]).params
    if values.get("method"):
        known("collectors", values["method"])
    if values.get("methods"):
        known("collectors", values["methods"])
    for algo in ("algo", "algos"):
        if values.get(algo):
            known("evaluators", values[algo])
    if values.get("profile"):
        assert values["profile"] in {*PROFILES, "auto"}
    if values.get("seeds"):
        parse_seeds(values["seeds"])
    if values.get("suite") and not values["suite"].endswith(".toml"):
        assert values["suite"] in {*suite_names(), "SUITE"}
    # One name stands for one in every command, but ``run`` narrows to domains that its suite has.
    domain = values.get("domain")
    named = domain and "," not in domain and domain not in PLACEHOLDERS and name != "run"
    tasks = check_domain(domain).tasks if named else None
    for task in (values.get("tasks") or "all").split(","):
        assert task == "all" or tasks is None or task in tasks, f"{domain} has no task {task}"
    if values.get("settings") and list(values["settings"]) != ["name=value"]:
        kinds = [plugins.load(kind, one).config_class for kind in ("collectors", "evaluators") for one in plugins.names(kind)]
        check_settings(parse_settings(values["settings"]), [*kinds, EvaluateConfig, OnlineConfig, CollectConfig])


def check_other(words: list[str]) -> None:
    """Refuse a command of another program that names what is not here."""
    program, *arguments = words
    if program in UNCHECKED:
        return
    if program == "make":
        assert re.search(rf"^{arguments[0]}:", (ROOT / "Makefile").read_text(), re.MULTILINE), f"there is no target {arguments[0]}"
    elif program in {"pip", "pytest", "python", ".ci/run"}:
        for extra in re.findall(r"cudc-bench\[(\w+)\]", " ".join(arguments)):
            assert extra in PROJECT["optional-dependencies"]
        if "-c" in arguments and program == "python":
            compile(arguments[1], "the command line", "exec")
        else:
            paths = [ROOT / one for one in [program, *arguments] if "/" in one and not one.startswith(("walker/", "-"))]
            assert all(path.exists() for path in paths), paths
    else:
        assert words[:3] == ["python3", "-m", "venv"], f"nobody knows {program}"


@pytest.mark.parametrize("page", PAGES)
def test_every_command_of_a_page_would_be_accepted(page: str, command_line: Any) -> None:
    problems = []
    # In a sentence the name alone stands for the command, whatever that needs.
    said = [(0, words if len(words) > 2 else [*words, "--help"]) for words in spans(page)]
    for line, words in [*commands(page), *said]:
        try:
            if words[0] == "cudc-bench":
                check_command(words, command_line)
            else:
                check_other(words)
        except (AssertionError, CudcBenchError, _CLICK) as error:
            problems.append(f"{page}:{line}: {' '.join(words)}: {getattr(error, 'message', error) or type(error).__name__}")
    assert not problems


@pytest.mark.parametrize("page", PAGES)
def test_every_python_block_of_a_page_compiles_and_finds_what_it_imports(page: str) -> None:
    for one in blocks(page, "python"):
        for node in ast.walk(ast.parse(one.code, str(one))):
            if isinstance(node, ast.Import):
                modules = {alias.name: [] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                modules = {str(node.module): [alias.name for alias in node.names]}
            else:
                modules = {}
            for name, members in modules.items():
                if name.split(".")[0] in OPTIONAL and importlib.util.find_spec(name.split(".")[0]) is None:
                    continue
                module = importlib.import_module(name)
                missing = [member for member in members if member != "annotations" and not hasattr(module, member)]
                assert not missing, (str(one), missing)
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "cudc_bench":
                assert hasattr(importlib.import_module("cudc_bench"), node.attr), (str(one), node.attr)


@pytest.mark.parametrize("page", PAGES)
def test_every_toml_block_of_a_page_parses_and_suites_load(page: str, tmp_path: Path) -> None:
    for one in blocks(page, "toml"):
        if {"methods", "suites"} & set(tomllib.loads(one.code)):
            (tmp_path / "own.toml").write_text(one.code)
            assert load_suite(str(tmp_path / "own.toml")).studies


def test_every_block_has_a_language_that_is_checked() -> None:
    languages = {one.language for page in PAGES for one in blocks(page)}
    assert languages <= {"", "bash", "text", "python", "toml"}


@pytest.mark.parametrize(
    ("page", "package", "files"),
    [
        ("docs/tutorials/own-method.md", "plugin", ("cudc_bench_re3.py", "pyproject.toml", "test_re3.py")),
        ("docs/tutorials/own-learner.md", "learner", ("cudc_bench_awac.py", "pyproject.toml", "test_awac.py")),
        ("docs/tutorials/gymnasium-domain.md", "domain", ("cudc_bench_half_cheetah.py", "pyproject.toml", "test_half_cheetah.py")),
    ],
)  # fmt: skip
def test_a_tutorial_shows_its_example_package_as_it_is(page: str, package: str, files: tuple[str, ...]) -> None:
    named = [one.code.split("\n", 1) for one in blocks(page, "python", "toml")]
    shown = {first.removeprefix("# "): code for first, code in named if first.startswith("# examples/")}
    assert set(shown) == {f"examples/{package}/{name}" for name in files}
    for path, code in shown.items():
        # Of the tests only the part that every package needs is shown.
        whole = (ROOT / path).read_text()
        assert code in whole if Path(path).name.startswith("test_") else code == whole, path


@pytest.mark.parametrize("page", PAGES)
def test_links_and_paths_of_a_page_exist(page: str) -> None:
    text = (ROOT / page).read_text()
    links = [link for link in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", text) if "://" not in link]
    folders = "cudc_bench|collectors|relabelers|evaluators|leaderboard|benchmarks|tests|docs|examples|studies"
    # Gymnasium's ids look like paths.
    paths = [path for path in re.findall(rf"`((?:{folders})/[\w/.-]*)`", text) if not re.search(r"-v\d$", path)]
    missing = [link for link in links if not ((ROOT / page).parent / link).exists()] + [p for p in paths if not (ROOT / p).exists()]
    assert not missing


def test_the_readme_is_a_page() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= 150


def test_every_page_is_in_the_table_of_contents() -> None:
    index = (ROOT / "docs" / "index.md").read_text()
    listed = {
        f"docs/{line}.md" for found in re.findall(r"```\{toctree\}\n(.*?)```", index, re.DOTALL) for line in found.split() if line[0] != ":"
    }
    assert {page for page in PAGES if page.startswith("docs/")} - {"docs/index.md"} <= listed


def test_every_method_is_in_the_reference() -> None:
    text = (ROOT / "docs" / "reference" / "methods.md").read_text()
    registered = [(kind, name) for kind in ("collectors", "evaluators") for name in plugins.names(kind)]
    ours = [name for kind, name in registered if plugins.target(kind, name)[0].startswith("cudc_bench.")]
    # The bounds of k are given as a range.
    assert [name for name in ours if f"`{name}`" not in text and "kmax" not in name] == []


def test_every_environment_variable_is_in_the_reference() -> None:
    page = (ROOT / "docs" / "reference" / "environment.md").read_text()
    found: set[str] = set()
    for folder in ("cudc_bench", "collectors", "relabelers", "evaluators", "leaderboard"):
        for path in (ROOT / folder).rglob("*.py"):
            text = path.read_text()
            found |= set(re.findall(r"environ(?:\.get\(|\.setdefault\(|\[)\"(\w+)\"", text)) | set(re.findall(r"envvar=\"(\w+)\"", text))
            found |= set(re.findall(r"\"(CUDC_BENCH_[A-Z]+)\"", text))
    assert {"MINARI_DATASETS_PATH", "CUDC_BENCH_PROFILE", "CUDC_BENCH_THRESHOLDS", "MUJOCO_GL"} <= found
    assert [name for name in sorted(found) if f"`{name}`" not in page] == []


def test_every_test_that_a_promise_names_exists() -> None:
    promises = (ROOT / "docs" / "explanation" / "trust.md").read_text()
    named = re.findall(r"`([a-z_/]+\.py)::(test_[a-z_]+)`", promises)
    rows = [line for line in promises.splitlines() if line.startswith("| ") and "---" not in line]
    assert sum("::test_" in row for row in rows) == len(rows) - 7  # the heads of the tables
    for path, test in named:
        assert f"def {test}(" in (ROOT / path).read_text(), (path, test)
