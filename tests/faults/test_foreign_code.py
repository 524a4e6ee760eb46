"""Code of others: plug-ins and reward functions that are broken, or that end the process."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

from cudc_bench import plugins
from cudc_bench.cli import app
from cudc_bench.cli.app import build_app
from cudc_bench.errors import RunError

from .helpers import COLLECT, refused
from .smalldisk import Ended

Main = Callable[..., Ended]
Install = Callable[[str, str], None]
GOOD = """
from cudc_bench.collectors.random import Random

class Method(Random):
    citation = "[bold]Nobody[/bold] [2026] \\x1b[31mred"
"""


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Install:
    """Puts a package into the environment: what it registers, and the module ``foreign`` that it consists of."""
    place = tmp_path / "site"

    def put(registered: str, source: str) -> None:
        info = place / "foreign-1.0.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: foreign\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(registered)
        (place / "foreign.py").write_text(source)
        monkeypatch.syspath_prepend(str(place))
        monkeypatch.delitem(__import__("sys").modules, "foreign", raising=False)
        # Entry points are looked up once in a process.
        monkeypatch.setattr(plugins, "_points", cache(plugins._points.__wrapped__))
        # The command line that the tests have ready knows nothing of it.
        monkeypatch.setattr(app, "build_app", build_app)

    return put


@pytest.mark.parametrize("kind", ["collectors", "evaluators", "commands"])
@pytest.mark.parametrize(
    ("source", "why"),
    [
        ("import sys; sys.exit(0)", "it ends the process when it is imported (exit code 0)"),
        ("1 / 0", "ZeroDivisionError: division by zero"),
        ("import nowhere", "No module named 'nowhere'"),
        ("Method = 3", "it is nothing that can be called"),
        ("", "module 'foreign' has no attribute 'Method'"),
    ],
)
def test_one_broken_plugin_is_named_and_left_out(kind: str, source: str, why: str, main: Main, install: Install) -> None:
    install(f"[cudc_bench.{kind}]\nforeign = foreign:Method\n", source)
    done = main("list")
    assert done.code == 0, done.err
    assert "Traceback" not in done.err
    (line,) = [line for line in done.err.splitlines() if "foreign:Method" in line]
    assert f"'foreign' (foreign:Method) of the package foreign is installed but cannot be used: {why}" in line
    assert "proto" in done.out
    assert "td3-bc" in done.out
    with pytest.raises(RunError, match="of the package foreign is installed but cannot be used"):
        plugins.load(kind, "foreign")


def test_a_command_with_parameters_that_nobody_knows_is_left_out(main: Main, install: Install) -> None:
    install("[cudc_bench.commands]\nforeign = foreign:Method\n", "def Method(one: 'Nowhere'): ...")
    done = main("list")
    assert done.code == 0, done.err
    assert "the command 'foreign' (foreign:Method) of the package foreign is installed but cannot be used" in done.err


def test_what_a_plugin_says_of_itself_is_shown_as_it_is(main: Main, install: Install) -> None:
    install("[cudc_bench.collectors]\nforeign = foreign:Method\n", GOOD)
    done = main("list")
    assert done.code == 0, done.err
    assert "\x1b" not in done.out
    shown = "".join(done.out.split())
    assert r"[bold]Nobody[/bold]" in shown
    assert r"\x1b[31mred" in shown


CONFIGURED = """
from dataclasses import dataclass
from cudc_bench.collectors.ddpg import DDPG, DDPGConfig
from cudc_bench.settings.config import PositiveInt

@dataclass(frozen=True)
class Config(DDPGConfig):
    \"\"\"Its values.

    Attributes:
        wideness: how wide its \x1b[31m``mind`` is.
    \"\"\"

    wideness: PositiveInt = 7

class Method(DDPG):
    \"\"\"Explores [bold]elsewhere[/bold].\"\"\"

    config_class = Config
    family, citation = "wandering", "Nobody 2026"
"""


def test_somebody_elses_method_is_shown_as_ours_are(main: Main, install: Install) -> None:
    install("[cudc_bench.collectors]\nforeign = foreign:Method\n", CONFIGURED)
    done = main("show", "foreign")
    assert (done.code, done.err) == (0, "")
    assert "\x1b" not in done.out
    lines = [line.strip() for line in done.out.splitlines()]
    assert "from: Nobody 2026" in lines
    assert "package: foreign 1.0" in lines
    assert "Explores [bold]elsewhere[/bold]." in lines
    at = lines.index("wideness: integer (≥ 1), default 7")
    assert lines[at + 1] == "7 at every profile"
    assert lines[at + 2].endswith("mind is")
    assert "paper 1024, cpu 128, demo 128, smoke 16" in lines  # of the width that it inherits


@pytest.mark.parametrize(
    ("source", "why"),
    [
        ("1 / 0", "ZeroDivisionError"),
        (CONFIGURED.replace("config_class = Config", "config_class = 3"), "its config_class is no dataclass."),
        (CONFIGURED.replace("wideness: PositiveInt = 7", "wideness: PositiveInt = field(kw_only=True)"), "missing 1 required keyword-only"),
        (CONFIGURED.replace("PositiveInt = 7", "'Nowhere' = 7"), "name 'Nowhere' is not defined."),
    ],
)
def test_a_broken_one_is_named_when_it_is_to_be_shown(source: str, why: str, main: Main, install: Install) -> None:
    install("[cudc_bench.collectors]\nforeign = foreign:Method\n", source.replace("import dataclass\n", "import dataclass, field\n"))
    refused(
        main("show", "foreign"), 1, "the method 'foreign' (foreign:Method) of the package foreign is installed but cannot be used: ", why
    )


@pytest.mark.parametrize("words", [["list"], ["show", "walk"]])
def test_a_broken_domain_is_named_and_left_out(words: list[str], main: Main, install: Install) -> None:
    install("[cudc_bench.domains]\nforeign = foreign:DOMAIN\n", "DOMAIN = 3")
    done = main(*words)
    assert done.code == 0, done.err
    assert done.err.startswith("left out: the domain 'foreign' is registered as int;")
    assert "quadruped" in done.out
    refused(main("show", "foreign"), 1, "the domain 'foreign' is registered as int")


def test_a_method_that_ends_the_process_is_no_success(main: Main, install: Install) -> None:
    install("[cudc_bench.collectors]\nforeign = foreign:Method\n", GOOD + "    def act(self, *a, **k): raise SystemExit(0)\n")
    done = main("collect", "--method", "foreign", *COLLECT[3:])
    refused(done, 1, "foreign.py' line 6 called for the end of the process (exit code 0) before the work was done")


@pytest.mark.parametrize(
    ("source", "why"),
    [
        ("import sys; sys.exit(0)", "--reward cannot import 'foreign': SystemExit: 0."),
        ("def hop(measured): raise SystemExit(0)", "the reward function foreign:hop failed: SystemExit: 0."),
    ],
)
def test_a_reward_that_ends_the_process_is_no_success(source: str, why: str, main: Main, install: Install, smoke: Path) -> None:
    install("", source)
    done = main("relabel", "walker/cudc-smoke-v0", "--reward", "foreign:hop")
    assert done.code in {1, 2}, done.err
    refused(done, done.code, why)


def test_a_command_that_ends_the_process_is_no_success(main: Main, install: Install) -> None:
    install("[cudc_bench.commands]\nforeign = foreign:Method\n", "import sys\ndef Method(): sys.exit(0)\n")
    refused(main("foreign"), 1, "foreign.py' line 2 called for the end of the process")
