"""``make_tiers``: from one online training on a task to the datasets that D4RL has of each: expert, medium, medium-replay and replay."""

from __future__ import annotations

import io
import pickle
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from cudc_bench.artefacts.ids import DatasetId, dataset_path, datasets_root, default_id
from cudc_bench.artefacts.manifest import Manifest, check_free, fingerprint
from cudc_bench.artefacts.provenance import command_line, origin, stamp
from cudc_bench.artefacts.tiers import TIERS, LearningPoint, Tier, step_of
from cudc_bench.data.metadata import write_metadata
from cudc_bench.data.staging import building_path, checkpoints_path, publish, staging, tidy
from cudc_bench.data.writer import Episode, EpisodeShards, write_episodes
from cudc_bench.envs import check_domain, domain_title
from cudc_bench.errors import RunError, UnusableError, UsageError
from cudc_bench.execution import CHECKPOINT_EVERY, LOG_DIR, interrupts
from cudc_bench.execution.checkpoints import Checkpoints
from cudc_bench.execution.progress import Advance, echo
from cudc_bench.execution.runlog import LogTarget, open_log
from cudc_bench.files import check_folder, write_atomically
from cudc_bench.learning.bf16 import echo_if_slower
from cudc_bench.learning.engines import engine_of
from cudc_bench.runs.execution import Execution, Work
from cudc_bench.runs.existing import dataset_stands
from cudc_bench.settings.config import config_hash
from cudc_bench.settings.profiles import resolve_profile
from cudc_bench.settings.seeds import format_seeds

from ..td3 import TD3
from .loop import Arena, Outcome
from .online import PolicyInteraction, run_online
from .training import Member, OnlineTraining, names_of

ALGORITHM = "td3"
# A reference's ten are so far apart that a policy can go from a tenth to all of the final score between two. The training is the same.
EVALUATIONS = 40
_POLICIES = ("expert", "medium")  # of which one policy each acts anew


@dataclass(frozen=True)
class TiersPlan(OnlineTraining):
    """The tiers of one command.

    Attributes, beside those of every online training:
        data_steps: environment steps of the datasets of one policy.
    """

    data_steps: int

    @property
    def values(self) -> dict[str, Any]:
        """All hyperparameters by name."""
        return super().values | {"data_steps": self.data_steps}

    @property
    def changes(self) -> dict[str, Any]:
        """Those that differ from the profile's."""
        return self.overrides | ({} if self.data_steps == self.loop.steps else {"data_steps": self.data_steps})

    def id(self, member: Member, kind: str) -> DatasetId:
        """Of a member's dataset."""
        return default_id(self.domain, kind, member.seed, self.profile).for_task(member.task)

    def ids(self, member: Member) -> dict[str, DatasetId]:
        """All of a member's, by their kinds."""
        return {kind: self.id(member, kind) for kind in TIERS}

    def is_made(self, member: Member, kind: str) -> bool:
        """Whether a dataset is there, and is what this would make."""
        wanted = (kind, self.domain, member.task, member.seed, self.profile, config_hash(self.values))
        return dataset_stands(
            self.id(member, kind),
            lambda there: (
                there.tier is not None
                and (there.tier.kind, there.domain, there.task, there.seed, there.profile, there.hyperparameters_hash) == wanted
            ),
        )

    def left(self, member: Member) -> list[str]:
        """The kinds that are not made yet."""
        return [kind for kind in TIERS if not self.is_made(member, kind)]


@dataclass(frozen=True)
class Stack:
    """Members that are trained side by side; what they have done so far lies with the unfinished replay of the first."""

    plan: TiersPlan
    members: list[Member]

    @property
    def seeds(self) -> list[int]:
        """Of the members."""
        return [one.seed for one in self.members]

    @property
    def place(self) -> DatasetId:
        """Of the dataset that is published last."""
        return self.plan.id(self.members[0], "replay")

    @property
    def label(self) -> str:
        """What stands beside their progress bar."""
        return f"{ALGORITHM} online: {names_of(self.members)}"

    @property
    def name(self) -> str:
        """What they make, as messages say it."""
        return f"the tiers of {names_of(self.members)} at {self.plan.profile}"

    def checkpoints(self, every: float = CHECKPOINT_EVERY, kind: str = "") -> Checkpoints:
        """Where the state of their training is kept, or that of the policies of a kind while these act."""
        plan, folder = self.plan, checkpoints_path(self.place)
        decisive = {
            "hyperparameters": plan.values, "domain": plan.domain, "members": [f"{one.task} seed {one.seed}" for one in self.members],
            "device": plan.device, "engine": plan.engine, **origin({}),
        }  # fmt: skip
        return Checkpoints(folder.with_name(f"{folder.name}-{kind}") if kind else folder, decisive, every)

    def rehearse(self, members: int) -> None:
        """See :class:`~cudc_bench.runs.memory.Rehearsing`."""
        self.plan.rehearse(self.members[:members])

    def is_interrupted(self) -> bool:
        """Whether these very members have been begun and not ended."""
        try:
            return self.checkpoints().check("", "tiers")
        except UsageError:
            return False


