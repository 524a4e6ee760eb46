"""The command line as users meet it: real processes, exit codes, one line for every refusal."""

from __future__ import annotations

import json
import shlex
import statistics
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import minari
import pytest

import cudc_bench
from cudc_bench import plugins
from cudc_bench.artefacts.manifest import KEY, metadata_path, read_manifest
from cudc_bench.artefacts.records import read_record
from cudc_bench.cli import doctor
from cudc_bench.cli.documents import DoctorDocument
from cudc_bench.cli.hints import evaluate_on
from cudc_bench.errors import DEBUG

from ..served import Finished
from ..waiting import PATIENCE, wait_for

TASKS = ("stand", "walk", "run", "flip")
COMMANDS = (
    "collect", "pilot", "import-exorl", "import-minari", "mix", "relabel", "evaluate", "reference", "tiers", "render", "export",
    "leaderboard", "submit", "diagnostics", "stats", "compare", "verify", "list", "show", "delete", "doctor",
)  # fmt: skip

# Arguments and what the refusal must name. Each runs beside the datasets of the smoke profile.
REFUSALS = {
    "collect --method cudk": "unknown method 'cudk'; allowed: aps, apt, ",
    "collect --method cudx": ". Did you mean 'cudc'?",
    "collect --method": "'--method' requires an argument",
    "collect --method ,": "--method is empty",
    "collect --domain wlaker --method random": "allowed: dm_control/<domain>-<task>, jaco, quadruped, walker. Did you mean 'walker'?",
    "collect --profile smoek --method random": "unknown profile 'smoek'",
    "collect --device tpu --method random": "unknown device 'tpu'; allowed: auto, cpu, cuda.",
    "collect --seeds 3-1 --method random": "--seeds cannot have the range '3-1'",
    "collect --workers 0 --method random": "--workers takes 1 or more, not 0.",
    "collect --workers two --method random": "Invalid value for '--workers'",
    "collect --method random --set stesp=5": "nothing here is called 'stesp'. Did you mean 'steps'?",
    "collect --method random --set steps=0": "'steps' cannot be '0': input should be greater than or equal to 1.",
    "collect --method random --set steps=1000000000000": "'steps' cannot be '1000000000000': input should be less than or equal to",
    "collect --method random --set steps": "--set takes name=value, not 'steps'.",
    "collect --seeds 2 --set k_max=2": "k_max",
    "collect --set k_max=5": "-smoke-v0' exists (cudc, profile smoke, seed 1, 3,000 steps); use --overwrite, --dataset-id or another",
    # The other method could be collected, but a wrong input is refused before any work starts.
    "collect --method random,cudc --set measure_every=3": "'walker/cudc-smoke-v0' exists",
    "collect --method cudc,random --seed 2 --set k_max=5": "nothing here is called 'k_max'",
    "collect --method random --seeds 1-2 --dataset-id walker/mine-v0": "--dataset-id names one dataset, but there are 2 seeds",
    "collect --method random --dataset-id ../evil-v0": "'../evil-v0' is not a dataset id",
    "collect --method random --dataset-id /tmp/evil-v0": "'/tmp/evil-v0' is not a dataset id",
    "collect --method random --dataset-id data/mine-v0": "'data/mine-v0' is not a dataset id",
    "collect --method random --dataset-id walker/mine": "'walker/mine' is not a dataset id",
    "collect walker": "unexpected extra argument",
    "collect --nonsense": "No such option: --nonsense",
    "colect": "No such command 'colect'",
    "relabel --standalone": "'walker/stand/cudc-smoke-v0' exists",
    "relabel walker/nothing-v0": "there is no dataset 'walker/nothing-v0'",
    "relabel walker/walk/cudc-smoke-v0": "'walker/walk/cudc-smoke-v0' is already relabelled for walk",
    "relabel --task wlak --seed 2": "unknown walker task 'wlak'; allowed: flip, run, stand, walk. Did you mean 'walk'?",
    "relabel --method cudk": "unknown method 'cudk'",
    "relabel --domain wlaker": "unknown domain 'wlaker'",
    "evaluate --algo td4": "Did you mean 'td3'?",
    "evaluate --task wlak": "unknown walker task 'wlak'",
    "evaluate --task ,": "no task was given",
    "evaluate --domain wlaker": "unknown domain 'wlaker'",
    "evaluate --method random,cudk": "unknown method 'cudk'",
    "evaluate --profile cpu --dataset-id walker/walk/cudc-smoke-v0": "'walker/walk/cudc-smoke-v0' exists at another profile",
    "evaluate --set gradient_steps=-1": "'gradient_steps' cannot be '-1'",
    "evaluate --set evaluate_every=7": "the milestone 20 is never evaluated",
    "evaluate --output /dev/null/below": "the output '/dev/null/below' cannot be a folder: '/dev/null' is a file.",
    "evaluate --dataset-id ../evil-v0": "'../evil-v0' is not a dataset id",
    "reference --task jump": "unknown walker task 'jump'",
    "reference --set gradient_steps=5": "nothing here is called 'gradient_steps'.",
    "reference --precision tf32": "precision=tf32 is for CUDA",
    "reference --checkpoint-every -1": "--checkpoint-every",
    "evaluate --method random --workers 0": "--workers takes 1 or more, not 0.",
    "leaderboard nowhere": "there are no results at 'nowhere'",
    "diagnostics walker/walk/cudc-smoke-v0": "is labelled for walk; the diagnostics are those of its base 'walker/cudc-smoke-v0'.",
    "diagnostics walker/cudc-smoke-v0 walker/nothing-v0": "there is no dataset 'walker/nothing-v0'",
    "diagnostics ../evil-v0": "'../evil-v0' is not a dataset id",
    "diagnostics --domain wlaker": "no dataset has the domain 'wlaker'; there are: walker. Did you mean 'walker'?",
    "diagnostics --method cudc,random": "no dataset has the method 'random'; there are: cudc.",
    "diagnostics --method ,": "--method is empty",
    "diagnostics --output /dev/null/below": "output '/dev/null/below' cannot be a folder: '/dev/null' is a file.",
    "verify": "no dataset was named; name some",
    "verify walker/cudc-smoke-v0 walker/nothing-v0": "there is no dataset 'walker/nothing-v0'",
    "verify ../evil-v0": "'../evil-v0' is not a dataset id",
    "verify walker/cudc-smoke-v0 --sample 0": "--sample takes 1 or more transitions, not 0; --all takes all.",
    "verify walker/cudc-smoke-v0 --all --sample 5": "--all and --sample contradict each other; give one of them.",
}  # fmt: skip


