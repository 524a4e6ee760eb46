"""What somebody hands in is taken whole or refused with all that is wrong with it, and never passes for ours."""

from __future__ import annotations

import copy
import hashlib
import json
import os
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import cudc_bench
from cudc_bench.artefacts.provenance import command_line, commit
from cudc_bench.artefacts.records import Record, read_record
from cudc_bench.cli.app import main
from cudc_bench.errors import CudcBenchError, RunError, UsageError
from cudc_bench.leaderboard.api import make_leaderboard
from cudc_bench.leaderboard.intake.load import load_records
from cudc_bench.leaderboard.intake.submit import RefusedError, submit
from cudc_bench.leaderboard.numbers.columns import column
from cudc_bench.leaderboard.numbers.missing import find_missing
from cudc_bench.leaderboard.numbers.overall import build_overall
from cudc_bench.leaderboard.numbers.table import build_tables
from cudc_bench.leaderboard.show.latex import of_table as to_latex
from cudc_bench.leaderboard.show.markdown import of_overall as overall_to_markdown
from cudc_bench.leaderboard.show.markdown import of_table as to_markdown
from cudc_bench.settings.config import config_hash

from ..test_hostile_records import changed

TASKS = ("stand", "walk", "run", "flip")
# TD3 at the smoke profile, written out: what it is must not follow from the code under test.
VALUES = {
    "gradient_steps": 40, "evaluate_every": 20, "evaluation_episodes": 1, "final_episodes": 2, "milestones": [20, 40],
    "final_evaluations": 3, "batch_size": 32,
    "width": 16, "learning_rate": 0.001, "discount": 0.99, "critic_tau": 0.01, "noise_std": 0.2, "noise_clip": 0.3, "target_actor": False,
    "policy_delay": 1, "maximise": "min", "actor_noise": True,
}  # fmt: skip


def theirs(method: str = "cudc", task: str = "walk", seed: int = 1, **values: Any) -> dict[str, Any]:
    """A record as ``evaluate`` writes it at the smoke profile, or with other values and what follows from them."""
    draw = random.Random(f"{method} {task} {seed} {values}")
    every = VALUES | values
    steps = [*range(0, every["gradient_steps"], every["evaluate_every"]), every["gradient_steps"]]
    data = f"walker/{task}/{method}{'' if seed == 1 else f'-seed{seed}'}-v0"
    return {
        "schema_version": 1,
        "dataset": {
            "id": data, "fingerprint": hashlib.sha256(data.encode()).hexdigest(), "domain": "walker", "task": task, "method": method,
            "seed": seed, "steps": 3000, "profile": "smoke", "overrides": {}, "reward": None, "source": None, "used": None,
        },
        "algorithm": "td3", "profile": "smoke", "overrides": dict(values), "seed": seed, "hyperparameters": every,
        "hyperparameters_hash": config_hash(every), "milestones": every["milestones"],
        "curve": [{"step": step, "returns": [draw.uniform(0, 900) for _ in range(every["evaluation_episodes"])]} for step in steps],
        "final": {"step": steps[-1], "returns": [draw.uniform(0, 900) for _ in range(every["final_episodes"])]},
        "late": [
            {"step": step, "returns": [draw.uniform(0, 900) for _ in range(every["final_episodes"])]}
            for step in steps[1:][-every["final_evaluations"] : -1]
        ],
        "metrics": [],
        "seconds": 1.5, "versions": {"cudc-bench": "0.1.0"}, "commit": None, "dirty": False, "machine": {},
        "command": command_line("evaluate", {
            "--algo": "td3", "--profile": "smoke", "--domain": "walker", "--method": method, "--seed": str(seed), "--task": task,
        }, values, "--overwrite"),
        "created": "2026-01-01T00:00:00+00:00",
    }  # fmt: skip


@pytest.fixture
def ground(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def hand_in(*records: dict[str, Any], folder: str = "mail") -> Path:
    """Files as a mail brings them."""
    for number, record in enumerate(records):
        path = Path(folder) / f"{number}.json"
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps(record))
    return Path(folder)


