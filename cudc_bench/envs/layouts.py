"""What each number of an observation and of an action is, by name: for people who use a policy or a dataset elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from cudc_bench.envs.domains import SUITE
from cudc_bench.envs.registry import check_domain, make_simulators

_LIMBS = ("right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle")
_LEGS = ("front_left", "front_right", "back_right", "back_left")
_HINGES = ("yaw", "pitch", "knee", "ankle")
_JOINTS = tuple(f"joint_{i}" for i in range(1, 7))
_FINGERS = ("finger_1", "finger_2", "finger_3")


@dataclass(frozen=True)
class Block:
    """Numbers that stand together in an observation.

    Attributes:
        name: dm_control's.
        elements: what each of them is, in order.
    """

    name: str
    elements: tuple[str, ...]


def observation_layout(domain: str) -> tuple[Block, ...]:
    """The parts of a domain's observation (S,) in their order.

    Lengths are in m, angles in rad, velocities in m/s and rad/s. Domains of dm_control's suite name their parts, but not what is
    in them; looking at those loads MuJoCo. Of other packages' domains only the numbers are known.

    Raises:
        UsageError: there is no such domain.
    """
    facts = check_domain(domain)
    if domain.startswith(SUITE):
        from cudc_bench.envs.suite import SuiteSimulator

        return tuple(Block(name, _numbered(name, size)) for name, size in SuiteSimulator(domain).parts())
    if domain not in _LAYOUTS:
        return (Block("observation", _numbered("observation", facts.observation_size)),)
    blocks = _LAYOUTS[domain]
    assert sum(len(block.elements) for block in blocks) == facts.observation_size
    return blocks


def action_names(domain: str) -> tuple[str, ...]:
    """The actuators of a domain in the order of its actions (A,); this loads MuJoCo."""
    model, _ = make_simulators(domain, 1)[0].compiled
    return tuple(model.actuator(i).name for i in range(model.nu))


def _numbered(name: str, size: int) -> tuple[str, ...]:
    return tuple(f"{name}[{i}]" for i in range(size))


def _each(names: Sequence[str], *parts: str) -> tuple[str, ...]:
    """``name.part`` for each part of each name."""
    return tuple(f"{name}.{part}" for name in names for part in parts)


_LAYOUTS: dict[str, tuple[Block, ...]] = {
    "walker": (
        # Entries of each body's rotation matrix.
        Block(
            "orientations",
            _each(("torso", "right_thigh", "right_leg", "right_foot", "left_thigh", "left_leg", "left_foot"), "xx", "xz"),
        ),
        Block("height", ("torso.z",)),
        Block("velocity", ("rootz", "rootx", "rooty", *_LIMBS)),
    ),
    "quadruped": (
        Block(
            "egocentric_state",
            (
                *(f"{hinge}_{leg}.{what}" for what in ("position", "velocity") for leg in _LEGS for hinge in _HINGES),
                *(f"{actuator}_{leg}.activation" for leg in _LEGS for actuator in ("yaw", "lift", "extend")),
            ),
        ),
        Block("torso_velocity", _each(("torso.velocity",), "x", "y", "z")),
        Block("torso_upright", ("torso.zz",)),
        Block("imu", _each(("accelerometer", "gyroscope"), "x", "y", "z")),
        # arcsinh of newtons and newton metres.
        Block("force_torque", _each([f"toe_{leg}.{what}" for what in ("force", "torque") for leg in _LEGS], "x", "y", "z")),
    ),
    "jaco": (
        Block("jaco_arm/joints_pos", _each(_JOINTS, "sin", "cos")),
        # sign · log(1 + |·|) of newton metres.
        Block("jaco_arm/joints_torque", _each(_JOINTS, "torque")),
        Block("jaco_arm/joints_vel", _each(_JOINTS, "velocity")),
        Block("jaco_arm/jaco_hand/joints_pos", _each(_FINGERS, "position")),
        Block("jaco_arm/jaco_hand/joints_vel", _each(_FINGERS, "velocity")),
        Block("jaco_arm/jaco_hand/pinch_site_pos", _each(("pinch_site",), "x", "y", "z")),
        Block("jaco_arm/jaco_hand/pinch_site_rmat", _each(("pinch_site",), *(a + b for a in "xyz" for b in "xyz"))),
    ),
}  # fmt: skip
