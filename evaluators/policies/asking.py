"""``ask``: from a trained zero-shot learner and a reward function to a policy, its score and a video, without training."""

from __future__ import annotations

import hashlib
import io
import re
import shlex
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import invalidate_caches
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from cudc_bench import plugins
from cudc_bench.artefacts.manifest import RewardFunction, exists, read_manifest
from cudc_bench.artefacts.provenance import command_line, commit, machine, versions
from cudc_bench.artefacts.records import LABELS, Evaluation, LabelSource, Record, ZeroShot, read_record, record_path, write_record
from cudc_bench.data.reader import load_episodes
from cudc_bench.envs import Domain, check_domain, check_tasks, make_simulators
from cudc_bench.envs.rewards import CustomReward, Measured, load_reward
from cudc_bench.envs.simulator import Float32
from cudc_bench.errors import UsageError
from cudc_bench.execution.parallel import Job, run_jobs
from cudc_bench.execution.progress import Advance, warn
from cudc_bench.files import check_folder, check_path, read_limited, unwritable, write_atomically

from ..running.labels import Interview, Question, draw_labels
from ..running.loop import FINAL, Arena
from ..zero_shot import ZeroShotLearner
from .stored import LEARNER, load_learner, save_policy

_LARGEST_GOAL = 1_000_000  # bytes
_GOAL = '''"""A goal that a learner without rewards was asked to reach: the reward is minus the distance from its observation."""

import numpy as np

GOAL = np.array([{numbers}], np.float32)


def {name}(measured):
    return -np.linalg.norm(measured["observation"] - GOAL, axis=-1)
'''


@dataclass(frozen=True)
class Asked:
    """What a learner answered.

    Attributes:
        record: the path of a record of it, with the policy beside it, as :func:`render_policy` and :func:`export_policy` take it.
        returns: undiscounted, of each episode.
        norm: the length of the task's vector before it was scaled; 0 if no label has a reward.
        rewarded: share of the labels that have one.
        seconds: from the question to the returns.
    """

    record: Path
    returns: tuple[float, ...]
    norm: float
    rewarded: float
    seconds: float


