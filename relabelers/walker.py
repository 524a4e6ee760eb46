"""Walker's four tasks from physics states."""

from __future__ import annotations

from cudc_bench.envs.headless import mujoco

from .base import KinematicRelabeler


class WalkerRelabeler(KinematicRelabeler):
    """Exactly equal to the live rewards of stand, walk, run and flip."""

    def refresh(self) -> None:
        model, data = self.simulator.model, self.simulator.data
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        # Called by name: MuJoCo caches this one, and mj_sensorVel alone would leave it at the state before.
        mujoco.mj_subtreeVel(model, data)
        # The live walker reads the torso's velocity from this sensor.
        mujoco.mj_sensorVel(model, data)
