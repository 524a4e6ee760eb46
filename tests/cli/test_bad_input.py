"""Thousands of wrong command lines: each is refused in one line, exit code 2, with nothing written anywhere.

Each attack is a command line that would work but for one word, and a strategy for that word whose every example is wrong. The message must
name what is wrong, so that no attack passes because something else stopped it.
"""

from __future__ import annotations

import importlib
import os
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from cudc_bench import plugins
from cudc_bench.cli import app
from cudc_bench.cli.app import main
from cudc_bench.envs import DOMAINS
from cudc_bench.settings.profiles import PROFILES
from cudc_bench.suites.definition import suite_names

from ..evaluators.runs import write_run

EXAMPLES, LEAST = 20, 17  # drawn for each attack, and how many of them must differ
LONGEST_ANSWER = 3_000  # characters

# ----------------------------------------------------------------------------------------------------------------------- strategies

# What drives a terminal, ends a string in C, turns text around or looks like something else.
CONTROLS = ("\0", "\x1b[31m", "\x1b]0;title\x07", "\r", "\n", "\x9b2J", "\u202e", "\u2066", "\u2028", "\x7f", "\ufeff", "\udcff", "\u200b")
DRIVING = tuple(text for text in CONTROLS if not text.isspace())
LOOK_ALIKES = {
    "a": "а",
    "c": "с",
    "e": "е",
    "o": "о",
    "i": "і",
    "k": "κ",
    "r": "г",
    "d": "ԁ",
    "s": "ѕ",
    "1": "١",
    "0": "０",
    "/": "∕",
    "-": "‐",
}
anything = st.text(st.characters(), max_size=12)  # with lone surrogates: bytes that are not UTF-8 reach a program as these


def splits(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip()]


@st.composite
def spoiled(draw: st.DrawFn, good: list[str], put: tuple[str, ...]) -> str:
    """A good word with something put in somewhere."""
    word = draw(st.sampled_from(good))
    at = draw(st.integers(0, len(word)))
    return word[:at] + draw(st.sampled_from(put)) + word[at:]


@st.composite
def disguised(draw: st.DrawFn, good: list[str]) -> str:
    """A good word with a letter that only looks the same, or with none that is small."""
    word = draw(st.sampled_from(good))
    able = [at for at, letter in enumerate(word) if letter in LOOK_ALIKES]
    if not able:
        return word.upper() + "X"
    at = draw(st.sampled_from(able))
    return word[:at] + LOOK_ALIKES[word[at]] + word[at + 1 :]


def not_among(good: list[str], several: bool = False) -> st.SearchStrategy[str]:
    """What is none of some names; where several may be given by commas, what is none at all or holds at least one wrong name."""

    def is_bad(text: str) -> bool:
        parts = splits(text) if several else [text]
        return not parts or not set(parts) <= set(good)

    near = st.sampled_from(good).flatmap(
        lambda name: st.sampled_from(
            [name + "x", name[:-1], name[1:], name.upper(), "../" + name, name + "/", f"{name},nothing", f"-{name}"]
        )
    )
    long = st.integers(100, 20_000).map(lambda size: "x" * size)
    return (spoiled(good, CONTROLS) | disguised(good) | near | anything | long | st.just("") | st.just(",")).filter(is_bad)