def tree(*places: Path) -> dict[Path, bytes | None]:
    """Every file and folder, with the files' content."""
    return {path: path.read_bytes() if path.is_file() else None for place in places for path in sorted(place.rglob("*"))}


# -------------------------------------------------------------------------------------------------------------------- light imports


def test_help_imports_nothing_heavy(python: Callable) -> None:
    """Neither does anything that is asked for before: what one imported, those behind it have."""
    asked = [["--help"], ["--version"], *([command, "--help"] for command in COMMANDS)]
    script = f"""
import io, sys
from contextlib import redirect_stdout
from cudc_bench.cli.app import main
for arguments in {asked}:
    with redirect_stdout(io.StringIO()) as said:
        try:
            main(arguments)
        except SystemExit as ended:
            code = ended.code
    heavy = {{name.split(".")[0] for name in sys.modules}} & {{"torch", "numpy", "minari", "mujoco", "gymnasium", "h5py", "dm_control"}}
    print(*arguments, code, sorted(heavy), bool(said.getvalue()))
"""
    done = python(script)
    assert (done.code, done.err) == (0, "")
    assert done.out.splitlines() == [f"{' '.join(arguments)} 0 [] True" for arguments in asked]


# ------------------------------------------------------------------------------------------------------------------------- refusals


def check_refusal(done: Finished, message: str) -> None:
    assert done.code == 2, done.err
    assert done.out == ""
    assert len(done.err.splitlines()) == 1, done.err
    assert done.err.startswith("cudc-bench: error: ")
    assert message in done.err


@pytest.mark.parametrize("line", REFUSALS)
def test_wrong_input_is_refused_in_one_line_with_nothing_written(line: str, smoke: Path, tmp_path: Path, here: Callable) -> None:
    before = tree(smoke, tmp_path)
    check_refusal(here(line.split()), REFUSALS[line])
    assert tree(smoke, tmp_path) == before


