"""Quadruped: dm_control's four-legged walker with four tasks, stand, walk, run and jump."""

from __future__ import annotations

import numpy as np

from cudc_bench.envs.domains import DOMAINS
from cudc_bench.envs.headless import mujoco
from cudc_bench.envs.simulator import Float32, Float64, MujocoSimulator, tolerance_above
from cudc_bench.errors import RunError

_TORSO = 1  # body 0 is the world
_FLOOR = 10.0  # half the floor's side in m, as in dm_control's walk; it is drawn, and bounds nothing
_RISE, _ATTEMPTS = 0.01, 10_000  # dm_control's search for an initial height


class Quadruped(MujocoSimulator):
    """dm_control's quadruped, bit-identical in observation, state and reset.

    Observation (78): 16 hinge positions, 16 hinge velocities, 12 activations; the torso's velocity in its own frame (3) and its
    uprightness (1); accelerometer and gyroscope (6); arcsinh of force and torque at the four toes (24). Neither place nor heading
    is observed. State (57): 23 positions, 22 velocities, 12 activations. The last 30 observations are of the acceleration stage,
    which dm_control leaves one physics step behind: they are no function of the state.
    """

    domain = DOMAINS["quadruped"]
    substeps = 4

    @classmethod
    def build_model(cls) -> mujoco.MjModel:
        from dm_control.suite import common, quadruped

        return mujoco.MjModel.from_xml_string(quadruped.make_model(floor_size=_FLOOR).decode(), common.ASSETS)

    def __init__(self, model: mujoco.MjModel | None = None) -> None:
        super().__init__(model)
        model, data = self.model, self.data

        def sensors(*names: str) -> slice:
            addresses = [model.sensor(name) for name in names]
            start, stop = addresses[0].adr[0], addresses[-1].adr[0] + addresses[-1].dim[0]
            assert sum(one.dim[0] for one in addresses) == stop - start
            return slice(start, stop)

        # The torso's free joint comes first: everything after it is a hinge.
        assert (model.jnt_type[1:] == mujoco.mjtJoint.mjJNT_HINGE).all()
        self._positions, self._velocities, self._activations = data.qpos[7:], data.qvel[6:], data.act
        self._upright = data.xmat[_TORSO, 8:9]
        self._height = data.subtree_com[_TORSO, 2:3]
        self._imu = data.sensordata[sensors("imu_accel", "imu_gyro")]
        self._velocity = data.sensordata[sensors("velocimeter")]
        toes = [f"{kind}_toe_{leg}" for kind in ("force", "torque") for leg in ("front_left", "front_right", "back_right", "back_left")]
        self._touch = data.sensordata[sensors(*toes)]

    def initialise(self, random: np.random.RandomState) -> None:
        model, data = self.model, self.data
        orientation = random.randn(4)
        orientation /= np.linalg.norm(orientation)
        height = self._free_height(orientation)
        # dm_control resets once more for every height that it tries; the last time is enough.
        mujoco.mj_resetData(model, data)
        self._forward_without_actuation()
        data.qpos[:7] = 0.0, 0.0, height, *orientation
        self._forward_without_actuation()

    def _free_height(self, orientation: Float64) -> float:
        """The lowest height, in steps of 1 cm, at which nothing touches the floor."""
        model, data = self.model, self.data
        height = 0.0
        for _ in range(_ATTEMPTS):
            data.qpos[:7] = 0.0, 0.0, height, *orientation
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_collision(model, data)
            if data.ncon == 0:
                return height
            height += _RISE
        raise RunError("the quadruped touches the floor at every height; this MuJoCo does not fit this dm_control.")

    def observe(self, out: Float32) -> None:
        out[:16] = self._positions
        out[16:32] = self._velocities
        out[32:44] = self._activations
        out[44:47] = self._velocity
        out[47:48] = self._upright
        out[48:54] = self._imu
        out[54:] = np.arcsinh(self._touch)

    def quantities(self, out: Float64) -> None:
        out[0:1] = self._upright
        out[1:2] = self._velocity[:1]
        out[2:3] = self._height


def quadruped_rewards(quantities: Float64) -> Float64:
    """Rewards of the four tasks from physical quantities.

    Walk and run are dm_control's; stand is their factor of uprightness; jump, with the height of the centre of mass, is ExORL's.

    Args:
        quantities: (..., 3) in the order of the domain's ``quantities``: cosine, metres per second, metres.

    Returns:
        (..., 4) rewards in [0, 1] for stand, walk, run and jump.
    """
    upright, speed, height = np.moveaxis(quantities, -1, 0)
    stand = tolerance_above(upright, 1.0, 2.0, 0.0)
    gains = (tolerance_above(speed, 0.5, 0.5, 0.5), tolerance_above(speed, 5.0, 5.0, 0.5), tolerance_above(height, 1.0, 1.0, 0.5))
    return np.stack([stand, *(stand * gain for gain in gains)], axis=-1)
