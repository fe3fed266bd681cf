"""The gaits of a config, and whether a robot can walk with it at all."""

import warnings
from typing import NamedTuple

import numpy as np

from kjax import gait
from kjax.config import Overlay, RunConfig
from kjax.config.gaits import gait_setting, reachable_gaits, setting_key
from kjax.config.units import InSi, in_si
from kjax.controllers.command import check_command
from kjax.controllers.rigid_body import own_body
from kjax.gait.reference import has_periodic_reference
from kjax.legs.kinematics import REACH
from kjax.legs.posture import nominal_feet
from kjax.types import COMMAND_NAMES, GRAVITY, Leg, Mode, RobotParams, contact_mode

MARGIN = 1.2  # least impulse that the feet can give over a cycle, over the weight's
FACTOR = {"mass": 2.0, "inertia": 4.0}  # from the robot's own that srb may be
MASS_TOLERANCE = 0.01  # relative; below it srb.mass counts as the robot's own


class Problem(NamedTuple):
    """One contact mode of one gait: an LMPC of its own within a stance.

    Attributes:
      gait: index of the gait.
      mode: contact mode.
    """

    gait: int
    mode: Mode


def build_gaits(config: RunConfig | Overlay | InSi) -> list[gait.Gait]:
    """The gaits that a config compiles, in the order of their indices.

    Those of ``gait.also`` first, then those of ``gait.names``, then those that these are left
    through.
    """
    chosen, gaits = config.gait, config.gaits
    names = list(dict.fromkeys([*chosen.also, *chosen.names]))
    return [
        gait.Gait(
            name,
            gait.phases(one.period, one.offset, one.duty),
            ramp_start=one.ramp_start,
            ramp_cycles=one.ramp_cycles,
            switch_rule=one.switch_rule,
            transition_gait=one.transition_gait,
        )
        for name, one in ((name, gaits[name]) for name in reachable_gaits(gaits, names))
    ]


def contact_problems(
    gaits: list[gait.Gait], config: RunConfig | Overlay | InSi
) -> tuple[list[Problem], np.ndarray]:
    """The problems of all gaits, and (G, P) which of them each phase poses.

    A gait that predicts through flight has only that of flight.
    """
    uses_gait_cycle = [bool(row.any()) for row in cycle_nodes(gaits, config)]
    problems: list[Problem] = []
    index = np.zeros((len(gaits), max(len(one.phases) for one in gaits)), int)
    for g, one in enumerate(gaits):
        for p, phase in enumerate(one.phases):
            mode = Mode.FLIGHT if uses_gait_cycle[g] else contact_mode(phase.stance)
            problem = Problem(g, mode)
            if problem not in problems:
                problems.append(problem)
            index[g, p] = problems.index(problem)
    return problems, index


def cycle_nodes(gaits: list[gait.Gait], config: RunConfig | Overlay | InSi) -> np.ndarray:
    """Number of nodes (G, P) of each phase; zero for gaits that predict within a stance only."""
    nodes = np.zeros((len(gaits), max(len(g.phases) for g in gaits)), int)
    for index, one in enumerate(gaits):
        if config.gaits[one.name].horizon != "multiphase":
            continue
        for place, phase in enumerate(one.phases):
            parts = np.ceil(phase.duration / config.multiphase.node_dt - 1e-9)
            nodes[index, place] = 1 if phase.flies else parts
    return nodes


def check_walkable(config: RunConfig, robot: RobotParams) -> None:
    """Refuse a config that this robot cannot walk with; concrete values only.

    Raises:
      ValueError: for a phase of a gait shorter than a tick, force bounds and torque limits that
        cannot carry the weight over a cycle, or give more than it, a height that the legs do not
        reach, a rigid body that is not the robot's; it names the key.

    Warns:
      UserWarning: for another mass than the robot's.
    """
    columns = {name: getattr(config.command, name) for name in COMMAND_NAMES}
    check_command(columns, planar=config.controller == "planar")
    _check_body(config, robot)
    walked = reachable_gaits(config.gaits, config.gait.names)
    for one in build_gaits(config):
        _check_timing(config, one)
        if one.name in walked:
            _check_reach(in_si(config, robot), robot, one.name)
            _check_weight(in_si(config, robot), robot, one)