GOOD_IDS = ["walker/mine-v0", "walker/walk/mine-seed2-v3", "ab/c-v12"]
bad_ids = (
    spoiled(GOOD_IDS, (*CONTROLS, "..", ".", " ", "é", "A", "\\", "%2e", "~", "*", "$", ":", "//", "'", "`"))
    | disguised(GOOD_IDS)
    | st.sampled_from(["../", "/", "./", "~/", "/tmp/", "data/", "walker/data/", "-", "../" * 9, "aa/bb/cc/dd/ee/"]).map(
        lambda start: f"{start}{GOOD_IDS[0]}"
    )
    | st.sampled_from(["walker", "walker/mine", "mine-v0", "walker/mine-v", "walker/mine-v01", "walker/mine-v-1", "walker/mine-v1000000"])
    | st.integers(101, 9_000).map(lambda size: f"walker/{'m' * size}-v0")
    | st.integers(65, 9_000).map(lambda size: f"{'w' * size}/mine-v0")
    | anything.map(lambda text: f"{text}/..")
)
no_int = (
    st.sampled_from(
        ["", " ", "1.5", "1e3", "nan", "inf", "-inf", "1e999", "0x10", "one", "1,2", "--", "9" * 5_000, "½", "1__0", "_1", "1_"]
    )
    | spoiled(["10", "200"], (*DRIVING, " ", "x", ",", ".5", "é"))
    | anything.map(lambda text: f"{text}?")
).filter(lambda text: not _is_int(text))
below_one = st.integers(max_value=0).map(str) | no_int
negative = st.integers(max_value=-1).map(str) | no_int
beyond = st.integers(10**11, 10**400).map(str)
bad_seeds = (
    st.sampled_from(["", ",", "1,", "-1", "1-", "5-1", "0-1000", "1.5", "nan", "inf", "1e3", "0x1", "9" * 10, "9" * 5_000, "0-999,1000"])
    | spoiled(["1-3", "2,4"], (*DRIVING, "x", ".", "--", ",,", "e"))
    | disguised(["1-3", "10"])
    | st.integers(max_value=-1).map(str)
    | anything.map(lambda text: f"{text}?")
)
no_number = st.sampled_from(["", "nan", "inf", "-inf", "1e999", "-1e999", "NaN", "Infinity", "one", "1,5", "[1]", "{}", "null", "0x1p3"])
no_value = (spoiled(["1", "true", "[1, 2]"], ("¿",)) | anything.map(lambda text: f"¿{text}")).map(lambda text: text.strip())
bad_names = (
    spoiled(["steps", "width"], (*CONTROLS, ".", "__", "-")) | disguised(["discount", "steps"]) | anything.map(lambda text: f"{text}?")
)
bad_settings = (
    st.sampled_from(["", "=", "=1", " =1", "steps", "stesp=5", "STEPS=5", "__class__=1", "steps =", "--set", "width"])
    | bad_names.map(lambda name: f"{name}=1")
    | anything.map(lambda text: text.replace("=", ":"))
)
bad_paths = (
    spoiled(["report", "a/b"], ("\0", "\x1b[2J", "\n", "\udcff", "\x9b", "\x07", "\r"))
    | st.integers(256, 9_000).map(lambda size: "x" * size)
    | st.integers(60, 500).map(lambda count: "/".join(["x" * 50] * count))
    | st.sampled_from(["", "file", "file/below", "./file/", "/dev/null", "/dev/null/below", "folder/../file/a/b"])
    | anything.map(lambda text: f"\0{text}")
)
# No system lets a NUL into an environment, and an empty value there is none.
bad_roots = bad_paths.filter(lambda path: path != "" and "\0" not in path)
# Where no option takes the word, these would be options themselves.
plain_ids = bad_ids.filter(lambda one: not one.startswith("-"))


def _is_int(text: str) -> bool:
    try:
        int(text)
    except ValueError:
        return False
    return True


def _is_name(text: str) -> bool:
    return re.fullmatch("[a-z0-9][a-z0-9_-]{0,31}", text) is not None


def spoiled_names(good: list[str]) -> st.SearchStrategy[str]:
    return not_among(good, several=True)


