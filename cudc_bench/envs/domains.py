"""What is fixed about each domain, without loading a simulator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    pass


# Of MuJoCo, a stored state lacks the solver's warm start, and another processor or version rounds differently; contacts amplify both.
# Measured (MuJoCo 3.17) on 20,000 transitions of a random and 20,000 of a small CUDC collection, each step from a stored state to which
# a relative error of 1e-12 was added, with the warm start of the step before: at most 1.2e-9 (walker), 1.4e-9 (quadruped), and 6.5e-2
# (jaco, 99.9 % of them below 9e-3: friction in its contacts is left unconverged). Without a warm start 3.9e-6, 1.8e-5 and 6.5e-2.
# Imported actions were applied before they were rounded to float32: measured on 6,000 transitions each, up to 9.1e-7 (walker) and
# 1.3e-7 (quadruped). Beyond this tolerance a step is counted and reported; in contacts another MuJoCo may well be there (of 4,000 steps
# of Walker under MuJoCo 3.1.6 two are, at most 1.7e-5).
STEP_TOLERANCE = 1e-5
# What condemns an episode is what these errors, with their signs, add up to since its reset, in any dimension: rounding goes up and down.
# Measured, with the same relative error of 1e-12: 4e-9 (walker, quadruped, 8 episodes each); 0.17 (jaco, 150 episodes that push the arm
# into the ground, with a mean of 6e-3 and a median of 5e-10); 0.10 (quadruped-fetch, 4 episodes). Of Walker made by MuJoCo 2.3.7 and 3.1.6
# (4 episodes each) 2.4e-6 and 1.7e-5. Repeating an episode from its seed needs no tolerance at all: on the same machine and versions every
# bit is the same.
DRIFT_TOLERANCE = 1e-3
_JACO_DRIFT = 0.5
# The mean over n episodes of what accumulated in each may reach this share of an episode's tolerance, and a n-th of the rest.
DRIFT_SHARE = 0.05


@dataclass(frozen=True)
class Bins:
    """Equal bins of one physical quantity; what lies outside their range belongs to the first or the last.

    Attributes:
        low, high: the range, in the quantity's unit. Bin i holds what is at least its lower edge and below its upper one.
        count: how many.
    """

    low: float
    high: float
    count: int


@dataclass(frozen=True)
class Domain:
    """A domain of the benchmark (paper, section "Experiments"; sizes: spec of ExORL and dm_control).

    Attributes:
        name: as in ids and on the command line.
        tasks: the downstream tasks, in the order of the paper's tables; rewards come in this order everywhere.
        observation_size: S, float32.
        action_size: A, each in [-1, 1], float32.
        physics_size: P, float64 numbers that restore the simulator (positions, velocities, activations).
        episode_length: T control steps; an episode ends by this limit only.
        max_return: the largest possible sum of rewards.
        quantities: the Q physical quantities that rewards are functions of.
        descriptors: the bins of each of the quantities, whose product are the cells in which collection's coverage is counted (see
            ``cudc_bench.data.descriptors``); none where the quantities say more than what the body does, as rewards do.
        simulator: ``module:class`` of its :class:`~cudc_bench.envs.simulator.Simulator`.
        rewards: ``module:function`` from physical quantities (..., Q) to the rewards (..., tasks).
        relabeler: the registered relabeler that serves it.
        beyond_state: ranges [start, stop) of observations that no state determines: dm_control leaves sensors of the acceleration stage
            a physics step behind.
        drift_tolerance: what the differences between the stored states and those that the stored states and actions before them lead to,
            relative to 1 + the state's size and with their signs, may add up to in an episode; see :data:`DRIFT_TOLERANCE`.
        excluded: tasks of the same body that cannot be relabelled, and why.
    """

    name: str
    tasks: tuple[str, ...]
    observation_size: int
    action_size: int
    physics_size: int
    episode_length: int
    max_return: float
    quantities: tuple[str, ...]
    simulator: str
    rewards: str
    relabeler: str
    beyond_state: tuple[tuple[int, int], ...] = ()
    drift_tolerance: float = DRIFT_TOLERANCE
    descriptors: tuple[Bins, ...] = ()
    excluded: Mapping[str, str] = field(default_factory=dict, hash=False)


SUITE = "dm_control/"  # begins the names of domains that are defined from dm_control's suite when they are asked for
DOMAINS: dict[str, Domain] = {
    domain.name: domain
    for domain in (
        Domain(
            name="walker",
            tasks=("stand", "walk", "run", "flip"),
            observation_size=24,
            action_size=6,
            physics_size=18,
            episode_length=1000,
            max_return=1000.0,
            quantities=("torso_height", "torso_upright", "com_velocity_x", "angular_momentum_y"),
            simulator="cudc_bench.envs.walker:Walker",
            rewards="cudc_bench.envs.walker:walker_rewards",
            relabeler="walker",
            # 10 cm; 0.2; 0.5 m/s, up to the speed that run asks for; 2.5 kg·m²/s. In all 204,800 cells.
            descriptors=(Bins(0.0, 2.0, 20), Bins(-1.0, 1.0, 10), Bins(-8.0, 8.0, 32), Bins(-40.0, 40.0, 32)),
        ),
        Domain(
            name="quadruped",
            tasks=("stand", "walk", "run", "jump"),
            observation_size=78,
            action_size=12,
            physics_size=57,
            episode_length=1000,
            max_return=1000.0,
            quantities=("torso_upright", "torso_velocity_x", "com_height"),
            simulator="cudc_bench.envs.quadruped:Quadruped",
            rewards="cudc_bench.envs.quadruped:quadruped_rewards",
            relabeler="quadruped",
            # 0.1; 0.25 m/s, up to the speed that run asks for; 5 cm. In all 24,000 cells.
            descriptors=(Bins(-1.0, 1.0, 20), Bins(-5.0, 5.0, 40), Bins(0.0, 1.5, 30)),
            beyond_state=((48, 51), (54, 78)),
        ),
        Domain(
            name="jaco",
            tasks=("reach_top_left", "reach_top_right", "reach_bottom_left", "reach_bottom_right"),
            observation_size=42,
            action_size=9,
            physics_size=18,
            episode_length=250,
            max_return=250.0,
            quantities=("pinch_x", "pinch_y", "pinch_z"),
            simulator="cudc_bench.envs.jaco:Jaco",
            rewards="cudc_bench.envs.jaco:jaco_rewards",
            relabeler="jaco",
            # Voxels of 2 cm, as far as the arm reaches (measured on 100,000 drawn joint positions). In all 620,000 cells.
            descriptors=(Bins(-1.0, 1.0, 100), Bins(-0.6, 1.4, 100), Bins(0.0, 1.24, 62)),
            beyond_state=((12, 18),),
            drift_tolerance=_JACO_DRIFT,
        ),
    )
}


def domain_title(name: str) -> str:
    """What a domain is, for people: the environment of dm_control that it is made from, if it is."""
    if name not in DOMAINS and not name.startswith(SUITE):
        return name
    return f"dm_control's {name.removeprefix(SUITE)}" + (" through Shimmy" if name.startswith(SUITE) else "")
