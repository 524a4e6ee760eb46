"""Gymnasium's HalfCheetah as a domain: running forwards and backwards, and standing on its front (Todorov et al. 2012)."""

from __future__ import annotations

import numpy as np

from cudc_bench.envs import Domain
from cudc_bench.envs.gymnasium_simulator import GymnasiumSimulator
from cudc_bench.envs.simulator import Float64

SPEED = 10.0  # m/s, from which running earns its full reward

DOMAIN = Domain(
    name="half_cheetah",
    tasks=("run", "run_backwards", "stand"),
    observation_size=17,
    action_size=6,
    physics_size=18,
    episode_length=1000,
    max_return=1000.0,
    quantities=("velocity_x", "pitch"),
    simulator="cudc_bench_half_cheetah:HalfCheetah",
    rewards="cudc_bench_half_cheetah:rewards",
    relabeler="state",
)


class HalfCheetah(GymnasiumSimulator):
    """Observation (17): eight positions, without that along the track, and nine velocities. State (18): nine and nine."""

    environment = "HalfCheetah-v5"

    def quantities(self, out: Float64) -> None:
        out[0] = self.data.qvel[0]
        out[1] = self.data.qpos[2]


def rewards(quantities: Float64) -> Float64:
    """Rewards (..., 3) in [0, 1], in the order of the tasks.

    Args:
        quantities: (..., 2), the velocity along the track (m/s) and the pitch (rad), positive with the nose down.
    """
    velocity, pitch = quantities[..., 0] / SPEED, quantities[..., 1]
    return np.stack([np.clip(velocity, 0, 1), np.clip(-velocity, 0, 1), (1 - np.cos(np.clip(pitch, 0, np.pi))) / 2], axis=-1)
