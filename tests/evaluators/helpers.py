"""Small offline agents and datasets in memory for tests."""

import numpy as np
import torch

from cudc_bench import plugins
from cudc_bench.config import build
from cudc_bench.envs import DOMAINS, make_simulators, reward_function
from cudc_bench.networks import MemberRandom
from cudc_bench.replay import Batch, Episodes

SMALL = {"width": 16, "batch_size": 32, "learning_rate": 1e-3}


def make(name="td3", seeds=(1,), observation=24, action=6, **settings):
    """A registered evaluator at a small size."""
    kind = plugins.load("evaluators", name)
    return kind(observation, action, build(kind.config_class, SMALL, settings), list(seeds))


def batch_for(agent, observation=24, action=6, size=32, seed=0, measure=False):
    """Random labelled one-step transitions; member e gets those of ``seed + 1000 e``."""
    parts = []
    for member in range(len(agent.seeds)):
        g = torch.Generator().manual_seed(seed + 1000 * member)
        parts.append(
            (
                torch.randn(size, observation, generator=g),
                torch.rand(size, action, generator=g) * 2 - 1,
                torch.randn(size, observation, generator=g),
                torch.rand(size, generator=g),
            )
        )
    s, a, following, r = (torch.stack(values) for values in zip(*parts, strict=True))
    return Batch(s, a, following, torch.ones(len(agent.seeds), dtype=torch.int64), r, measure)


def random_walker_data(episodes, task, seeds):
    """Episodes of uniformly random actions on Walker, labelled with the live rewards of a task, for a stack of members."""
    simulator, rewards = make_simulators("walker", 1)[0], reward_function("walker")
    rng = np.random.default_rng(0)
    data = Episodes(1, episodes, episodes * 1000, 24, 6, MemberRandom(seeds, "replay"), [0] * len(seeds))
    labels = []
    for episode in range(episodes):
        observations = np.empty((1001, 24), np.float32)
        actions = rng.uniform(-1, 1, (1000, 6)).astype(np.float32)
        quantities = np.empty((1000, 4))
        simulator.reset(episode)
        simulator.observe(observations[0])
        for t, action in enumerate(actions):
            simulator.step(action)
            simulator.observe(observations[t + 1])
            simulator.quantities(quantities[t])
        data.add(0, torch.from_numpy(observations), torch.from_numpy(actions))
        labels.append(rewards(quantities)[:, DOMAINS["walker"].tasks.index(task)])
    data.rewards = torch.from_numpy(np.concatenate(labels).astype(np.float32)).expand(len(seeds), -1).contiguous()
    return data