@interrupts.leaving_gracefully()
def make_tiers(
    domain: str = "walker",
    tasks: Sequence[str] | None = None,
    seeds: Sequence[int] = (1,),
    *,
    steps: int | None = None,
    profile: str = "auto",
    settings: Mapping[str, Any] | None = None,
    overwrite: bool = False,
    device: str = "auto",
    engine: str = "auto",
    workers: int | None = 1,
    log: str | None = None,
    log_dir: str | Path = LOG_DIR,
    checkpoint_every: float = CHECKPOINT_EVERY,
    fresh: bool = False,
) -> list[str]:
    """Train TD3 online on tasks, as a reference is trained, and keep the datasets of each training that D4RL has (Fu et al. 2020).

    ``replay`` is all that the training did, random actions of its beginning included; ``medium-replay`` what it did until its policy first
    got more than a third of the final one's score; ``expert`` and ``medium`` are what the final and that policy do. Departs from D4RL:
    evaluations come after every fortieth of the training; TD3's policy is deterministic where SAC's is not, so that it acts with
    the Gaussian noise that the training explored with, without which every state would have one action only; episodes end by time.
    Rewards are those that the simulation gave. Datasets that exist and are of these very trainings are kept. A run that was interrupted is
    continued where its last checkpoint was taken, with the same result as if it had not been.

    Args:
        domain: a registered domain.
        tasks: of the domain; all unless given.
        seeds: of the trainings; four datasets each.
        steps: environment steps of the datasets of one policy; as many as the training has unless given.
        profile: ``paper``, ``cpu``, ``demo``, ``smoke`` or ``auto``.
        settings: hyperparameters that differ from the profile, by name.
        overwrite: replace datasets that exist.
        device: ``cpu``, ``cuda`` or ``auto``.
        engine: how updates are carried out: ``eager``, ``compiled``, or ``auto``, which compiles long runs on a CPU that has a compiler.
        workers: processes on a CPU; 1 works in this process, None takes one for each core.
        log: also send training metrics and mean returns to ``"tensorboard"`` or ``"wandb"`` while they are measured.
        log_dir: the folder of these logs; a run's own is ``tiers/<profile>/<replay's id>`` in it.
        checkpoint_every: seconds between two checkpoints at least; they lie in a hidden folder beside the replay's until it is there.
        fresh: start over where a run was interrupted.

    Returns:
        The ids of the datasets, by task, seed and kind.

    Raises:
        UsageError: wrong input, or a run with other settings was interrupted; nothing has been trained.
        RunError: the run failed; what it had done until its last checkpoint is kept.
        Interrupted: the process was asked to leave; what it had done is kept.
    """
    execution = Execution.checked(
        device, workers, checkpoint_every, engine=engine, fresh=fresh, overwrite=overwrite, log=log, log_dir=log_dir
    )
    plan = TiersPlan.checked(domain, tasks, seeds, profile, settings or {}, execution, {"evaluations": EVALUATIONS}, data_steps=0)
    plan = replace(plan, data_steps=plan.loop.steps if steps is None else steps)
    members = [Member(task, seed) for task in plan.tasks for seed in plan.seeds]
    left = [one for one in members if overwrite or plan.left(one)]
    for member in members:
        for kind, one in plan.ids(member).items():
            check_free(one, overwrite or plan.is_made(member, kind))
    check_folder(datasets_root(), "the dataset root")
    work = Work.plan(execution, "tiers", [members], left, partial(Stack, plan))
    for member in members:
        if member not in left:
            for one in plan.ids(member).values():
                tidy(one)
    kept = len(members) - len(left)
    echo(
        f"tiers of {', '.join(plan.tasks)} on {domain}: profile {plan.profile}, TD3 online, seeds {format_seeds(plan.seeds)},"
        f" {plan.loop.steps:,} steps each, {plan.device}" + (f"; those of {kept} trainings made before are kept" if kept else "")
    )
    if work.stacks:
        echo_if_slower(plan.loop.precision, plan.config, plan.engine, plan.device)
    total = plan.loop.steps + len(_POLICIES) * plan.data_steps
    work.carry_out(tier_members, unit="steps", total=total, threads=resolve_profile(profile).threads)
    for member in left:
        for one in plan.ids(member).values():
            echo(f"wrote {one} to {dataset_path(one)}")
    return [str(one) for member in members for one in plan.ids(member).values()]