def ours(*records: dict[str, Any]) -> None:
    for number, record in enumerate(records):
        path = Path("results", "smoke", f"{number}.json")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(record))


def below(folder: str | Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in sorted(Path(folder).rglob("*")) if path.is_file()}


def refused(*records: dict[str, Any], **options: Any) -> tuple[str, ...]:
    """All that is wrong with them; nothing may be touched."""
    mail = hand_in(*records)
    before = below(".")
    with pytest.raises(RefusedError) as caught:
        submit(mail, "ann", **options)
    assert below(".") == before
    assert all(problem.isprintable() for problem in caught.value.problems)
    return caught.value.problems


def only_problem(record: dict[str, Any], **options: Any) -> str:
    (problem,) = refused(record, **options)
    assert problem.startswith("mail/0.json: ")
    return problem.removeprefix("mail/0.json: ")


# ------------------------------------------------------------------------------------------------------------------------- round trip


def test_what_is_taken_in_is_theirs_unchanged_and_marked(ground: Path) -> None:
    mail = hand_in(theirs(), theirs(seed=2), theirs(width=64))
    before = below(mail)
    received = submit(mail, "ann", url="https://example.org/a?b=1#c", note="of 3 GPUs")
    top = Path("results/submitted/ann")
    assert received.files[:2] == tuple(
        top / f"smoke/walker/walk/{place}.json" for place in ("cudc-v0/td3-seed1", "cudc-seed2-v0/td3-seed2")
    )
    assert received.files[2].parent.parent.parent.parent.name.startswith("smoke-")
    assert below(mail) == before
    for file, original in zip(received.files, sorted(mail.iterdir()), strict=True):
        kept = json.loads(file.read_text())
        submission = kept.pop("submission")
        assert kept == json.loads(original.read_text())
        assert submission.pop("submitted").startswith("20")
        digest = hashlib.sha256(original.read_bytes()).hexdigest()
        assert submission == {"by": "ann", "url": "https://example.org/a?b=1#c", "note": "of 3 GPUs", "sha256": digest}
        assert column(read_record(file)) == "cudc (by ann)"
    assert any("a table of its own: smoke (evaluate: width=64)" in remark for remark in received.remarks)


def test_a_real_record_goes_the_whole_way(smoke: Path, cli: Callable, ground: Path) -> None:
    (path,) = cudc_bench.evaluate("td3", tasks=["walk"], profile="smoke", output="elsewhere", policies=False)
    assert "submission" not in json.loads(path.read_text())
    done = cli("submit", str(path), "--by", "ann", "--url", "https://example.org/", "--note", "hello")
    kept = "results/submitted/ann/smoke/walker/walk/cudc-smoke-v0/td3-seed1.json"
    assert (done.code, done.out) == (0, f"{kept}\n"), done.err
    head, dirty = commit()
    if head:
        assert f"note: {path}: made with commit {head[:7]}{' with local changes' if dirty else ''} of this project" in done.err
    assert "next: cudc-bench leaderboard results" in done.err
    # Handed in once more it stays as it is; by somebody else it is a copy.
    before = below("results")
    assert submit("elsewhere", "ann", url="https://example.org/", note="hello").files == (Path(kept),)
    again = cli("submit", str(path), "--by", "bob")
    assert again.code == 2
    assert again.err.splitlines()[-1].startswith("cudc-bench: error: nothing was added: elsewhere/")
    assert f"its returns are, to the last digit, those of {kept} (td3 on cudc, walker walk, seed 1, by ann)" in again.err
    assert below("results") == before
    shown = cli("leaderboard")
    assert shown.code == 0
    assert "cudc (by ann)" in shown.out
    assert "Submitted by others, and not run again here: cudc (by ann)" in " ".join(shown.out.split())
    assert "cudc (by ann): 1 run; " in Path("report/smoke.td3.walker/table.md").read_text().replace("\\", "")


def test_from_python_the_stage_is_a_public_function() -> None:
    assert cudc_bench.submit is submit