@pytest.mark.parametrize(
    "line",
    [
        "collect --method cudk",
        "collect --method random --set steps=0",
        "collect --method random --dataset-id ../evil-v0",
        "collect --set k_max=5",
        "relabel --task wlak --seed 2",
        "evaluate --algo td4",
    ],
)
def test_a_process_that_refuses_ends_the_same_way(line: str, smoke: Path, tmp_path: Path, cli: Callable) -> None:
    before = tree(smoke, tmp_path)
    check_refusal(cli(*line.split()), REFUSALS[line])
    assert tree(smoke, tmp_path) == before


@pytest.mark.parametrize(
    "line", ["evaluate --algo td4", "evaluate --task wlak", "collect --method random --set steps=0", "relabel --task wlak"]
)
def test_a_refusal_does_not_even_make_the_root(line: str, datasets: Path, tmp_path: Path, here: Callable) -> None:
    assert here(line.split()).code == 2
    assert not datasets.exists()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("option", ["--method", "--domain", "--dataset-id", "--seeds", "--profile", "--device", "--set", "--workers"])
@pytest.mark.parametrize("text", ["\udcff\n", "\udcff=\n", "a\x1b[31m\nb", "width=\udcff", "x" * 10_000])
def test_bytes_that_are_no_names_are_refused_in_one_line(option: str, text: str, datasets: Path, here: Callable) -> None:
    """Bytes that are not UTF-8 reach a program as lone surrogates."""
    done = here(["collect", "--method", "random", option, text])
    assert (done.code, done.out, len(done.err.splitlines())) == (2, "", 1)
    assert not datasets.exists()


def test_a_process_takes_any_bytes(environment: dict[str, str], tmp_path: Path) -> None:
    command = [sys.executable, "-m", "cudc_bench.cli", "collect", b"--dataset-id", b"\xff\n/a-v0"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, timeout=PATIENCE)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert b"is not a dataset id" in done.stderr


def test_without_arguments_the_help_is_shown(cli: Callable) -> None:
    done = cli(anew=True)
    assert done.code == 2
    assert all(command in done.out for command in COMMANDS)
    assert done.err == ""


# ------------------------------------------------------------------------------------------------------------------------ the calls


def test_the_calls_of_the_readme_and_what_they_leave(
    cli: Callable, here: Callable, datasets: Path, tmp_path: Path, collected_once: Path
) -> None:
    collected = cli("collect", "--method", "cudc", anew=True)
    assert (collected.code, collected.out) == (0, "walker/cudc-smoke-v0\n"), collected.err
    assert "profile smoke" in collected.err
    assert "next: cudc-bench relabel walker/cudc-smoke-v0" in collected.err

    relabelled = cli("relabel", "walker/cudc-smoke-v0")
    assert (relabelled.code, relabelled.out.split()) == (0, [f"walker/{task}/cudc-smoke-v0" for task in TASKS]), relabelled.err
    (following,) = [line for line in relabelled.err.splitlines() if line.startswith("next: ")]
    assert following == "next: cudc-bench evaluate --algo td3 --dataset-id walker/cudc-smoke-v0"

    evaluated = cli(*shlex.split(following)[2:], "--workers", "1", brief=True)
    assert evaluated.code == 0, evaluated.err
    assert "next: cudc-bench leaderboard results" in evaluated.err
    assert "missing" not in evaluated.err
    paths = [tmp_path / line for line in evaluated.out.splitlines()]
    assert len(set(paths)) == 4

    # Another process, the same seed: the same bytes as the session's own dataset.
    for one in ("walker/cudc-smoke-v0", *(f"walker/{task}/cudc-smoke-v0" for task in TASKS)):
        assert read_manifest(one).fingerprint == read_manifest(one, collected_once).fingerprint
        assert minari.load_dataset(one).total_steps == 3000
    for task, path in zip(TASKS, paths, strict=True):
        record = read_record(path)
        assert (record.dataset.task, record.dataset.id, record.profile) == (task, f"walker/{task}/cudc-smoke-v0", "smoke")
        assert record.dataset.fingerprint == read_manifest(record.dataset.id).fingerprint
        assert [evaluation.step for evaluation in record.curve] == [0, 20, 40]
        assert len(record.final.returns) == 2
        assert all(0 <= value <= 1000 for evaluation in (*record.curve, record.final) for value in evaluation.returns)
        returns = record.conclusion.returns
        spread = statistics.pstdev(returns)
        line = f"td3 on {record.dataset.id}: {statistics.fmean(returns):.1f} ± {spread:.1f} over 4 episodes\n"
        assert line in evaluated.err

    before = tree(tmp_path)
    again = here(["evaluate", "--algo", "td3"])
    assert (again.code, again.out) == (0, evaluated.out), again.err
    assert "4 recorded before are kept" in again.err
    assert tree(tmp_path) == before

    other = here(["evaluate", "--algo", "td3", "--set", "width=8"])
    assert (other.code, other.out) == (2, "")
    assert "records another run (other data or settings); use --overwrite or another --output." in other.err
    assert tree(tmp_path) == before


