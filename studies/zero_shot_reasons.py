"""Why a learner without rewards is at the floor, or is not: what its embeddings say of rewards, and what one step of improvement can reach.

``python studies/zero_shot_reasons.py embeddings RECORD …`` asks trained learners, whose files lie beside their records: the correlation of
z · (embedding) with the reward over the labels, and the share of action components at their bounds.

``python studies/zero_shot_reasons.py one-step DATASET …`` trains TD3 on labelled datasets with the dataset's own next action in its
targets, so that the actor is one step of improvement over the policy that collected, as one-step FB's is.
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch

from cudc_bench.artefacts.manifest import read_manifest
from cudc_bench.artefacts.records import read_record
from cudc_bench.envs import check_domain
from cudc_bench.evaluators.fb_onestep import OneStepFB
from cudc_bench.evaluators.policies.stored import load_learner
from cudc_bench.evaluators.running.datasets import load_members
from cudc_bench.evaluators.running.labels import Interview, Question, draw_labels
from cudc_bench.evaluators.running.loop import Arena, run_evaluation
from cudc_bench.evaluators.running.plans import make_plans
from cudc_bench.evaluators.td3 import TD3
from cudc_bench.learning.engines import set_engine
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.profiles import resolve_profile

STEPS = 24_000


class OneStepTD3(TD3):
    """TD3 whose critics are those of the policy that collected."""

    wants_next_action = True

    def next_action(self, batch: Batch) -> torch.Tensor:
        assert batch.next_action is not None
        return batch.next_action


def embeddings(path: Path) -> None:
    """Print what a record's learner makes of its labels."""
    record = read_record(path)
    agent = load_learner(path, record)
    assert record.zero_shot is not None, f"{path} is no record of a learner without rewards"
    task, labels = record.dataset.task, record.zero_shot.labels
    samples = draw_labels(record.dataset.id, check_domain(record.dataset.domain), [task], labels)
    told = Interview(agent, [samples], [Question(task, labels)]).told()
    with torch.no_grad():
        if isinstance(agent, OneStepFB):
            found = agent.backward_map(torch.cat([samples.observation, samples.action], -1)[None])[0]
        else:
            embed = next(getattr(agent, name) for name in ("backward_map", "task_encoder", "features") if hasattr(agent, name))
            found = embed(samples.next_observation[None])[0]
        said = torch.stack([found @ told.z[0, 0], samples.rewards[task]])
        actions = agent.act_for(samples.observation[None], told.z[:, :1].expand(1, len(found), -1))
    correlation, bounded = torch.corrcoef(said)[0, 1], (actions.abs() > 0.99).double().mean()
    print(f"| `{record.algorithm}` | {task} | {correlation:.2f} | {bounded:.0%} |", flush=True)


def one_step(dataset: str) -> None:
    """Train on a labelled dataset and print the mean return of the evaluations of the second half."""
    manifest = read_manifest(dataset)
    facts = check_domain(manifest.domain)
    (plan,) = make_plans(
        ["td3"],
        resolve_profile("cpu"),
        {"evaluate_every": STEPS // 8, "final_evaluations": 4, "final_episodes": 5, "milestones": [STEPS]},
        STEPS,
    )
    agent = OneStepTD3(facts.observation_size, facts.action_size, plan.config, [manifest.seed])
    set_engine(agent, "compiled")
    data = load_members([dataset], [manifest.seed], "cpu")
    (outcome,) = run_evaluation(agent, data, plan.loop, Arena(facts, [str(manifest.task)]), lambda _: None)
    means = [sum(returns) / len(returns) for _, returns in outcome.curve[1:]]
    late = [one for _, returns in outcome.finals for one in returns]
    print(f"| {manifest.task} | {sum(late) / len(late):.0f} | {', '.join(f'{one:.0f}' for one in means)} |", flush=True)


if __name__ == "__main__":
    torch.set_num_threads(1)
    show = {"embeddings": lambda one: embeddings(Path(one)), "one-step": one_step}[sys.argv[1]]
    for one in sys.argv[2:]:
        show(one)