def tier_members(advance: Advance, *, stack: Stack, execution: Execution) -> None:
    """Train some members in this process, let their policies act, and publish their datasets (the job of :func:`make_tiers`)."""
    plan = stack.plan
    with ExitStack() as opened:
        folder = opened.enter_context(staging(stack.place, resume=not execution.fresh))
        if not execution.overwrite and not any(map(plan.left, stack.members)):
            return  # by another process, while this one was starting
        shards = {kind: [_shards(folder, one, kind) for one in stack.members] for kind in (*_POLICIES, "replay")}
        checkpoints = stack.checkpoints(execution.checkpoint_every)
        found = _finished(checkpoints, shards["replay"])
        if found is None:
            logs = [opened.enter_context(open_log(_target(plan, one, execution))) for one in stack.members]
            agent = plan.agent(stack.seeds)
            outcomes = run_online(
                agent, plan.loop, check_domain(plan.domain), [one.task for one in stack.members],
                Arena(check_domain(plan.domain), [one.task for one in stack.members]), advance, shards["replay"], logs, checkpoints,
                partial(_keep_policies, agent, folder),
            )  # fmt: skip
            found = _finish(stack, agent, outcomes, folder, checkpoints, shards["replay"])
        else:
            advance(plan.loop.steps)
        seconds = float(found["seconds"])
        for kind in _POLICIES:
            seconds += _act(stack, kind, found["policies"][kind], shards[kind], advance, execution)
        for member, curve, expert_score in reversed(list(zip(stack.members, found["curves"], found["experts"], strict=True))):
            points, place = [LearningPoint(step=step, score=score) for step, score in curve], stack.members.index(member)
            for kind in TIERS:
                tier = _tier(kind, points, expert_score)
                episodes = iter(shards[kind if kind in _POLICIES else "replay"][place])
                _publish(plan, member, tier, episodes, found["engine"], seconds, execution, folder)


def _shards(folder: Path, member: Member, kind: str) -> EpisodeShards:
    return EpisodeShards(folder / f"{member.task}-seed{member.seed}-{kind}")


def _target(plan: TiersPlan, one: Member, execution: Execution) -> LogTarget | None:
    if execution.log is None:
        return None
    place, title = str(plan.id(one, "replay")), f"{one.task}-seed{one.seed}"
    return LogTarget(execution.log, execution.log_dir, "tiers", plan.profile, plan.domain, place, title, plan.values)


# The training


def _keep_policies(agent: TD3, folder: Path, step: int) -> None:
    """Keep the policies that were just evaluated; which of them is wanted is known at the end."""
    content = io.BytesIO()
    torch.save({name: value.cpu().clone() for name, value in agent.policy.state_dict().items()}, content)
    write_atomically(_policies(folder, step), content.getvalue())


def _policies(folder: Path, step: int) -> Path:
    return folder / "policies" / f"{step:012d}.pt"


def _finish(
    stack: Stack, agent: TD3, outcomes: Sequence[Outcome], folder: Path, checkpoints: Checkpoints, replays: Sequence[EpisodeShards]
) -> dict[str, Any]:
    """Keep what came out of a training in its last checkpoint: scores, and the policies of the datasets of one."""
    curves = [[(step, sum(returns) / len(returns)) for step, returns in one.curve] for one in outcomes]
    experts = [sum(one.finals[0][1]) / len(one.finals[0][1]) for one in outcomes]
    policies: dict[str, dict[str, Tensor]] = {}
    for kind in _POLICIES:
        steps = [_tier(kind, [LearningPoint(step=step, score=score) for step, score in one], best).step
                 for one, best in zip(curves, experts, strict=True)]  # fmt: skip
        weights = [_policy_at(folder, step, stack) for step in steps]
        policies[kind] = {name: torch.cat([one[name][place : place + 1] for place, one in enumerate(weights)]) for name in weights[0]}
    found = {
        "seconds": checkpoints.seconds, "engine": engine_of(agent), "curves": curves, "experts": experts, "policies": policies,
        "replays": [one.state_dict() for one in replays],
    }  # fmt: skip
    checkpoints.save(stack.plan.loop.steps, {"finished": found})
    return found


def _policy_at(folder: Path, step: int, stack: Stack) -> dict[str, Tensor]:
    """The weights that were kept of all members.

    Raises:
        RunError: they are gone or damaged.
    """
    try:
        found: dict[str, Tensor] = torch.load(_policies(folder, step), weights_only=True)
        return found
    except (OSError, EOFError, RuntimeError, ValueError, pickle.UnpicklingError):
        raise RunError(f"the policy at step {step:,} of {stack.name} was not kept whole; start over: cudc-bench tiers --fresh.") from None