def test_a_new_file_by_the_same_person_takes_overwrite(ground: Path) -> None:
    submit(hand_in(theirs()), "ann")
    other = theirs()
    other["final"]["returns"] = [1.0, 2.0]
    assert "exists and is another; use --overwrite to replace it" in only_problem(other)
    (file,) = submit("mail", "ann", overwrite=True).files
    assert read_record(file).final.returns == [1.0, 2.0]


# --------------------------------------------------------------------------------------------------------------------------- refusals


def changing(path: str, value: Any) -> dict[str, Any]:
    """A record in which one value was replaced, hash and all else left as they were."""
    record = theirs()
    place = record
    *folders, name = path.split(".")
    for folder in folders:
        place = place[int(folder)] if isinstance(place, list) else place[folder]
    place[name] = value
    return record


REFUSED = {
    "a return beyond the largest": (changing("final.returns", [1.0, 1001.0]), "a return of 1001 is impossible, the limit is 1000"),
    "a negative return": (changing("final.returns", [1.0, -5.0]), "a return of -5 is impossible: no reward of walker is negative"),
    "an unknown domain": (changing("dataset.domain", "cheetah"), "unknown domain 'cheetah'"),
    "an unknown task": (changing("dataset.task", "jump"), "unknown walker task 'jump'"),
    "an id that climbs": (changing("dataset.id", "walker/../../x-v0"), "is not a dataset id"),
    "an absolute id": (changing("dataset.id", "/tmp/x-v0"), "is not a dataset id"),
    "an unknown profile": (changing("profile", "papr"), "there is no profile 'papr'"),
    "data of another profile": (changing("dataset.profile", "cpu"), "collected at profile cpu, and it was trained at smoke"),
    "more data than the profile has": (changing("dataset.steps", 9000), "has 9,000 steps where profile smoke has 3,000"),
    "a part that is the whole": (changing("dataset.used", 3000), "the first 3,000 of 3,000 transitions"),
    "no start": (changing("curve", theirs()["curve"][1:]), "its curve has 2 evaluations, at 20, 40; by its hyperparameters there are 3"),
    "another spacing": (
        changing("curve.1.step", 10) | {"late": [{"step": 10, "returns": [1.0, 2.0]}]}, "its curve has 3 evaluations, at 0, 10, 40"
    ),
    "late where there is no evaluation": (changing("late.0.step", 10), "'late' was not taken at the last evaluations of 'curve'"),
    "an episode too many": (changing("curve.1.returns", [1.0, 2.0]), "evaluations of its curve have 1, 2 episodes"),
    "few final episodes": (changing("final.returns", [1.0]), "larger evaluation at its end has 1 episodes, and by its hyperparameters 2"),
    "few late episodes": (changing("late.0.returns", [1.0]), "larger evaluation at its end has 1 episodes, and by its hyperparameters 2"),
    "no late evaluation": (changing("late", []), "it has 1 larger evaluations at its end, and by its hyperparameters 2"),
    "a negative late return": (changing("late.0.returns", [1.0, -5.0]), "a return of -5 is impossible: no reward of walker is negative"),
    "other milestones": (changing("milestones", [40]), "its milestones are 40, and by its hyperparameters 20, 40"),
    "a hash of something else": (changing("hyperparameters_hash", "0" * 16), "its hyperparameters have the hash"),
    "an override that is not so": (changing("overrides", {"width": 64}), "its overrides say width=64, and its hyperparameters do not"),
    "an override that is none": (changing("overrides", {"width": 16}), "overrides name width=16, which is what profile smoke has"),
    "a command of another program": (changing("command", "rm -rf /"), "its command is not one of cudc-bench"),
    "a command that makes no record": (changing("command", "cudc-bench collect"), "its command makes no record"),
    "another run's command": (changing("command", "cudc-bench evaluate --algo bc"), "its command says --algo bc, and it has td3"),
    **{
        f"a command with {words}": (changing("command", f"{theirs()['command']} {words}"), says)
        for words, says in {
            "--algo=cql": "its command says --algo cql, and it has td3",
            "--steps 999999": "its command says --steps 999999, and it has 40",
            "--reward os:system": "its command says --reward os:system, and it has none",
            "--seeds 2": "its command says --seeds 2, and it has 1",
            "--set width=64": "its command says --set width=64, and it has 16",
            "--set nothing=1": "its command says --set nothing=1, and it has no such value",
            "--precision bf16": "its command says --set precision=bf16, and it has float32",
            "--dataset-size 100": "its command says --dataset-size 100, and it has none",
            "--dataset-id walker/walk/icm-v0": "its command says --dataset-id walker/walk/icm-v0, and it has walker/walk/cudc-v0",
            "--output /etc": "its command says --output, which has no part in what a record says; leave it out",
            "--help": "its command is refused (No such option: --help",
        }.items()
    },
    "a command that says nothing": (changing("command", "cudc-bench evaluate"), "its command says --profile auto, and it has smoke"),
    "a silent override": (
        theirs(width=64) | {"command": theirs()["command"]}, "its command does not say --set width=64"
    ),
    "a dataset of its own": (changing("dataset.overrides", {"width": 3}), "its command names no --dataset-id"),
    "hundreds of overrides": (
        changing("overrides", {f"a{i}": i for i in range(500)}), "it has 500 overrides, at most 200 are taken"
    ),
    "hundreds of hyperparameters": (
        changing("hyperparameters", {f"a{i}": i for i in range(500)}), "it has 500 hyperparameters, at most 200 are taken"
    ),
    "an override as long as a book": (changing("overrides", {"width": "9" * 10**6}), "its overrides have one of 1,000,007 characters"),
    "a command as long as a book": (changing("command", "cudc-bench evaluate " + "a" * 10**6), "its command has 1,000,020 characters"),
    "a curve of thousands": (
        changing("curve", [{"step": i, "returns": [1.0]} for i in range(10_000)])
        | {"final": {"step": 9_999, "returns": [1.0]}, "late": []}, "it has 10,001 evaluations, at most 10,000 are taken"
    ),
    "a time to come": (changing("created", "2999-01-01T00:00:00"), "it was made in the future"),
    "no time": (changing("created", "soon"), "its time of creation 'soon' is not ISO 8601"),
    "imported at a profile": (changing("dataset.source", "ExORL"), "an imported dataset was collected at no profile"),
}  # fmt: skip


