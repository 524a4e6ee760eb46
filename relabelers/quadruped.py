"""Quadruped's four tasks from physics states."""

from __future__ import annotations

from cudc_bench.envs.headless import mujoco

from .base import KinematicRelabeler


class QuadrupedRelabeler(KinematicRelabeler):
    """Exactly equal to the live rewards of stand, walk, run and jump."""

    def refresh(self) -> None:
        model, data = self.simulator.model, self.simulator.data
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        # For the velocimeter.
        mujoco.mj_sensorVel(model, data)