def test_what_was_tried_is_not_in_the_way_of_what_follows(cli: Callable, here: Callable, datasets: Path) -> None:
    """A method at ``smoke``, then without a profile: both are there, and whoever names none has the plain name."""
    tried = cli("collect", "--method", "random", "--profile", "smoke")
    assert tried.out == "walker/random-smoke-v0\n"
    real = cli("collect", "--method", "random", "--set", "steps=1000", env={"CUDC_BENCH_PROFILE": "auto"})
    assert (real.code, real.out) == (0, "walker/random-v0\n"), real.err
    assert [read_manifest(f"walker/{name}-v0").profile for name in ("random", "random-smoke")] == ["cpu", "smoke"]
    assert minari.load_dataset("walker/random-v0").total_steps == 1000
    # The two that share the plain name are never taken for one another.
    for words in (["relabel"], ["evaluate"], ["evaluate", "--method", "icm,random"]):
        refused = here([*words, *([] if "--method" in words else ["--method", "random"]), "--profile", "paper"])
        assert (refused.code, refused.out, len(refused.err.splitlines())) == (2, "", 1)
        there = "'walker/random-v0' exists at another profile (random, profile cpu with steps=1000, seed 1, 1,000 steps) than paper"
        assert f"{there}; use --profile cpu" in refused.err
    # Each profile's own is what its other commands find.
    assert here(["relabel", "--method", "random", "--task", "walk"]).out == "walker/walk/random-smoke-v0\n"


