"""Jaco: dm_control's Kinova arm and hand, with four fixed targets to reach."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np

from cudc_bench.envs.domains import DOMAINS
from cudc_bench.envs.headless import mujoco
from cudc_bench.envs.simulator import Float32, Float64, MujocoSimulator

if TYPE_CHECKING:
    from dm_control.manipulation.reach import Reach
    from dm_control.mjcf import Physics

_RADIUS = 0.05  # of a target, m
# In the order of the domain's tasks: reach_top_left, reach_top_right, reach_bottom_left, reach_bottom_right (m).
TARGETS = np.array([[-0.09, 0.09, 0.001], [0.09, 0.09, 0.001], [-0.09, -0.09, 0.001], [0.09, -0.09, 0.001]])


@cache
def _composer() -> tuple[Reach, Physics]:
    """dm_control's own task, which compiles the model and draws initial states; one for each process.

    It is ``reach_site`` with the target in a fixed place and unobserved, as ExORL has it. Compiled once: an episode's start
    changes nothing in the model but where its target is, which nothing observes.
    """
    import absl.logging
    from dm_control import mjcf
    from dm_control.manipulation import reach
    from dm_control.manipulation.shared import arenas, constants, observations, robots, workspaces

    # A few initial states take all attempts of the inverse kinematics, which then draws again and says so at every one.
    absl.logging.set_verbosity(absl.logging.ERROR)
    everything = observations.PERFECT_FEATURES
    seen = everything._replace(prop_pose=everything.prop_pose._replace(enabled=False))
    place = workspaces.BoundingBox(lower=tuple(TARGETS[0]), upper=tuple(TARGETS[0]))
    start = workspaces.BoundingBox(lower=(-0.2, -0.2, 0.02), upper=(0.2, 0.2, 0.4))
    task = reach.Reach(
        arena=arenas.Standard(),
        arm=robots.make_arm(obs_settings=seen),
        hand=robots.make_hand(obs_settings=seen),
        prop=None,
        obs_settings=seen,
        workspace=SimpleNamespace(target_bbox=place, tcp_bbox=start, arm_offset=robots.ARM_OFFSET),
        control_timestep=constants.CONTROL_TIMESTEP,
    )
    return task, mjcf.Physics.from_mjcf_model(task.root_entity.mjcf_model)


class Jaco(MujocoSimulator):
    """dm_control's arm, bit-identical to the composer task in observation, state and reset.

    Observation (42): sine and cosine of six arm joints in turn (12), their torques as sign · log(1 + |·|) (6) and velocities (6); three
    finger joints' positions (3) and velocities (3); position (3) and rotation matrix (9) of the pinch site between the fingers. The
    target is not observed. State (18): nine positions, nine velocities. The torques are of the acceleration stage, which dm_control
    leaves one physics step behind: they are no function of the state.
    """

    domain = DOMAINS["jaco"]
    substeps = 20

    @classmethod
    def build_model(cls) -> mujoco.MjModel:
        return _composer()[1].model.ptr

    def __init__(self, model: mujoco.MjModel | None = None) -> None:
        super().__init__(model)
        model, data = self.model, self.data
        axes = model.jnt_axis[:6]
        assert model.nq == model.nv == 9
        assert ((axes == 0) | (axes == 1)).all()
        assert (axes.sum(1) == 1).all()
        site = model.site("jaco_arm/jaco_hand/pinchsite").id
        # Each torque sensor measures three axes, of which the observation keeps the one that the joint turns around.
        addresses = [int(model.sensor(f"jaco_arm/joint_{i}_torque").adr[0]) for i in range(1, 7)]
        self._torque_rows = np.array([address + int(np.argmax(axis)) for address, axis in zip(addresses, axes, strict=True)])
        self._sensors = data.sensordata
        self._arm, self._arm_velocity = data.qpos[:6], data.qvel[:6]
        self._hand, self._hand_velocity = data.qpos[6:], data.qvel[6:]
        self._pinch, self._pinch_rotation = data.site_xpos[site], data.site_xmat[site]

    def initialise(self, random: np.random.RandomState) -> None:
        task, physics = _composer()
        with physics.reset_context():
            task.initialize_episode(physics, random)
        self.data.qpos[:] = physics.data.qpos

    def observe(self, out: Float32) -> None:
        out[0:12:2] = np.sin(self._arm)
        out[1:12:2] = np.cos(self._arm)
        torques = self._sensors[self._torque_rows]
        out[12:18] = np.sign(torques) * np.log1p(np.abs(torques))
        out[18:24] = self._arm_velocity
        out[24:27] = self._hand
        out[27:30] = self._hand_velocity
        out[30:33] = self._pinch
        out[33:] = self._pinch_rotation

    def quantities(self, out: Float64) -> None:
        out[:] = self._pinch


def jaco_rewards(quantities: Float64) -> Float64:
    """Rewards of reaching the four targets: 1 within 5 cm of it, a Gaussian that is 0.1 another 5 cm away.

    Args:
        quantities: (..., 3), the pinch site's position in metres.

    Returns:
        (..., 4) rewards in [0, 1], in the order of the domain's tasks.
    """
    offset = quantities[..., None, :] - TARGETS
    distance = np.sqrt(offset[..., 0] ** 2 + offset[..., 1] ** 2 + offset[..., 2] ** 2)
    scale = np.sqrt(-2.0 * np.log(0.1))
    return np.where(distance <= _RADIUS, 1.0, np.exp(-0.5 * ((distance - _RADIUS) / _RADIUS * scale) ** 2))
