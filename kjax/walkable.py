"""The gaits of a config, and whether a robot can walk with it at all."""

import warnings

import numpy as np

from kjax import gait
from kjax.config import RunConfig
from kjax.legs.kinematics import REACH
from kjax.types import GRAVITY, MODE_ALPHA, Mode, RobotParams

MARGIN = 1.2  # least impulse that the feet can give over a cycle, over the weight's
MASS_TOLERANCE = 0.01  # relative; below it srb.mass counts as the robot's own


def build_gaits(config: RunConfig) -> list[gait.Gait]:
    """The gaits of a config, in the order of their indices: trot, bound, stand, landing."""
    chosen, bound = config.gait, config.bound
    landing = "landing" if chosen.landing_time > 0 else ""
    gaits = [
        gait.trot(chosen.stance_time, chosen.trot_flight),
        gait.bound(
            bound.front_stance,
            bound.first_flight,
            bound.rear_stance,
            bound.second_flight,
            ramp_start=bound.ramp_start,
            ramp_cycles=bound.ramp_cycles,
            leave_anywhere=chosen.switch_rule == "anywhere",
            leave_through=landing,
        ),
        gait.stand(),
    ]
    return [*gaits, gait.stand(chosen.landing_time, name=landing)] if landing else gaits


def cycle_nodes(gaits: list[gait.Gait], config: RunConfig) -> np.ndarray:
    """Number of nodes (G, P) of each phase; zero for gaits that predict within a stance only."""
    nodes = np.zeros((len(gaits), max(len(g.phases) for g in gaits)), int)
    for index, one in enumerate(gaits):
        if one.name != "bound" or config.bound.horizon != "multiphase":
            continue
        for place, phase in enumerate(one.phases):
            parts = np.ceil(phase.duration / config.multiphase.node_dt - 1e-9)
            nodes[index, place] = 1 if phase.mode == Mode.FLIGHT else parts
    return nodes


def check_walkable(config: RunConfig, robot: RobotParams) -> None:
    """Refuse a config that this robot cannot walk with; concrete numbers only.

    Raises:
      ValueError: for force bounds that cannot carry the weight over a cycle, a height that the legs
        do not reach, a mass that is not the robot's by a factor of 2; it names the key.

    Warns:
      UserWarning: for another mass than the robot's.
    """
    _check_mass(config, robot)
    gaits = build_gaits(config)
    nodes = [bool(row.any()) for row in cycle_nodes(gaits, config)]
    used = {*config.gait.names, *(["landing"] if config.gait.landing_time > 0 else [])}
    for one, foresees in zip(gaits, nodes, strict=True):
        if one.name in used:
            _check_weight(config, robot, one, foresees)
            _check_reach(config, robot, one.name)


def _check_mass(config: RunConfig, robot: RobotParams) -> None:
    own, wanted = float(robot.mass), config.srb.mass
    if wanted is None or abs(wanted - own) <= MASS_TOLERANCE * own:
        return
    text = f"srb.mass is {wanted:g} kg, the robot's own {own:.4g} kg"
    if not 0.5 < wanted / own < 2.0:
        raise ValueError(f"{text}; leave it out to take the robot's, or stay within a factor of 2")
    warnings.warn(f"{text}: the LMPC plans for another weight than it carries", stacklevel=4)


def _check_weight(config: RunConfig, robot: RobotParams, one: gait.Gait, foresees: bool) -> None:
    given, keys = 0.0, set()
    for phase in one.phases:
        section = "lmpc"
        if phase.mode in (Mode.FRONT, Mode.REAR):
            section = "multiphase" if foresees else "bound"
        feet = int(MODE_ALPHA[phase.mode].sum())
        if feet:
            keys.add(f"{section}.force_z_max")
            given += phase.duration * feet * getattr(config, section).force_z_max
    period = sum(phase.duration for phase in one.phases)
    needed = MARGIN * float(robot.mass) * GRAVITY * period
    if given < needed:
        raise ValueError(
            f"{' and '.join(sorted(keys))}: in a cycle of {one.name} ({period:g} s) the feet can "
            f"give {given:.4g} N s, and {needed:.4g} N s are needed for {float(robot.mass):.4g} kg "
            f"({MARGIN:g} times its weight); raise it by a factor of {needed / given:.3g}"
        )


def _check_reach(config: RunConfig, robot: RobotParams, name: str) -> None:
    section = "bound" if name == "bound" else "lmpc"
    height = getattr(config, section).height
    low, high = np.array(REACH) * float(robot.thigh_length + robot.calf_length)
    drop = height - float(robot.foot_radius) + float(robot.hip_pos[:, 2].mean())
    if not low < drop < high:
        raise ValueError(
            f"{section}.height is {height:g} m; the legs reach {low:.3g} to {high:.3g} m below the "
            f"hips, so that it must be about {low + height - drop:.2f} to "
            f"{high + height - drop:.2f} m"
        )
