"""Trains TD3 with TorchRL's parts on a dataset of cudc-bench, and tries the policy in the environment that the dataset came from.

cudc-bench collect --method cudc && cudc-bench relabel walker/cudc-v0
pip install 'cudc-bench[torchrl]'
python examples/torchrl_offline.py walker/walk/cudc-v0 --steps 10000
"""

# mypy: disable-error-code="import-not-found,import-untyped"

from __future__ import annotations

import argparse

import gymnasium
import minari
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import SoftUpdate, TD3Loss

import cudc_bench


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", nargs="?", default="walker/walk/cudc-v0", help="id of a dataset with rewards")
    parser.add_argument("--steps", type=int, default=10_000, help="gradient steps")
    parser.add_argument("--episodes", type=int, default=5, help="episodes that the policy is tried for")
    parser.add_argument("--device", default="cpu", help="where networks and data live: cpu or cuda")
    arguments = parser.parse_args()

    torch.manual_seed(1)
    buffer = cudc_bench.to_torchrl(arguments.dataset, batch_size=256, device=arguments.device)
    # Such as gymnasium.make("cudc_bench/walker-walk-v0").
    environment = minari.load_dataset(arguments.dataset).recover_environment()
    (state,), (action,) = environment.observation_space.shape, environment.action_space.shape

    layers = {"num_cells": [256, 256], "activation_class": nn.ReLU, "device": arguments.device}
    policy = nn.Sequential(MLP(in_features=state, out_features=action, **layers), nn.Tanh())
    actor = TensorDictModule(policy, in_keys=["observation"], out_keys=["action"])
    critic = ValueOperator(MLP(in_features=state + action, out_features=1, **layers), in_keys=["observation", "action"])
    loss = TD3Loss(actor, critic, bounds=(-1.0, 1.0), loss_function="l2")  # doubles the critic, and keeps slow copies of all three
    loss.make_value_estimator(gamma=0.99)
    loss.to(arguments.device)
    follow = SoftUpdate(loss, tau=0.005)
    critic_adam = torch.optim.Adam(loss.qvalue_network_params.flatten_keys().values(), lr=3e-4)
    actor_adam = torch.optim.Adam(loss.actor_network_params.flatten_keys().values(), lr=3e-4)

    for step in range(1, arguments.steps + 1):
        batch = buffer.sample()
        critic_loss, measured = loss.value_loss(batch)
        critic_adam.zero_grad()
        critic_loss.backward()
        critic_adam.step()
        if step % 2 == 0:
            actor_loss, _ = loss.actor_loss(batch)
            actor_adam.zero_grad()
            actor_loss.backward()
            actor_adam.step()
        follow.step()
        if step % max(1, arguments.steps // 10) == 0:
            print(f"step {step}: critic loss {critic_loss.item():.4f}, mean value {measured['pred_value'].mean().item():.3f}")

    mean = sum(play(environment, policy, arguments.device, seed) for seed in range(arguments.episodes)) / arguments.episodes
    print(f"mean return of {arguments.episodes} episodes in {environment.spec.id}: {mean:.1f}")


@torch.no_grad()
def play(environment: gymnasium.Env, policy: nn.Module, device: str, seed: int) -> float:
    """The return of one episode with the policy as it is."""
    observation, _ = environment.reset(seed=seed)
    total, ended = 0.0, False
    while not ended:
        action = policy(torch.as_tensor(observation, device=device)).cpu().numpy()
        observation, reward, terminated, truncated, _ = environment.step(action)
        total += float(reward)
        ended = terminated or truncated
    return total


if __name__ == "__main__":
    main()
