"""Walker: dm_control's planar walker with four tasks, stand, walk, run and flip."""

from __future__ import annotations

import numpy as np

from cudc_bench.envs.domains import DOMAINS
from cudc_bench.envs.headless import mujoco
from cudc_bench.envs.simulator import Float32, Float64, MujocoSimulator, gaussian_above, tolerance_above

_TORSO = 1  # body 0 is the world


class Walker(MujocoSimulator):
    """dm_control's walker, bit-identical in observation, state, reset and reward.

    Observation (24): the (xx, xz) entries of seven body rotations, the torso's height in m, nine generalised velocities. The
    horizontal position is not observed. State (18): nine positions, nine velocities.
    """

    domain = DOMAINS["walker"]
    substeps = 10

    @classmethod
    def build_model(cls) -> mujoco.MjModel:
        from dm_control.suite.walker import get_model_and_assets

        xml, assets = get_model_and_assets()
        return mujoco.MjModel.from_xml_string(xml.decode() if isinstance(xml, bytes) else xml, assets)

    def __init__(self, model: mujoco.MjModel | None = None) -> None:
        super().__init__(model)
        data = self.data
        velocity_sensor = self.model.sensor("torso_subtreelinvel").adr[0]
        # Views into MuJoCo's own arrays: they stay valid and current, and cost no look-up in the loop.
        self._rotations = data.xmat[1:, 0:3:2]
        self._height = data.xpos[_TORSO, 2:3]
        self._velocities = data.qvel
        self._upright = data.xmat[_TORSO, 8:9]
        self._com_velocity = data.sensordata[velocity_sensor : velocity_sensor + 1]
        self._angular_momentum = data.subtree_angmom[_TORSO, 1:2]

    def initialise(self, random: np.random.RandomState) -> None:
        model, qpos = self.model, self.data.qpos
        for joint in range(model.njnt):
            kind, address = model.jnt_type[joint], model.jnt_qposadr[joint]
            if model.jnt_limited[joint]:
                low, high = model.jnt_range[joint]
                qpos[address] = random.uniform(low, high)
            elif kind == mujoco.mjtJoint.mjJNT_HINGE:
                qpos[address] = random.uniform(-np.pi, np.pi)

    def observe(self, out: Float32) -> None:
        out[:14].reshape(7, 2)[...] = self._rotations
        out[14:15] = self._height
        out[15:] = self._velocities

    def quantities(self, out: Float64) -> None:
        out[0:1] = self._height
        out[1:2] = self._upright
        out[2:3] = self._com_velocity
        out[3:4] = self._angular_momentum


def walker_rewards(quantities: Float64) -> Float64:
    """Rewards of the four tasks from physical quantities.

    Stand, walk and run are dm_control's; flip is ExORL's (angular momentum of the torso's subtree above 5 kg·m²/s).

    Args:
        quantities: (..., 4) in the order of the domain's ``quantities``: metres, cosine, metres per second, kg·m²/s.

    Returns:
        (..., 4) rewards in [0, 1] for stand, walk, run and flip.
    """
    height, upright, speed, spin = np.moveaxis(quantities, -1, 0)
    stand = (3.0 * gaussian_above(height, 1.2, 0.6) + (1.0 + upright) / 2.0) / 4.0
    gains = (
        tolerance_above(speed, 1.0, 0.5, 0.5),
        tolerance_above(speed, 8.0, 4.0, 0.5),
        tolerance_above(spin, 5.0, 5.0, 0.0),
    )
    return np.stack([stand, *(stand * (5.0 * gain + 1.0) / 6.0 for gain in gains)], axis=-1)