@pytest.mark.parametrize("profile", ["smoke", "cpu"])
def test_what_comes_next_works_whatever_the_usual_profile_is(
    profile: str, cli: Callable, smoke: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CUDC_BENCH_PROFILE", profile)
    words = shlex.split(evaluate_on(["walker/cudc-smoke-v0"], ["walk"]))
    assert ("--profile" in words) == (profile != "smoke")
    done = cli(*words[1:], env={"CUDC_BENCH_PROFILE": profile}, brief=True)
    assert (done.code, done.out) == (0, "results/smoke/walker/walk/cudc-smoke-v0/td3-seed1.json\n"), done.err


def test_missing_steps_are_done_and_said(cli: Callable, here: Callable, datasets: Path, tmp_path: Path) -> None:
    few = ("--set", "evaluation_episodes=1", "--set", "final_episodes=1")
    done = cli("evaluate", "--method", "random", "--seed", "2", "--task", "walk", *few, "--output", "elsewhere")
    assert done.code == 0, done.err
    assert "walker/random-smoke-seed2-v0 missing: collecting first" in done.err
    assert "walker/walk/random-smoke-seed2-v0 missing: relabelling first" in done.err
    (path,) = done.out.splitlines()
    record = read_record(tmp_path / path)
    assert (record.seed, record.dataset.seed, record.dataset.method, record.dataset.task) == (2, 2, "random", "walk")
    assert set(minari.list_local_datasets()) == {"walker/random-smoke-seed2-v0", "walker/walk/random-smoke-seed2-v0"}
    assert [file.name for file in tmp_path.iterdir()] == ["elsewhere"]

    # The record says how to make it again, and doing so gives the same numbers.
    words = shlex.split(record.command)[1:]
    assert here([*words, "--output", "elsewhere"]).code == 0
    again = read_record(tmp_path / path)
    assert (again.curve, again.final, again.metrics) == (record.curve, record.final, record.metrics)


def test_several_seeds_in_processes_of_their_own(cli: Callable, datasets: Path) -> None:
    done = cli("collect", "--method", "random", "--seeds", "1-2", "--workers", "2", "--set", "steps=1200")
    assert (done.code, done.out) == (0, "walker/random-smoke-v0\nwalker/random-smoke-seed2-v0\n"), done.err
    together = [read_manifest(one) for one in done.out.split()]
    assert [manifest.seed for manifest in together] == [1, 2]
    assert together[0].overrides == {"steps": 1200}
    cudc_bench.collect("random", seeds=[2], profile="smoke", settings={"steps": 1200}, dataset_id="walker/alone-v0")
    assert read_manifest("walker/alone-v0").fingerprint == together[1].fingerprint != together[0].fingerprint


def test_a_failure_in_a_run_is_one_line_with_exit_code_1(here: Callable, smoke: Path, tmp_path: Path) -> None:
    (smoke / "walker" / "cudc-smoke-v0").rename(tmp_path / "moved")
    done = here(["evaluate", "--dataset-id", "walker/walk/cudc-smoke-v0"])
    assert done.code == 1
    said = "cudc-bench: error: 'walker/walk/cudc-smoke-v0' links to 'walker/cudc-smoke-v0', which is missing;"
    assert done.err.splitlines()[-1].startswith(said)
    assert "Traceback" not in done.err


def test_who_asks_sees_where_an_error_came_from(here: Callable, smoke: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (smoke / "walker" / "cudc-smoke-v0" / "data" / "main_data.hdf5").write_bytes(b"nothing")
    command = ["evaluate", "--dataset-id", "walker/walk/cudc-smoke-v0"]
    monkeypatch.setenv(DEBUG, "0")
    plain = here(command)
    assert plain.code == 1
    assert "Traceback" not in plain.err
    told = here(["--debug", *command])
    assert told.code == 1
    assert told.err.splitlines()[-1] == plain.err.splitlines()[-1]
    assert told.err.count("Traceback (most recent call last)") == 2  # the error for people, and the library's that it hides
    assert "\nOSError: " in told.err
    assert here(command).err == told.err  # from the environment, where the option has put it for other processes


def test_sizes_beyond_the_memory_end_in_one_line(here: Callable, datasets: Path) -> None:
    done = here(["collect", "--method", "cudc", "--set", "steps=10000000000"])
    assert done.code == 1
    assert done.err.splitlines()[-1].startswith("cudc-bench: error: there is not enough memory for these sizes; choose")
    assert "Traceback" not in done.err
    assert list(minari.list_local_datasets()) == []


def test_workers_leave_when_the_process_that_started_them_is_killed(environment: dict[str, str], datasets: Path, tmp_path: Path) -> None:
    arguments = ["collect", "--method", "random", "--seeds", "1-2", "--workers", "2", "--set", "steps=10000000"]
    process = subprocess.Popen([sys.executable, "-m", "cudc_bench.cli", *arguments], env=environment, cwd=tmp_path, stderr=subprocess.PIPE)
    try:
        locks = [datasets / "walker" / f".{name}-v0.lock" for name in ("random-smoke", "random-smoke-seed2")]
        lines = [datasets / "walker" / f".{name}-v0.building" / "diagnostics.jsonl" for name in ("random-smoke", "random-smoke-seed2")]
        wait_for(lambda: all(path.exists() for path in lines))
        workers = [int(lock.read_text().split()[0]) for lock in locks]
    finally:
        process.kill()
        process.communicate()
    wait_for(lambda: not any(is_running(worker) for worker in workers))
    # They have saved their states and let go of their locks.
    assert sorted(path.name for path in (datasets / "walker").iterdir()) == [".random-smoke-seed2-v0.building", ".random-smoke-v0.building"]
    assert len(list(datasets.rglob("*.pt"))) == 2


def is_running(process: int) -> bool:
    # A process that nobody waits for stays listed, as a zombie, in a container without an init.
    try:
        return "State:\tZ" not in Path(f"/proc/{process}/status").read_text()
    except FileNotFoundError:
        return False


def test_list_shows_what_can_be_used_and_what_exists(cli: Callable, smoke: Path) -> None:
    # Neither half-written nor foreign folders may break it.
    (smoke / "walker" / ".cudc-smoke-v0.building" / "data").mkdir(parents=True)
    (smoke / "walker" / ".cudc-smoke-v0.building" / "data" / "metadata.json").write_text("{}")
    (smoke / "walker" / "Théirs [bold]-v0" / "data").mkdir(parents=True)
    (smoke / "walker" / "Théirs [bold]-v0" / "data" / "metadata.json").write_text("{")
    done = cli("list")
    assert (done.code, done.err) == (0, "")
    for name in [*plugins.names("collectors"), *plugins.names("evaluators"), "paper", "cpu", "demo", "smoke", "auto is "]:
        assert name in done.out
    for one in ("walker/cudc-smoke-v0", *(f"walker/{task}/cudc-smoke-v0" for task in TASKS)):
        (line,) = lines_with(done.out, one)
        assert "3,000" in line
    assert "building" not in done.out
    assert "Records in results: 0" in done.out


def test_list_and_cards_tell_of_a_suspect_schedule(here: Callable, smoke: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    # Nothing to note, no column.
    assert "notes" not in here(["list"]).out
    path = metadata_path("walker/cudc-smoke-v0")
    metadata = json.loads(path.read_text())
    increments = [{"step": 1200 + 400 * k, "old_k": k, "new_k": k + 1, "p": 0.6, "mean_w": 0.1} for k in (3, 4)]
    metadata[KEY]["diagnostics"] |= {"k_increments": increments, "k_schedule_suspect": True}
    path.write_text(json.dumps(metadata))
    # A dataset relabelled from it says so, too; one from before does not.
    cudc_bench.relabel("walker/cudc-smoke-v0", tasks=["walk"], overwrite=True)
    listed = here(["list"]).out
    there = ("cudc", "walk/cudc", "run/cudc")
    noted = {one: "k schedule suspect" in line for one in there for line in lines_with(listed, f"walker/{one}-smoke-v0")}
    assert noted == {"cudc": True, "walk/cudc": True, "run/cudc": False}
    card = (smoke / "walker/walk/cudc-smoke-v0/README.md").read_text()
    assert "k grew before 150 environment steps, or reached its bound within 300 steps" in card  # of 3,000
    assert "3→4 at 2,400, 4→5 at 2,800" in card


def lines_with(text: str, word: str) -> list[str]:
    return [line for line in text.splitlines() if word in line.split()]


def test_list_works_where_nothing_exists(here: Callable, datasets: Path) -> None:
    assert here(["list"]).code == 0
    assert not datasets.exists()


def test_doctor_checks_this_machine(cli: Callable, datasets: Path) -> None:
    done = cli("doctor", anew=True)
    assert (done.code, done.err) == (0, ""), done.out
    assert "FAIL" not in done.out
    for check in ("python", "versions", "processor", "cuda", "updates", "rendering", "dataset root", "environment"):
        assert f"ok    {check}" in done.out
    assert not datasets.exists()


def test_doctor_reports_what_is_wrong(here: Callable, datasets: Path) -> None:
    datasets.write_text("")
    done = here(["doctor"])
    assert done.code == 1
    assert "FAIL  dataset root" in done.out
    assert (done.err.count("\n"), "1 of 8 checks failed; reinstall with: " in done.err) == (1, True)
    told = here(["doctor", "--json"])
    assert (told.code, told.err) == (1, done.err)
    found = DoctorDocument.model_validate_json(told.out)
    assert [one.name for one in found.checks if not one.ok] == ["dataset root"]
    assert not found.ok


@pytest.mark.parametrize("columns", [60, 80])
def test_what_the_doctor_says_fits_narrow_terminals(columns: int, here: Callable, datasets: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    detail = ", ".join(f"a-package-{index} {index}.0.1+cpu" for index in range(12))
    monkeypatch.setattr(doctor, "_CHECKS", (("versions", lambda: (True, detail)), ("cuda", lambda: (False, "none"))))
    done = here(["doctor"])
    lines = done.out.splitlines()
    assert max(map(len, lines)) <= columns
    assert all(line.startswith(("ok  ", "FAIL", " " * 20)) for line in lines)
    assert " ".join(done.out.split()) == f"ok versions {detail} FAIL cuda none"


def test_the_installed_command_is_this_one(environment: dict[str, str], tmp_path: Path) -> None:
    script = Path(sys.executable).with_name("cudc-bench")
    done = subprocess.run([script, "--version"], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=PATIENCE)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"cudc-bench {version('cudc-bench')}\n", "")