def _check_timing(config: RunConfig, one: gait.Gait) -> None:
    """Refuse a gait whose phases the clock, the reference or the horizon cannot take."""
    name, own = f"gaits.{one.name}", config.gaits[one.name]
    tick = config.lmpc.control_dt
    for phase, duration in zip(one.phases, one.durations(0), strict=True):
        if duration < tick - 1e-9:
            legs = [leg.name for leg in Leg if phase.stance[leg]]
            kind = f"stance of {', '.join(legs)}" if legs else "flight"
            if not legs and one.ramp_cycles:
                kind += " times ramp_start"
            raise ValueError(
                f"{name}: offset and duty leave a {kind} of {duration:.4g} s, shorter than "
                f"lmpc.control_dt {tick:g} s"
            )
    pairs = [(any(phase.stance[:2]), any(phase.stance[2:])) for phase in one.phases]
    once = sorted(pair for pair in pairs if any(pair)) == [(False, True), (True, False)]
    if own.horizon == "multiphase" and not once:
        raise ValueError(
            f"{name}.horizon = 'multiphase' takes one phase in which front legs stand and one in "
            "which rear legs do; set horizon = 'stance', or another offset and duty"
        )
    modes = [contact_mode(phase.stance) for phase in one.phases]
    if own.reference == "periodic" and not has_periodic_reference(modes):
        raise ValueError(
            f"{name}.reference = 'periodic' needs stances of front and of rear legs that lift off "
            "after each phase; set reference = 'constant', or another offset and duty"
        )
    try:
        one.may_leave()
    except ValueError:
        raise ValueError(
            f"{name}.switch_rule = 'first_flight', but {one.name} has no flight"
        ) from None


def _check_body(config: RunConfig, robot: RobotParams) -> None:
    """Refuse a rigid body that is not this robot's by far; warn of another mass."""
    srb = config.srb
    own = {"mass": float(robot.mass), "inertia": float(robot.pitch_inertia)}
    for key, unit in (("mass", "kg"), ("inertia", "kg m^2")):
        wanted, factor = getattr(srb, key), FACTOR[key]
        if wanted is None or abs(wanted - own[key]) <= MASS_TOLERANCE * own[key]:
            continue
        text = f"srb.{key} is {wanted:g} {unit}, the robot's own {own[key]:.4g} {unit}"
        if not 1.0 / factor < wanted / own[key] < factor:
            raise ValueError(
                f"{text}; leave it out to take the robot's, or stay within a factor of {factor:g}"
            )
        if key == "mass":
            warnings.warn(
                f"{text}: the LMPC plans for another weight than it carries", stacklevel=4
            )
    _check_contact_points(config, robot)


def _check_contact_points(config: RunConfig, robot: RobotParams) -> None:
    """Refuse contact points of the rigid body where no foot can stand."""
    if config.srb.feet_front is None and config.srb.feet_rear is None:
        return
    front, rear = own_body(config.srb, robot).feet.tolist()
    leg = float(robot.thigh_length + robot.calf_length)
    # The sole's distance from the hip, whatever the height of the hip above the centre of mass.
    longest = leg + float(robot.foot_radius) + abs(float(robot.hip_pos[:, 2].mean()))
    hips = np.asarray(nominal_feet(robot, 0.0))[:, 0]
    named = (("front", front, hips[0]), ("rear", rear, hips[1]))
    for name, point, hip in named:
        text = f"srb.feet_{name} is {list(point)} m"
        if point[1] >= 0:
            raise ValueError(f"{text}, above the centre of mass: its second number is below 0")
        if np.hypot(point[0] - hip, point[1]) > longest:
            raise ValueError(
                f"{text}, further than the leg's {leg:.3g} m from the hip at x = {hip:.3g} m"
            )
    if front[0] <= rear[0]:
        raise ValueError(
            f"srb.feet_front is {list(front)} m, not ahead of srb.feet_rear, {list(rear)} m"
        )