def _finished(checkpoints: Checkpoints, replays: Sequence[EpisodeShards]) -> dict[str, Any] | None:
    """What a training came to that is at its end, with its episodes in their shards; None if it is not there yet."""
    found: list[dict[str, Any]] = []

    def restore(_: int, state: dict[str, Any]) -> None:
        if "finished" in state:
            there = state["finished"]
            try:
                for shards, part in zip(replays, there["replays"], strict=True):
                    shards.check(part)
            except UnusableError:
                checkpoints.remove()  # Without the episodes there is nothing to go on with.
                return
            for shards, part in zip(replays, there["replays"], strict=True):
                shards.load_state_dict(part)
            found.append(there)

    checkpoints.load(restore)
    return found[0] if found else None


def _tier(kind: str, curve: Sequence[LearningPoint], expert_score: float) -> Tier:
    step = step_of(kind, curve, expert_score)
    score = next(point.score for point in curve if point.step == step)
    return Tier.model_validate(
        {"kind": kind, "algorithm": ALGORITHM, "step": step, "score": score, "expert_score": expert_score, "curve": list(curve)}
    )


# The datasets


def _act(
    stack: Stack, kind: str, policies: Mapping[str, Tensor], shards: Sequence[EpisodeShards], advance: Advance, execution: Execution
) -> float:
    """Let the policies of one kind act, and return the seconds that it took."""
    plan, agent = stack.plan, stack.plan.agent(stack.seeds)
    agent.policy.load_state_dict(dict(policies))
    checkpoints = stack.checkpoints(execution.checkpoint_every, kind)
    pace = replace(plan.loop, steps=plan.data_steps)
    facts, tasks = check_domain(plan.domain), [one.task for one in stack.members]
    PolicyInteraction(agent, pace, facts, tasks, shards, learns=False, stream=f"act {kind}").run(advance, checkpoints)
    return checkpoints.seconds


def _publish(
    plan: TiersPlan, member: Member, tier: Tier, episodes: Iterator[Episode], engine: str, seconds: float, execution: Execution,
    folder: Path,
) -> None:  # fmt: skip
    one = plan.id(member, tier.kind)
    if not execution.overwrite and plan.is_made(member, tier.kind):
        return
    with ExitStack() as opened:
        # The first replay's own folder holds all that is needed until every dataset is there.
        building = folder if building_path(one) == folder else opened.enter_context(staging(one))
        dataset = building / "dataset"
        written = write_episodes(dataset / "data", _until(episodes, tier.step) if tier.kind == "medium-replay" else episodes)
        values = plan.values
        manifest = Manifest(
            domain=plan.domain,
            task=member.task,
            method=tier.kind,
            seed=member.seed,
            steps=written.steps,
            episodes=written.episodes,
            profile=plan.profile,
            overrides=plan.changes,
            hyperparameters=values,
            hyperparameters_hash=config_hash(values),
            citation=TD3.citation,
            fields=written.fields,
            fingerprint=fingerprint(written.fields),
            tier=tier,
            command=_command(plan, member, execution),
            **stamp(seconds, plan.device, torch.get_num_threads(), engine=engine),
        )
        write_metadata(dataset / "data", manifest, str(one), _description(plan, member, tier))
        publish(dataset, one)


def _until(episodes: Iterator[Episode], steps: int) -> Iterator[Episode]:
    """The first so many steps; the episode in which they end is cut short."""
    for episode in episodes:
        length = min(len(episode.actions), steps)
        if not length:
            return
        rows = {name: array[: length + 1] for name, array in episode.infos.items()}
        rewards = None if episode.rewards is None else episode.rewards[:length]
        yield Episode(episode.seed, episode.observations[: length + 1], episode.actions[:length], rows, rewards)
        steps -= length


def _description(plan: TiersPlan, member: Member, tier: Tier) -> str:
    training = f"the online training of TD3 on {domain_title(plan.domain)}'s task {member.task}"
    whose = {
        "expert": f"The final policy of {training}, acting with noise",
        "medium": f"A policy of {training} with more than a third of the final one's score, acting with noise",
        "medium-replay": f"All that {training} did in its first {tier.step:,} steps",
        "replay": f"All that {training} did",
    }[tier.kind]
    return f"{whose}. The rewards are those of {member.task}, as the simulation gave them."


def _command(plan: TiersPlan, member: Member, execution: Execution) -> str:
    options = {"--domain": plan.domain, "--task": member.task, "--seed": str(member.seed), "--profile": plan.profile} | execution.options
    if plan.data_steps != plan.loop.steps:
        options["--steps"] = str(plan.data_steps)
    return command_line("tiers", options, plan.overrides)