@pytest.mark.parametrize("why", REFUSED)
def test_what_cannot_be_a_result_is_refused(why: str, ground: Path) -> None:
    record, says = REFUSED[why]
    assert any(says in problem for problem in refused(record))
    assert "results" not in os.listdir()


@pytest.mark.parametrize(
    ("values", "overrides", "says"),
    [
        ({"width": 64}, {}, "it was trained with width=64 where profile smoke has width=16, and its overrides do not say so"),
        ({"learning_rate": 0.1}, {"width": 16}, "it was trained with learning_rate=0.1"),
        ({"discount": 0.5}, {}, "it was trained with discount=0.5 where profile smoke has discount=0.99"),
        ({"secret": 1}, {"secret": 1}, "td3 has no hyperparameter called secret"),
        ({"gradient_steps": "forty"}, {}, "its hyperparameters are impossible: 'gradient_steps' cannot be 'forty'"),
        ({"milestones": [30, 40]}, {"milestones": [30, 40]}, "its hyperparameters are impossible: the milestone 30 is never evaluated"),
        ({"final_episodes": 10**9}, {"final_episodes": 10**9}, "larger evaluation at its end has 2 episodes"),
        ({"evaluate_every": 1}, {"evaluate_every": 1}, "there are 41: at 0, then every 1 steps up to 40"),
    ],
    ids=lambda value: str(value)[:30],
)
def test_settings_are_what_the_record_says_they_are(values: dict, overrides: dict, says: str, ground: Path) -> None:
    record = theirs()
    record["hyperparameters"] |= values
    every = record["hyperparameters"]
    record |= {"overrides": overrides, "hyperparameters_hash": config_hash(every), "milestones": every["milestones"]}
    assert any(says in problem for problem in refused(record))