def ask_policy(
    policy: str | Path,
    reward: str | Callable[[Measured], Any] | None = None,
    *,
    task: str | None = None,
    goal: str | Path | ArrayLike | None = None,
    labels: int = LABELS,
    labels_from: str | None = None,
    episodes: int = 10,
    output: str | Path = "asked",
) -> Asked:
    """Ask a trained zero-shot learner for a policy that pursues a reward which it was never trained on, and try it.

    Args:
        policy: a record of the learner, of any task, or its file ``*.learner.pt``.
        reward: an own reward function, ``"module:function"`` or itself; see ``cudc_bench.envs.rewards``.
        task: a task of the domain instead.
        goal: a state to reach instead: an observation (S,) or a physics state (P,), or a file ``*.npy`` of one, or ``"3:500"``, step 500 of
            episode 3 of the dataset. The reward is then minus the distance from its observation, by a function that is written into the
            output, where :func:`render_policy` and others find it as any other.
        labels: how many transitions' rewards it is told.
        labels_from: the dataset that they are drawn from; that which it was trained on unless given.
        episodes: how many it is tried in.
        output: folder of the answer's record and policy. They are no results of a training, and belong in no table.

    Raises:
        UsageError: wrong input, or the dataset of the labels is not here.
        RunError: the learner's files are missing or damaged, or the reward function failed.
    """
    start = time.monotonic()
    place = _record_of(check_path(policy, "the policy"))
    record = read_record(place)
    facts = check_domain(record.dataset.domain)
    if (reward is not None) + (task is not None) + (goal is not None) != 1:
        raise UsageError("ask for one thing: --reward module:function, --task or --goal.")
    if record.zero_shot is None:
        raise UsageError(f"{record.algorithm} was trained for {record.dataset.task} alone; ask learners without rewards, such as fb.")
    if episodes < 1:
        raise UsageError(f"--episodes takes 1 or more, not {episodes}.")
    folder = check_folder(output, "the output")
    wanted = None if goal is None else goal_observation(goal, labels_from or record.dataset.id, facts)
    if wanted is not None:
        if not plugins.load("evaluators", record.algorithm).has_goals:
            raise UsageError(f"{record.algorithm} takes no --goal: a state alone is no task for it; give --reward.")
        reward = write_goal(wanted, folder)
    custom, question, source = _question(record, facts, reward, task, labels, labels_from)
    agent = load_learner(place, record)
    used = record.dataset.used if labels_from is None else None
    (answer,) = run_jobs(
        _answer, [Job(f"ask for {question.task}", 2, {
            "agent": agent, "facts": facts, "question": question, "custom": custom, "source": source, "used": used, "episodes": episodes,
            "step": record.final.step, "goal": wanted,
        })], unit="steps", workers=1, threads=1,
    )  # fmt: skip
    returns, interview = answer
    told = interview.told()
    rewards = interview.labelled(question).reward
    norm, rule = float(told.norms), agent.rule
    # A goal is the one state with a reward, beside those that were drawn.
    rewarded = float((rewards != 0).double().mean()) if goal is None else 1 / (rewards.numel() + 1)
    rule += "" if goal is None else ", with a reward at the goal alone"
    if norm == 0.0:
        warn(f"none of the {rewards.numel():,} labels has a reward, so that this policy pursues nothing")
    seconds = round(time.monotonic() - start, 1)
    options = {"--task": question.task} if custom is None else {"--reward": custom.reference}
    if isinstance(goal, str | Path):
        options = {"--goal": str(goal)}
    options |= {} if labels == LABELS else {"--labels": str(labels)}
    options |= {} if labels_from is None else {"--labels-from": labels_from}
    evaluation = Evaluation(step=record.final.step, returns=returns)
    head, dirty = commit()
    shared = record.zero_shot
    assert shared is not None
    found = record.model_copy(
        update={
            "dataset": record.dataset.model_copy(update={"task": question.task, "reward": question.reward}),
            "milestones": [record.final.step], "curve": [evaluation], "final": evaluation, "late": [], "metrics": [], "seconds": seconds,
            "versions": versions(), "commit": head, "dirty": dirty, "machine": machine("cpu", 1), "submission": None,
            "command": command_line(f"ask {shlex.quote(str(place))}", options, {}),
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
            "zero_shot": ZeroShot(
                labels=labels, drawn=rewards.numel(), source=question.source, rule=rule, norm=norm, rewarded=rewarded,
                training=shared.training, records=1, training_seconds=shared.training_seconds,
            ),
        }
    )  # fmt: skip
    path = record_path(
        folder, found.labelled_id, found.algorithm, found.dataset.seed, found.profile, found.dataset.used, found.seed, labels
    )
    save_policy(agent.policy_for(told.z[:, 0]), 0, path)
    write_record(path, found)
    return Asked(path, tuple(returns), norm, rewarded, seconds)


def _record_of(path: Path) -> Path:
    """A record of the learner that a user named by one, or by the learner's own file."""
    if not path.is_file():
        raise UsageError(f"there is no file '{path}'; name a record of a zero-shot learner, as cudc-bench evaluate printed it.")
    if not path.name.endswith(LEARNER):
        return path
    # Its records are those of the tasks: beside the folder of its dataset, in one for each task.
    stem = path.name.removesuffix(LEARNER)
    names = (stem, stem.replace("-seed", "-labels*-seed", 1))
    beside = [one for name in names for one in sorted(path.parent.parent.glob(f"*/{path.parent.name}/{name}.json"))]
    if not beside:
        raise UsageError(f"there is no record of the learner {path}; name one of those that cudc-bench evaluate printed.")
    return beside[0]