def settings_of(names: str, values: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    return st.builds(lambda name, value: f"{name}={value}", st.sampled_from(names.split()), values)


def file_like(suffix: str) -> st.SearchStrategy[str]:
    """Outputs that cannot be files of a kind."""
    return (
        bad_paths.filter(lambda path: path not in {"file", "./file/", "/dev/null"}).map(lambda path: f"{path}/x{suffix}" if path else "")
        | spoiled(["video", "a/b"], ("\0", "\n", "\udcff")).map(lambda path: path + suffix)
        | st.sampled_from([f"folder{suffix}", "x.exe", "x", f"x{suffix}x", ".", "..", "folder", "é.PNG"])
        | st.integers(300, 5_000).map(lambda size: "x" * size + suffix)
    )


# -------------------------------------------------------------------------------------------------------------------------- attacks


class Attack(NamedTuple):
    """A command line with one wrong word, and what the refusal must say."""

    line: str
    bad: st.SearchStrategy[str]
    says: str


def attack(line: str, bad: st.SearchStrategy[str], says: str) -> Attack:
    """``BAD`` in the line is the wrong word; ``NAME=BAD`` before the command, an environment variable."""
    return Attack(line, bad, says)


MAIN = ["random", "icm", "apt", "proto", "aps", "cudc"]
methods, algos = plugins.names("collectors"), plugins.names("evaluators")
profiles, devices = [*PROFILES, "auto"], ["auto", "cpu", "cuda"]
tasks = [*DOMAINS["walker"].tasks, "all"]
SHOWN = [*methods, *algos, *DOMAINS, *PROFILES, *(task for domain in DOMAINS.values() for task in domain.tasks)]
some_tasks = spoiled_names(tasks).filter(lambda text: text.strip() != "all")
domains = not_among(list(DOMAINS)) | spoiled(["dm_control/cheetah-run"], CONTROLS) | disguised(["dm_control/cheetah-run"])
bad_references = (
    spoiled(["hops:hop", "os.path:join"], (*CONTROLS, "/", "..", " ", "é", "-", "::", "(", ";", "$"))
    | st.sampled_from(["", ":", "hops", "hops:", ":hop", "hops.py:hop:", "hops:hop()", "./hops:hop", "hops:hop.x", "1hops:hop", "hops,hop"])
    | anything.map(lambda text: f"{text}?:hop")
)
methods_of_import = (not_among(["proto", "my-own"], several=True) | anything.map(lambda text: f"{text}?")).filter(
    lambda text: len(splits(text)) != 1 or not set(splits(text)[0]) <= set("abcdefghijklmnopqrstuvwxyz0123456789-_") or len(text) > 64
)
missing_records = bad_paths.filter(lambda path: path not in {"file", "./file/"}) | st.sampled_from(
    ["nowhere.json", "folder", ".", "a/b/c.json"]
)

ATTACKS = [
    attack("collect --method BAD", spoiled_names(methods), "method"),
    attack("collect --method random --seed 7 --domain BAD", domains, "unknown domain"),
    attack("collect --method random --seeds BAD", bad_seeds, "--seeds cannot"),
    attack("collect --method random --seed 7 --profile BAD", not_among(profiles), "unknown profile"),
    attack("collect --method random --seed 7 --device BAD", not_among(devices), "unknown device"),
    attack("collect --method random --seed 7 --workers BAD", below_one, "--workers"),
    attack("collect --method random --seed 7 --dataset-id BAD", bad_ids, "is not a dataset id"),
    attack("collect --method random --seed 7 --log BAD", not_among(["tensorboard", "wandb"]), "unknown log"),
    attack("collect --method random --seed 7 --log tensorboard --log-dir BAD", bad_paths, "log folder"),
    attack("collect --method random --seed 7 --log-dir BAD", bad_paths, "log folder"),
    attack("collect --method random --seed 7 --set BAD", bad_settings, ""),
    attack("collect --method cudc --seed 7 --set BAD", settings_of("steps width batch_size k_max neighbours", below_one), "cannot be"),
    attack("collect --method cudc --seed 7 --set BAD", settings_of("steps width horizon seed_steps", beyond), "cannot be"),
    attack("collect --method cudc --seed 7 --set BAD", settings_of("learning_rate c_k noise_std discount", no_number), "cannot be"),
    attack("collect --method smm --seed 7 --set BAD", settings_of("discriminator_weight kl_weight novelty_weight", no_number), "cannot be"),
    attack(
        "collect --method cudc --seed 7 --set BAD",
        settings_of("entropy reach td_discount k_rule loss_weights steps alpha inverse learning_rate", no_value),
        "cannot be",
    ),
    attack("collect --method cudc-vary-icm --seed 7 --set BAD", settings_of("c_e k_steps milestone", no_value), ""),
    attack("collect --method random --seed 7 BAD", anything.map(lambda text: f"{text}?"), ""),
    attack("collect --method random --seed 7 BAD=1", anything.map(lambda text: f"--{text}?".replace("=", ":")), "No such option"),
    attack("MINARI_DATASETS_PATH=BAD collect --method random --seed 7", bad_roots, "dataset root"),
    attack(
        "CUDC_BENCH_PROFILE=BAD collect --method random --seed 7",
        not_among([*profiles, ""]).filter(lambda name: "\0" not in name),
        "unknown profile",
    ),
    attack(
        "CUDC_BENCH_THRESHOLDS=BAD collect --method cudc-vary-icm --seed 7",
        bad_roots.filter(lambda path: path not in {"file", "./file/", "/dev/null"}),
        "thresholds",
    ),
    attack("pilot --method BAD", spoiled_names([*methods, "all"]), "method"),
    attack("pilot --domain BAD", domains, "unknown domain"),
    attack("pilot --profile BAD", not_among(profiles), "unknown profile"),
    attack("pilot --device BAD", not_among(devices), "unknown device"),
    attack("pilot --workers BAD --method cudc-vary-icm", below_one, "--workers"),
    attack("pilot --set BAD", settings_of("width k_max batch_size", below_one), "cannot be"),
    attack("pilot --set BAD", bad_settings, ""),
    attack(
        "CUDC_BENCH_THRESHOLDS=BAD pilot --method cudc-vary-icm",
        bad_roots.filter(lambda path: path not in {"file", "./file/", "/dev/null"}),
        "thresholds",
    ),
    attack("import-exorl BAD --method proto", bad_paths | st.sampled_from(["nowhere", "folder", "."]), "'"),
    attack("import-exorl episodes --method BAD", methods_of_import, "method"),
    attack("import-exorl episodes --method proto --domain BAD", domains, "unknown domain"),
    attack("import-exorl episodes --method proto --task BAD", some_tasks.filter(splits), "task"),
    attack("import-exorl episodes --method proto --steps BAD", below_one | beyond, "--steps"),
    attack("import-exorl episodes --method proto --seed BAD", bad_seeds, "--seed"),
    attack("import-exorl episodes --method proto --source BAD", spoiled(["ExORL", "URLB"], (*CONTROLS, "/", "<", "é", "|")), "source"),
    attack("import-exorl episodes --method proto --dataset-id BAD", bad_ids | st.just(""), "is not a dataset id"),
    attack("MINARI_DATASETS_PATH=BAD import-exorl episodes --method proto", bad_roots, "dataset root"),
    attack("relabel BAD --overwrite", plain_ids, "is not a dataset id"),
    attack("relabel walker/cudc-smoke-v0 BAD --overwrite", plain_ids, "is not a dataset id"),
    attack("relabel --overwrite --domain BAD", domains, "unknown domain"),
    attack("relabel walker/cudc-smoke-v0 --overwrite --domain BAD", domains, "unknown domain"),
    attack("relabel --overwrite --method BAD", spoiled_names([*methods, "cudc"]), ""),
    attack("relabel --overwrite --tasks BAD", some_tasks, "task"),
    attack("relabel --overwrite --method random --seed 7 --tasks BAD", some_tasks, "task"),
    attack("relabel --overwrite --seeds BAD", bad_seeds, "--seeds cannot"),
    attack("relabel walker/cudc-smoke-v0 --overwrite --seeds BAD", bad_seeds, "--seeds cannot"),
    attack("relabel --overwrite --profile BAD", not_among(profiles), "unknown profile"),
    attack("relabel walker/cudc-smoke-v0 --overwrite --profile BAD", not_among(profiles), "unknown profile"),
    attack("relabel walker/cudc-smoke-v0 --overwrite --workers BAD", below_one, "--workers"),
    attack("relabel walker/cudc-smoke-v0 --overwrite --reward BAD", bad_references, "--reward takes module:function"),
    attack("relabel --overwrite --method random --seed 7 --reward BAD", bad_references, "--reward takes module:function"),
    attack("MINARI_DATASETS_PATH=BAD relabel walker/cudc-smoke-v0", bad_roots, "dataset root"),
    attack("evaluate --task walk --algo BAD", spoiled_names(algos), "algo"),
    attack("evaluate --task walk --domain BAD", domains, "unknown domain"),
    attack("evaluate --dataset-id walker/walk/cudc-smoke-v0 --domain BAD", domains, "unknown domain"),
    attack("evaluate --tasks BAD", some_tasks, "task"),
    attack("evaluate --task walk --method random --seed 7 --tasks BAD", some_tasks, "task"),
    attack("evaluate --task walk --method BAD", spoiled_names([*methods, "cudc"]), "method"),
    attack("evaluate --task walk --seeds BAD", bad_seeds, "--seeds cannot"),
    attack("evaluate --task walk --training-seeds BAD", bad_seeds, "--training-seeds cannot"),
    attack("evaluate --task walk --profile BAD", not_among(profiles), "unknown profile"),
    attack("evaluate --task walk --steps BAD", below_one | beyond, "--steps"),
    attack("evaluate --task walk --set BAD", bad_settings, ""),
    attack("evaluate --task walk --set BAD", settings_of("width batch_size gradient_steps final_episodes", below_one), "cannot be"),
    attack("evaluate --task walk --set BAD", settings_of("learning_rate discount critic_tau noise_std", no_number), "cannot be"),
    attack("evaluate --task walk --set BAD", settings_of("milestones", no_value | below_one.map(lambda one: f"[{one}]")), "milestone"),
    attack(
        "evaluate --dataset-id BAD",
        (bad_ids | st.just("")).filter(lambda one: one.strip(", ") == one or one.strip(", ") != GOOD_IDS[0]),
        "",
    ),
    attack("evaluate --task walk --dataset-size BAD", below_one.filter(lambda one: "," not in one) | beyond, ""),
    attack("evaluate --dataset-id walker/cudc-smoke-v0 --reward BAD", bad_references, "--reward takes module:function"),
    attack("evaluate --method random --seed 7 --reward BAD", bad_references, "--reward takes module:function"),
    attack("evaluate --task walk --output BAD", bad_paths, "output"),
    attack("evaluate --task walk --device BAD", not_among(devices), "unknown device"),
    attack("evaluate --task walk --workers BAD", below_one, "--workers"),
    attack("evaluate --task walk --log BAD", not_among(["tensorboard", "wandb"]), "unknown log"),
    attack("evaluate --task walk --log tensorboard --log-dir BAD", bad_paths, "log folder"),
    attack(
        "evaluate --task walk --checkpoint-every BAD",
        no_number | st.floats(max_value=-1e-300).map(repr) | anything.map(lambda text: f"{text}?"),
        "--checkpoint-every",
    ),
    attack("MINARI_DATASETS_PATH=BAD evaluate --task walk", bad_roots, "dataset root"),
    attack("run BAD", not_among(suite_names()).filter(lambda text: not text.startswith("-")), "suite"),
    attack("run BAD.toml", bad_paths.filter(lambda path: not path.startswith("-")), "suite"),
    attack("run main --methods BAD", spoiled_names([*MAIN, "nothing"]), "method"),
    attack("run main --domains BAD", spoiled_names(["walker", "quadruped", "jaco"]), "domain"),
    attack("reference --domain BAD", domains, "unknown domain"),
    attack("reference --tasks BAD", some_tasks, "task"),
    attack("reference --task walk --seeds BAD", bad_seeds, "--seeds cannot"),
    attack("reference --task walk --profile BAD", not_among(profiles), "unknown profile"),
    attack("reference --task walk --set BAD", bad_settings, ""),
    attack("reference --task walk --set BAD", settings_of("steps width evaluations update_every final_episodes", below_one), "cannot be"),
    attack("reference --task walk --set BAD", settings_of("learning_rate discount exploration_std noise_std", no_number), "cannot be"),
    attack("reference --task walk --output BAD", bad_paths, "output"),
    attack("reference --task walk --device BAD", not_among(devices), "unknown device"),
    attack("reference --task walk --workers BAD", below_one, "--workers"),
    attack("reference --task walk --log BAD", not_among(["tensorboard", "wandb"]), "unknown log"),
    attack("reference --task walk --log tensorboard --log-dir BAD", bad_paths, "log folder"),
    attack("run main --tasks BAD", spoiled_names([*tasks, "jump"]).filter(lambda text: not {"all"} & set(splits(text))), "task"),
    attack("run main --algos BAD", spoiled_names(algos), "algo"),
    attack("run main --seeds BAD", bad_seeds, "--seeds cannot"),
    attack("run main --profile BAD", not_among([*profiles, ""]), "unknown profile"),
    attack("run main --output BAD", bad_paths, "output"),
    attack("run main --report BAD", bad_paths, "report"),
    attack("run main --device BAD", not_among(devices), "unknown device"),
    attack("run main --workers BAD", below_one, "--workers"),
    attack("run main --keep BAD", not_among(["datasets", "records"]), "--keep"),
    attack("run main --ray BAD", anything.map(lambda text: f"{text}?".replace(":", ".")), "--ray"),
    attack("run main --ray-root folder --ray-cpus BAD", below_one | st.integers(1, 99).map(str), "--ray"),
    attack("run main --ray-gpus BAD", no_number | st.floats(max_value=-1e-300).map(repr), "--ray"),
    attack("run my.toml BAD --dry-run", anything.map(lambda text: f"{text}?"), ""),
    attack("MINARI_DATASETS_PATH=BAD run main", bad_roots, "dataset root"),
    attack("render BAD --output video.gif", missing_records, "record"),
    attack("render run/td3-seed1.json --output video.gif --episodes BAD", below_one | beyond, "--episodes"),
    attack("render run/td3-seed1.json --output video.gif --seed BAD", negative, "seed"),
    attack("render run/td3-seed1.json --output video.gif --width BAD", below_one | beyond, "--width"),
    attack("render run/td3-seed1.json --output video.gif --height BAD", below_one | beyond, "--height"),
    attack("render run/td3-seed1.json --output video.gif --fps BAD", no_number | st.floats(max_value=0.9).map(repr), "--fps"),
    attack(
        "render run/td3-seed1.json --output video.gif --camera BAD",
        not_among(["side", "back", "0", "1"]) | st.sampled_from(["9" * 5_000, "2", "-1", "٢"]),
        "no camera",
    ),
    attack("render run/td3-seed1.json --output video.gif --reward BAD", bad_references, "trained on walk"),
    attack("render run/td3-seed1.json --output BAD", file_like(".gif"), ""),
    attack("export BAD", missing_records, "record"),
    attack("export run/td3-seed1.json --output BAD", file_like(".pt2"), ""),
    attack("leaderboard BAD", bad_paths.filter(lambda path: "file" not in path) | st.sampled_from(["nowhere", "folder", "a/b"]), ""),
    attack("leaderboard run --output BAD", bad_paths, "output"),
    attack("leaderboard run --profile BAD", not_among(["smoke"]), "no record has the profile"),
    attack("leaderboard run --domain BAD", not_among(["walker"]), "no record has the domain"),
    attack("leaderboard run --algo BAD", not_among(["td3"]), "no record has the algo"),
    attack("submit BAD --by ann", bad_paths.filter(lambda path: "file" not in path) | st.sampled_from(["nowhere", "folder", "a/b"]), ""),
    attack("submit run --by BAD", not_among(["ann", "bob-2"]).filter(lambda name: not _is_name(name)), "--by"),
    attack("submit run --by ann --url BAD", bad_paths | anything.map(lambda text: f"{text} https://"), "--url"),
    attack(
        "submit run --by ann --note BAD", spoiled(["a note"], DRIVING) | st.just("") | st.integers(301, 9_000).map("x".__mul__), "--note"
    ),
    attack("submit run --by ann --output BAD", bad_paths, "output"),
    attack("diagnostics BAD", plain_ids, "is not a dataset id"),
    attack("diagnostics --output BAD", bad_paths, "output"),
    attack("diagnostics --domain BAD", not_among(["walker"]), "no dataset has the domain"),
    attack("diagnostics --method BAD", spoiled_names(["cudc"]), "method"),
    attack("MINARI_DATASETS_PATH=BAD diagnostics", bad_roots, "dataset root"),
    attack("verify BAD", plain_ids, "is not a dataset id"),
    attack("verify walker/cudc-smoke-v0 BAD", plain_ids, "is not a dataset id"),
    attack("verify walker/cudc-smoke-v0 --sample BAD", below_one, "--sample"),
    attack("MINARI_DATASETS_PATH=BAD verify walker/cudc-smoke-v0", bad_roots, "dataset root"),
    attack("list --output BAD", bad_paths.filter(lambda path: path not in {"file", "/dev/null"}), "records"),
    attack("list BAD", anything.map(lambda text: f"{text}?"), ""),
    attack("list --kind BAD", spoiled_names(["methods", "datasets"]), "kind"),
    attack("list --method BAD", spoiled_names(methods), "method"),
    attack("list --domain BAD", spoiled_names(list(DOMAINS)), "domain"),
    attack("list --seed BAD --json", bad_seeds, "--seed cannot"),
    attack("show BAD", not_among(SHOWN).filter(lambda text: not text.startswith("-")), ""),
    attack("delete BAD --yes", plain_ids, "is not a dataset id"),
    attack("delete walker/walk/cudc-smoke-v0 BAD --yes", plain_ids, "is not a dataset id"),
    attack(
        "delete walker/walk/cudc-smoke-v0 --yes --output BAD", bad_paths.filter(lambda path: path not in {"file", "/dev/null"}), "records"
    ),
    attack("MINARI_DATASETS_PATH=BAD delete walker/walk/cudc-smoke-v0 --yes", bad_roots, ""),
    attack("MINARI_DATASETS_PATH=BAD list", bad_roots, "dataset root"),
    attack("doctor BAD", anything.map(lambda text: f"{text}?"), ""),
    attack("BAD", not_among([*plugins.names("commands")]).filter(lambda text: not text.startswith("--")), ""),
]


# ---------------------------------------------------------------------------------------------------------------------------- test

_touched: list[str] | None = None  # what this process tried to change, while anybody wants to know
_CHANGES = {"os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.symlink", "os.link", "os.truncate", "os.chmod", "os.utime"}
_STARTS = {"subprocess.Popen", "os.exec", "os.fork", "os.posix_spawn", "os.system", "socket.connect", "pty.spawn", "webbrowser.open"}


def _watch(event: str, arguments: tuple[Any, ...]) -> None:
    if _touched is None:
        return
    if event == "open":
        path, _, flags = arguments
        writes = isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND)
        # Python keeps what it compiles of the modules that a command is the first to import.
        if writes and not isinstance(path, int) and "__pycache__" not in str(path):
            _touched.append(f"open {path!r}")
    elif event in _CHANGES | _STARTS and "__pycache__" not in str(arguments):
        _touched.append(f"{event} {arguments!r}")