def test_without_the_values_of_an_evaluation_nothing_can_be_checked(ground: Path) -> None:
    record = theirs()
    del record["hyperparameters"]["gradient_steps"]
    record["hyperparameters_hash"] = config_hash(record["hyperparameters"])
    assert only_problem(record) == "its hyperparameters lack gradient_steps."


def test_honest_records_lack_nothing_and_may_say_what_they_need_not(ground: Path) -> None:
    """What is written down only where it is not the default is not missed."""
    free = theirs("icm") | {"command": theirs("icm")["command"] + " --seeds=1-3 --set width=16 --set learning_rate=1e-3 --device cpu"}
    long = theirs("rnd", gradient_steps=60, milestones=[20, 60])
    long["command"] = theirs("rnd")["command"] + " --steps 60"
    named = theirs("diayn") | {"command": "cudc-bench evaluate --profile smoke --dataset-id walker/walk/diayn-v0"}
    received = submit(hand_in(theirs(), free, long, named, theirs("apt", precision="bf16")), "ann")
    assert len(received.files) == 5
    assert "lacks" not in " ".join(received.remarks)


def test_what_differs_openly_is_taken_with_a_remark(ground: Path) -> None:
    older = theirs("icm")
    del older["hyperparameters"]["actor_noise"]
    older["hyperparameters_hash"] = config_hash(older["hyperparameters"])
    plugin = theirs("re3") | {
        "algorithm": "awac",
        "command": theirs("re3")["command"].replace("td3", "awac"),
        "commit": "f" * 40,
        "dirty": True,
    }
    remarks = "\n".join(submit(hand_in(theirs(final_episodes=5), older, plugin), "ann").remarks)
    for says in (
        "a table of its own: smoke (evaluate: final_episodes=5)",
        "td3 has hyperparameters here that it lacks: actor_noise",
        "the algorithm awac is not installed here",
        "the method re3 is not installed here",
        "commit fffffff with local changes, which is not known here",
        "2 records, such as mail/0.json: made with no commit, cudc-bench 0.1.0",
    ):
        assert says in remarks


def test_a_run_from_before_there_were_late_evaluations_is_taken_into_a_table_of_its_own(ground: Path) -> None:
    before, chosen = theirs(), theirs("icm", final_evaluations=1)
    del before["hyperparameters"]["final_evaluations"], before["late"]
    before["hyperparameters_hash"] = config_hash(before["hyperparameters"])
    received = submit(hand_in(before, chosen), "ann")
    assert {path.parts[3].partition("-")[0] for path in received.files} == {"smoke"}
    assert "2 records, such as mail/0.json: a table of its own: smoke (evaluate: final_evaluations=1)." in received.remarks
    records = [read_record(path) for path in received.files]
    assert all(record.score(40) == record.final.mean for record in records)
    # What was done then and what can be asked for now is one protocol.
    (table,), problems = build_tables(records)
    assert set(table.methods) == {"cudc (by ann)", "icm (by ann)"}
    assert problems == []
    assert "--set final_evaluations=1" in " ".join(table.commands)
    lying = theirs()
    del lying["hyperparameters"]["final_evaluations"]
    lying["hyperparameters_hash"] = config_hash(lying["hyperparameters"])
    assert only_problem(lying) == "it has 2 larger evaluations at its end, and by its hyperparameters 1."


def test_trainings_with_other_seeds_stand_beside_each_other_and_their_commands_say_so(ground: Path) -> None:
    other = theirs() | {"seed": 5, "command": theirs()["command"] + " --training-seeds 5"}
    other["final"]["returns"] = [3.0, 4.0]
    received = submit(hand_in(theirs(), other), "ann")
    assert [path.name for path in received.files] == ["td3-seed1.json", "td3-seed1-training5.json"]
    assert load_records([Path("results")]).problems == ()
    silent = theirs("icm") | {"seed": 5}
    assert only_problem(silent) == "its command does not say --training-seeds, and it has 5."
    lying = theirs("icm") | {"command": theirs("icm")["command"] + " --training-seeds 5"}
    assert only_problem(lying) == "its command says --training-seeds 5, and it has 1."