def _question(
    record: Record, facts: Domain, reward: str | Callable[[Measured], Any] | None, task: str | None, labels: int, labels_from: str | None
) -> tuple[CustomReward | None, Question, str]:
    """The own function, if it is one, the question, and the dataset of its labels.

    Raises:
        UsageError: it cannot be asked.
    """
    if labels < 1:
        raise UsageError(f"--labels takes 1 or more, not {labels}.")
    custom = None if reward is None else load_reward(reward, facts)
    name = check_tasks(facts, [str(task)])[0] if custom is None else custom.name
    data = labels_from or record.dataset.id
    if not exists(data):
        raise UsageError(f"the labels are drawn from '{data}', which is not here; name another dataset with --labels-from.")
    manifest = read_manifest(data)
    if manifest.domain != facts.name or "infos/physics" not in manifest.fields:
        raise UsageError(f"'{data}' is no dataset of {facts.name} with physics states; name another with --labels-from.")
    if labels_from is None and manifest.fingerprint != record.dataset.fingerprint:
        raise UsageError(f"'{data}' is not the dataset that it was trained on; name one with --labels-from.")
    source = None if labels_from is None else LabelSource(id=labels_from, fingerprint=manifest.fingerprint)
    own = None if custom is None else RewardFunction(reference=custom.reference, sha256=custom.sha256)
    return custom, Question(name, labels, own, source), data


def goal_observation(goal: str | Path | ArrayLike, dataset_id: str, domain: Domain) -> Float32:
    """The observation (S,) of a goal, as :func:`ask_policy` takes it.

    Raises:
        UsageError: there is no such file, episode or step, or it holds no state of the domain.
    """
    if isinstance(goal, str) and (match := re.fullmatch(r"(\d+):(\d+)", goal)):
        if not exists(dataset_id):
            raise UsageError(f"--goal {goal} is a state of '{dataset_id}', which is not here.")
        episode, step = map(int, match.groups())
        flat = load_episodes(dataset_id, ("observations",))
        if episode >= len(flat.lengths) or step > flat.lengths[episode]:
            raise UsageError(f"'{dataset_id}' has no step {step} of episode {episode}; it has {len(flat.lengths)} episodes, from 0 on.")
        found: Float32 = flat.split("observations")[episode][step]
        return found
    if isinstance(goal, str | Path):
        path = check_path(goal, "the goal")
        try:
            array = np.load(io.BytesIO(read_limited(path, _LARGEST_GOAL)), allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise UsageError(f"--goal takes a file *.npy of a state, or EPISODE:STEP, not '{goal}' ({error}).") from None
    else:
        array = np.asarray(goal)
    if array.dtype.kind not in "fiu" or not np.isfinite(array).all():
        raise UsageError("a goal is a state of finite real numbers.")
    if array.shape == (domain.observation_size,):
        return array.astype(np.float32)
    if array.shape != (domain.physics_size,):
        sizes = f"an observation ({domain.observation_size},) or a physics state ({domain.physics_size},)"
        raise UsageError(f"a goal of {domain.name} is {sizes}, not of shape {array.shape}.")
    (simulator,) = make_simulators(domain.name, 1)
    observation = np.empty(domain.observation_size, np.float32)
    simulator.set_state(array.astype(np.float64))
    simulator.observe(observation)
    return observation


def write_goal(observation: Float32, folder: Path) -> str:
    """Write the reward function of a goal into a folder, where Python finds it from now on, and return its reference."""
    name = f"goal_{hashlib.sha256(observation.tobytes()).hexdigest()[:8]}"
    text = _GOAL.format(name=name, numbers=", ".join(repr(float(one)) for one in observation))
    try:
        write_atomically(folder / f"{name}.py", text.encode())
    except OSError as error:
        raise unwritable(f"the goal {folder / name}.py", error) from None
    if str(folder.absolute()) not in sys.path:
        sys.path.append(str(folder.absolute()))
    invalidate_caches()
    return f"{name}:{name}"


def _answer(
    advance: Advance, *, agent: ZeroShotLearner, facts: Domain, question: Question, custom: CustomReward | None, source: str,
    used: int | None, episodes: int, step: int, goal: Float32 | None,
) -> tuple[list[float], Interview]:  # fmt: skip
    samples = draw_labels(source, facts, [question.task], question.labels, custom, used)
    interview = Interview(agent, [samples], [question], None if goal is None else torch.from_numpy(goal)[None])
    actor = interview.actor()
    advance(1)
    returns = Arena(facts, custom or [question.task]).evaluate(actor, agent.seeds, FINAL, step, episodes)
    advance(1)
    row: list[float] = np.asarray(returns)[0].tolist()
    return row, interview