sys.addaudithook(_watch)


def stamps(folder: Path) -> dict[str, tuple[int, int, int]]:
    """Every file and folder below a folder, and what would change if it did."""
    found = {}
    for place, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = os.path.join(place, name)
            state = os.lstat(path)
            found[path] = (state.st_mode, state.st_size, state.st_mtime_ns)
    return found


@pytest.fixture(scope="module")
def ground(tmp_path_factory: pytest.TempPathFactory, collected_once: Path) -> Path:
    """A working folder with everything that the command lines need; shared, since no attack may change it."""
    folder = tmp_path_factory.mktemp("attacked")
    shutil.copytree(collected_once, folder / "datasets")
    write_run(folder / "run")
    # Looking at what dm_control has starts a process the first time.
    importlib.import_module("cudc_bench.envs.suite")
    (folder / "folder").mkdir()
    for suffix in (".gif", ".pt2"):
        (folder / f"folder{suffix}").mkdir()
    (folder / "file").write_text("a file\n")
    (folder / "hops.py").write_text("raise SystemExit('imported')\n")
    (folder / "episodes").mkdir()
    rows = {"observation": 24, "action": 6, "reward": 1, "discount": 1}
    arrays = {name: np.full((6, size), name == "discount", np.float32) for name, size in rows.items()}
    np.savez(folder / "episodes" / "episode_0_5.npz", **arrays, physics=np.zeros((6, 18)))
    return folder