def test_all_or_nothing_with_every_problem_in_a_line(ground: Path) -> None:
    ours(theirs("icm"))
    problems = refused(theirs(), changing("milestones", [40]) | {"created": "2999-01-01"}, theirs(seed=2), {"no": "record"})
    assert [problem.split(":")[0] for problem in problems] == ["mail/1.json", "mail/1.json", "mail/3.json is not a run record"]


def test_copies_are_refused_whatever_they_are_called(ground: Path) -> None:
    ours(theirs())
    assert only_problem(theirs()) == (
        "its returns are, to the last digit, those of results/smoke/0.json (td3 on cudc, walker walk, seed 1, ours)."
    )
    renamed = theirs("icm")
    renamed |= {name: theirs()[name] for name in ("curve", "final", "late")}
    assert "those of results/smoke/0.json (td3 on cudc, walker walk, seed 1, ours)" in only_problem(renamed)
    twice = theirs("icm", seed=3)
    problems = refused(
        theirs("icm", seed=2), theirs("icm", seed=2), twice | {k: theirs("icm", seed=2)[k] for k in ("curve", "final", "late")}
    )
    assert "mail/1.json: it is the same run as mail/0.json; hand in one of them." in problems
    assert any(problem.startswith("mail/2.json: its returns are, to the last digit, those of mail/0.json") for problem in problems)


def test_one_dataset_is_not_two_seeds(ground: Path) -> None:
    second = theirs(seed=2)
    second["dataset"]["fingerprint"] = theirs()["dataset"]["fingerprint"]
    (problem,) = refused(theirs(), second)
    assert "mail/1.json: its dataset has the fingerprint of that of mail/0.json" in problem


def test_a_run_of_ours_that_somebody_repeated_stands_beside_it(ground: Path) -> None:
    mine, other = theirs(), theirs()
    mine["final"]["returns"], mine["late"][0]["returns"] = [1.0, 2.0], [3.0, 4.0]
    ours(mine)
    received = submit(hand_in(other), "ann")
    says = "the same run as results/smoke/0.json (td3 on cudc, walker walk, seed 1, ours), with other returns"
    assert any(says in remark for remark in received.remarks)
    (table,), _ = build_tables(load_records([Path("results")]).records)
    found = {method: table.cells.get((table.milestones[-1], "walk", method)) for method in table.methods}
    assert {method: cell and cell.value for method, cell in found.items()} == {
        "cudc": 2.5, "cudc (by ann)": pytest.approx(sum(other["final"]["returns"] + other["late"][0]["returns"]) / 4),
    }  # fmt: skip


def test_few_different_returns_may_be_the_same(ground: Path) -> None:
    zeros = [theirs(method) for method in ("cudc", "icm")]
    for record in zeros:
        for evaluation in (*record["curve"], record["final"], *record["late"]):
            evaluation["returns"] = [0.0] * len(evaluation["returns"])
    assert len(submit(hand_in(*zeros), "ann").files) == 2


def test_what_lies_among_ours_cannot_be_handed_in(ground: Path) -> None:
    ours(theirs())
    with pytest.raises(RefusedError, match="it lies among the records of 'results' already"):
        submit("results", "ann")
    hand_in(theirs("icm"))
    os.symlink(Path("results/smoke/0.json").absolute(), "mail/link.json")
    with pytest.raises(RefusedError, match="it lies among the records"):
        submit("mail", "ann")


def test_a_record_is_handed_in_as_it_was_made(ground: Path) -> None:
    (kept,) = submit(hand_in(theirs()), "ann").files
    kept.rename("mail/0.json")
    (problem,) = refused(json.loads(Path("mail/0.json").read_text()))
    assert problem == "mail/0.json: it was handed in before, by ann; ask for the file that evaluate wrote."


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"by": ""}, "--by cannot be"), ({"by": "Ann"}, "--by cannot be"), ({"by": "../x"}, "--by cannot be"), ({"by": "a" * 33}, "--by"),
        ({"by": "ann\n"}, "--by cannot be"),
        ({"url": "javascript:alert(1)"}, "--url cannot be"), ({"url": "https://a b"}, "--url"), ({"url": "https://x" * 99}, "--url"),
        ({"note": ""}, "--note cannot be"), ({"note": "a\nb"}, "--note"), ({"note": "\x1b[31m"}, "--note"), ({"note": "x" * 301}, "--note"),
    ],
    ids=lambda value: str(value)[:25],
)  # fmt: skip
def test_who_hands_in_is_named_properly(options: dict[str, str], says: str, ground: Path) -> None:
    hand_in(theirs())
    with pytest.raises(UsageError, match=says):
        submit("mail", **({"by": "ann"} | options))
    assert not Path("results").exists()