def _check_weight(config: InSi, robot: RobotParams, one: gait.Gait) -> None:
    """Refuse bounds of the forces that cannot carry the weight, or give more than it."""
    own, is_spatial = config.gaits[one.name], config.controller == "spatial"
    section = "multiphase" if own.horizon == "multiphase" else "lmpc"
    section = "spatial" if is_spatial else section
    weight = float(robot.mass) * GRAVITY * one.period
    needed = MARGIN * weight
    standing = sum(phase.duration * sum(phase.stance) for phase in one.phases)
    bounds = ("grf_z_max", "grf_z_min")
    if is_spatial:
        keys = [f"spatial.{bound}" for bound in bounds]
        given, least = (standing * getattr(config.spatial, bound) for bound in bounds)
    else:
        keys = [setting_key(config, one.name, bound) for bound in bounds]
        given, least = (standing * gait_setting(config, one.name, bound) for bound in bounds)
    fraction = getattr(config, section).torque_fraction
    strong = standing * fraction * _calf_force(config, robot, one.name)
    cycle = f"in a cycle of {one.name} ({one.period:g} s)"
    mass = f"{float(robot.mass):.4g} kg"
    if given < needed:
        raise ValueError(
            f"{keys[0]}: {cycle} the feet can give {given:.4g} N s, and "
            f"{needed:.4g} N s are needed for {mass} ({MARGIN:g} times its weight); raise it by a "
            f"factor of {needed / given:.3g}"
        )
    if MARGIN * least > weight:
        raise ValueError(
            f"{keys[1]}: {cycle} the feet give at least {least:.4g} N s, and "
            f"{mass} weigh {weight:.4g} N s: the robot would fly off; it must be at most "
            f"{weight / (MARGIN * least):.3g} of what it is"
        )
    if strong < needed:
        raise ValueError(
            f"{section}.torque_fraction: {cycle} the calf joints can press {strong:.4g} "
            f"N s, and {needed:.4g} N s are needed for {mass} ({MARGIN:g} times its weight)"
        )


def _calf_force(config: InSi, robot: RobotParams, name: str) -> float:
    """Vertical force at which the calf's torque limit is reached, foot below the hip [N]."""
    thigh, calf = float(robot.thigh_length), float(robot.calf_length)
    drop = _drop(config, robot, name)
    # Height of the knee's triangle (law of cosines): the lever of a force along the line hip-foot.
    along = (thigh**2 - calf**2 + drop**2) / (2.0 * drop)
    lever = np.sqrt(max(thigh**2 - along**2, 1e-12))
    return float(np.min(robot.torque_limit[..., 2]) / lever)


def _drop(config: InSi, robot: RobotParams, name: str) -> float:
    """Depth of the foot centre below the hip at the reference height [m]."""
    height = float(gait_setting(config, name, "body_height"))
    return height - float(robot.foot_radius) + float(robot.hip_pos[:, 2].mean())


def _check_reach(config: InSi, robot: RobotParams, name: str) -> None:
    height = gait_setting(config, name, "body_height")
    low, high = np.array(REACH) * float(robot.thigh_length + robot.calf_length)
    drop = _drop(config, robot, name)
    asked = (0.0, *config.command.height)
    if not (low < drop + min(asked) and drop + max(asked) < high):
        length = float(robot.thigh_length + robot.calf_length)
        key = (
            f"{setting_key(config, name, 'body_height')} is {height / length:.4g} leg lengths, "
            f"{height:.4g} m,"
        )
        if any(asked):
            key += f" and command.height {min(asked):+g} to {max(asked):+g} m,"
        raise ValueError(
            f"{key} but the legs reach {low:.3g} to {high:.3g} m below the hips, so that it must "
            f"be about {(low + height - drop) / length:.2f} to "
            f"{(high + height - drop) / length:.2f} leg lengths"
        )
