"""Runs with their policies, made without training: what counts here is that the policy is found again as it was."""

import numpy as np
import torch

from cudc_bench.artefacts.manifest import RewardFunction
from cudc_bench.artefacts.provenance import versions
from cudc_bench.artefacts.records import DatasetReference, Evaluation, Record, write_record
from cudc_bench.envs import DOMAINS
from cudc_bench.evaluators.policies.rollout import recorded_seeds
from cudc_bench.evaluators.policies.stored import save_policy
from cudc_bench.evaluators.running.loop import Arena
from cudc_bench.settings.config import as_dict, config_hash
from cudc_bench.settings.evaluate_config import EvaluateConfig

from .helpers import make

STEPS = 40


def write_run(folder, name="td3", domain="walker", task="walk", seed=1, returns=(1.0, 2.0), played=0, reward=None, **settings):
    """Write the record of an agent and its policy beside it.

    Args:
        returns: what the record says of its final evaluation, unless episodes are
        played: really, side by side as evaluation does it.
        reward: an own reward function, of ``cudc_bench.envs.rewards``.

    Returns:
        The record's path, and the agent.
    """
    facts = DOMAINS[domain]
    agent = make(name, (seed,), facts.observation_size, facts.action_size, **settings)
    # Further from zero than fresh networks are: every body then moves.
    with torch.no_grad():
        for parameter in agent.policy.parameters():
            parameter.add_(0.3 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(7)))
    loop = EvaluateConfig(STEPS, 20, 2, max(played, 1), (20, STEPS))
    values = as_dict(loop, agent.config)
    record = Record(
        dataset=DatasetReference(
            id=f"{domain}/{task}/cudc-smoke-v0", fingerprint="0" * 64, domain=domain, task=task, method="cudc", seed=seed, steps=1000,
            profile="smoke", reward=None if reward is None else RewardFunction(reference=reward.reference, sha256=reward.sha256),
        ),
        algorithm=name, profile="smoke", seed=seed, hyperparameters=values, hyperparameters_hash=config_hash(values),
        milestones=[20, STEPS], curve=[Evaluation(step=STEPS, returns=[0.0])], final=Evaluation(step=STEPS, returns=list(returns)),
        seconds=1.0, versions=versions(), machine={"threads": torch.get_num_threads()}, command="cudc-bench evaluate --algo td3",
        created="2024-01-01T00:00:00+00:00",
    )  # fmt: skip
    if played:
        arena = Arena(facts, [task] if reward is None else reward)
        final = arena.returns(agent, [recorded_seeds(record, played)])[0]
        assert len(np.unique(final)) == played
        record = record.model_copy(update={"final": Evaluation(step=STEPS, returns=final.tolist())})
    path = folder / f"{name}-seed{seed}.json"
    folder.mkdir(parents=True, exist_ok=True)
    write_record(path, record)
    save_policy(agent.policy, 0, path)
    return path, agent


def change(path, **fields):
    """Rewrite a record with other fields."""
    import json

    path.write_text(json.dumps(json.loads(path.read_text()) | fields))
