"""HalfCheetah against what every domain promises, and its rewards against Gymnasium's."""

import gymnasium
import numpy as np
from cudc_bench_half_cheetah import SPEED, rewards

from cudc_bench.envs.contract import DomainContract


class TestHalfCheetah(DomainContract):
    domain = "half_cheetah"


def test_running_earns_what_gymnasium_pays_for_speed() -> None:
    environment = gymnasium.make("HalfCheetah-v5").unwrapped
    environment.set_state(np.zeros(9), np.eye(9)[0] * 4.0)
    velocity = environment.data.qvel[0]
    np.testing.assert_allclose(rewards(np.array([velocity, 0.0])), [4.0 / SPEED, 0.0, 0.0])


def test_standing_on_the_front_is_best_upright() -> None:
    found = rewards(np.array([[0.0, 0.0], [0.0, np.pi / 2], [0.0, np.pi], [0.0, -1.0]]))[:, 2]
    np.testing.assert_allclose(found, [0.0, 0.5, 1.0, 0.0], atol=1e-12)