def test_nothing_to_hand_in_and_no_place_for_it(ground: Path) -> None:
    Path("empty").mkdir()
    for records, output, says in (("nowhere", "results", "there is no record at"), ("empty", "results", "there is no record in"),
                                  ([], "results", "there is no record in nothing")):  # fmt: skip
        with pytest.raises(UsageError, match=says):
            submit(records, "ann", output=output)
    hand_in(theirs())
    with pytest.raises(UsageError, match="cannot be a folder"):
        submit("mail", "ann", output="mail/0.json")


def test_if_one_cannot_be_written_none_is_and_what_was_is_back(ground: Path) -> None:
    (first,) = submit(hand_in(theirs()), "ann").files
    newer = theirs()
    newer["final"]["returns"] = [3.0, 4.0]
    hand_in(newer, theirs(seed=2))
    blocked = Path("results/submitted/ann/smoke/walker/walk/cudc-seed2-v0")
    blocked.write_text("in the way")
    before = below("results")
    with pytest.raises(RunError, match="cannot write"):
        submit("mail", "ann", overwrite=True)
    assert below("results") == before
    assert read_record(first).final.returns == theirs()["final"]["returns"]


def test_a_file_that_is_far_too_large_is_not_read(ground: Path) -> None:
    hand_in(theirs())
    with Path("mail/big.json").open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(RefusedError, match=r"mail/big\.json is not a run record: it has 1,099,511,627,776 bytes"):
        submit("mail", "ann")


# ------------------------------------------------------------------------------------------------------------------ on the leaderboard


def test_they_stand_apart_in_everything(ground: Path) -> None:
    ours(*(theirs(method, task, seed) for method in ("cudc", "icm") for task in TASKS for seed in (1, 2)))
    alone, _ = build_tables(load_records([Path("results")]).records)
    others = [theirs(task=task, seed=seed) for task in TASKS[:3] for seed in (1, 2, 3)]
    for record in others:
        record |= {"created": "2026-06-01T00:00:00+00:00", "final": {"step": 40, "returns": [float(record["seed"]), 2.5]}}
    submit(hand_in(*others), "ann", url="https://example.org", note="<script> & co")
    report = make_leaderboard(output=None)
    assert report.problems == []
    (table,), (overall,) = report.tables, report.overall
    assert table.methods == ("icm", "cudc", "cudc (by ann)")
    # Our cells hold what they held before.
    for part, before in zip(table.grid.parts, alone[0].grid.parts, strict=True):
        for line, old in zip(part.lines, before.lines, strict=True):
            assert [(cell.value, cell.std, cell.n) for cell in line.entries[:2] if cell] == [
                (c.value, c.std, c.n) for c in old.entries if c
            ]
    assert [(one.name, one.reran) for one in overall.submitted] == [("cudc (by ann)", 0)]
    assert find_missing(report.tables) == report.missing == []
    for text in (to_markdown(table), overall_to_markdown(overall), to_latex(table)):
        assert "Submitted by others, and not run again here: cudc (by ann)." in text.replace("\\", "")
    assert "cudc (by ann): 9 runs; no commit; https://example.org; \\<script\\> \\& co" in to_markdown(table).replace("\\(", "(")
    assert "Submitted" not in to_markdown(alone[0]) + overall_to_markdown(build_overall(alone)[0])