@pytest.fixture
def attacked(ground: Path, command_line: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with the environment of the command lines."""
    monkeypatch.chdir(ground)
    monkeypatch.setenv("HOME", str(ground))
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(ground / "datasets"))
    monkeypatch.setenv("CUDC_BENCH_PROFILE", "smoke")
    monkeypatch.setenv("CUDC_BENCH_THRESHOLDS", str(ground / "thresholds.json"))
    # ``render`` sets it for the process that it runs in.
    monkeypatch.setenv("MUJOCO_GL", "disabled")
    monkeypatch.setattr(app, "build_app", lambda: command_line)
    return ground


def refuse(words: list[str], environment: dict[str, str], capfd: pytest.CaptureFixture[str]) -> str:
    """Run a command line that must be refused, and return what it said."""
    global _touched
    capfd.readouterr()
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environment.items():
            patch.setenv(name, value)
        _touched = []
        try:
            with pytest.raises(SystemExit) as ended:
                main(words)
            touched = _touched
        finally:
            _touched = None
    out, err = capfd.readouterr()
    assert (ended.value.code, out) == (2, ""), err
    assert err.startswith("cudc-bench: error: ")
    assert err.endswith("\n")
    assert err[:-1].isprintable(), ascii(err)
    assert len(err) < LONGEST_ANSWER
    assert "Traceback" not in err
    assert touched == []
    return err


@pytest.mark.parametrize("attack", ATTACKS, ids=[f"{number}: {one.line}" for number, one in enumerate(ATTACKS)])
def test_a_wrong_word_is_refused_in_one_line_with_nothing_written(
    attack: Attack, attacked: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    before, tried = stamps(attacked), set()

    @settings(max_examples=EXAMPLES, derandomize=True, database=None, phases=[Phase.generate], suppress_health_check=list(HealthCheck))
    @given(attack.bad)
    def run(bad: str) -> None:
        words, environment = [], {}
        for word in attack.line.split():
            name, equals, value = word.partition("=")
            if equals and value == "BAD" and name.isupper():
                environment[name] = bad
            else:
                words.append(word.replace("BAD", bad))
        tried.add((*words, *environment.values()))
        assert attack.says in refuse(words, environment, capfd)

    run()
    assert len(tried) >= LEAST
    assert stamps(attacked) == before


def test_there_are_thousands_of_them() -> None:
    assert LEAST * len(ATTACKS) >= 2_000