def test_strangers_do_not_decide_which_of_ours_are_odd(ground: Path) -> None:
    """However many they are, placed here by hand with other milestones."""
    mine = Record.model_validate(theirs())
    (kept,) = submit(hand_in(theirs(seed=2)), "ann").files
    other = read_record(kept)
    many = [other.model_copy(update={"milestones": [40], "seed": seed}) for seed in range(3)]
    (table,), problems = build_tables([mine, *many])
    assert table.records == (mine,)
    assert len(problems) == 3


def test_a_record_that_says_where_it_came_from_is_just_read(ground: Path) -> None:
    submit(hand_in(theirs()), "ann")
    moved = Path("elsewhere")
    Path("results").rename(moved)
    (record,) = load_records([moved]).records
    assert column(record) == "cudc (by ann)"
    imported = record.model_copy(update={"dataset": record.dataset.model_copy(update={"source": "ExORL", "steps": 10**7})})
    assert column(imported) == "cudc (ExORL, 10M, by ann)"


@pytest.mark.parametrize(
    "change",
    [
        {"by": "Ann"},
        {"by": "a b"},
        {"url": "javascript:x"},
        {"note": "a\x1b"},
        {"note": ""},
        {"sha256": "x"},
        {"surprise": 1},
        {"by": None},
    ],
    ids=str,
)
def test_a_submission_is_checked_wherever_it_is_read(change: dict[str, Any], ground: Path) -> None:
    (kept,) = submit(hand_in(theirs()), "ann").files
    content = json.loads(kept.read_text())
    content["submission"] |= change
    kept.write_text(json.dumps(content))
    with pytest.raises(RunError, match="is not a run record: submission"):
        read_record(kept)


# ---------------------------------------------------------------------------------------------------------------------------- hostile

quick = settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])


@quick
@given(data=st.data())
def test_changed_records_are_taken_or_refused_and_nothing_else_happens(data: st.DataObject, ground: Path) -> None:
    record = data.draw(changed(copy.deepcopy(theirs())))
    mail = hand_in(record)
    outside, before = below("mail"), below("results")
    try:
        received = submit(mail, "ann", overwrite=True)
    except CudcBenchError:
        assert below("results") == before
    else:
        (file,) = received.files
        assert file.resolve().is_relative_to(Path("results/submitted/ann").resolve())
        assert all(remark.isprintable() for remark in received.remarks)
        assert column(read_record(file)) == f"{record['dataset']['method']} (by ann)"
    assert below("mail") == outside
    assert {path.name for path in Path().iterdir()} <= {"mail", "results"}


@quick
@given(
    where=st.sampled_from(["curve.0.returns", "curve.2.returns", "final.returns"]),
    returns=st.lists(st.floats(0, 1000), min_size=1, max_size=4),
)
def test_only_as_many_possible_returns_as_there_should_be_are_taken(where: str, returns: list[float], ground: Path) -> None:
    hand_in(changing(where, returns))
    right = 2 if where == "final.returns" else 1
    if len(returns) == right:
        (file,) = submit("mail", "ann", overwrite=True).files
        assert json.loads(file.read_text())["curve"] == json.loads(Path("mail/0.json").read_text())["curve"]
    else:
        with pytest.raises(RefusedError, match="episodes"):
            submit("mail", "ann", overwrite=True)


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"\xff\xfe", b"[" * 100_000, b"\0" * 10], ids=lambda content: ascii(content[:9]))
def test_files_that_are_no_records_end_the_command_with_a_line(content: bytes, ground: Path, capfd: pytest.CaptureFixture[str]) -> None:
    hand_in(theirs())
    Path("mail/x.json").write_bytes(content)
    os.mkfifo("mail/pipe.json")
    with pytest.raises(SystemExit) as ended:
        main(["submit", "mail", "--by", "ann"])
    out, err = capfd.readouterr()
    assert (ended.value.code, out) == (2, "")
    *problems, last = err.splitlines()
    assert "mail/pipe.json: it is a pipe" in " ".join(problems).replace("cannot read the record ", "").replace("\n", "")
    assert any("mail/x.json is not a run record" in line for line in problems)
    assert last == "cudc-bench: error: nothing was added: there are 2 problems."
    assert not Path("results").exists()
