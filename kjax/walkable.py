"""The gaits of a config, and whether a robot can walk with it at all."""

import warnings

import numpy as np

from kjax import gait
from kjax.command import check_command
from kjax.config import Overlay, RunConfig
from kjax.legs.kinematics import REACH
from kjax.rigid_body import nominal_feet, own_body
from kjax.types import COMMAND_NAMES, GRAVITY, MODE_ALPHA, Mode, RobotParams

MARGIN = 1.2  # least impulse that the feet can give over a cycle, over the weight's
FACTOR = {"mass": 2.0, "inertia": 4.0}  # from the robot's own that srb may be
MASS_TOLERANCE = 0.01  # relative; below it srb.mass counts as the robot's own


def build_gaits(config: RunConfig | Overlay) -> list[gait.Gait]:
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


def cycle_nodes(gaits: list[gait.Gait], config: RunConfig | Overlay) -> np.ndarray:
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
      ValueError: for force bounds and torque limits that cannot carry the weight over a cycle, or
        give more than it, a height that the legs do not reach, a rigid body that is not the
        robot's; it names the key.

    Warns:
      UserWarning: for another mass than the robot's.
    """
    check_command({name: getattr(config.command, name) for name in COMMAND_NAMES})
    _check_body(config, robot)
    gaits = build_gaits(config)
    nodes = [bool(row.any()) for row in cycle_nodes(gaits, config)]
    used = {*config.gait.names, *(["landing"] if config.gait.landing_time > 0 else [])}
    for one, foresees in zip(gaits, nodes, strict=True):
        if one.name in used:
            _check_reach(config, robot, one.name)
            _check_weight(config, robot, one, foresees)


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
    own = own_body(config.srb, robot)
    front, rear = own.feet_front, own.feet_rear
    assert front is not None  # own_body filled them in
    assert rear is not None
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


def _check_weight(config: RunConfig, robot: RobotParams, one: gait.Gait, foresees: bool) -> None:
    """Refuse bounds of the forces that cannot carry the weight, or give more than it."""
    period = sum(phase.duration for phase in one.phases)
    weight = float(robot.mass) * GRAVITY * period
    needed = MARGIN * weight
    given, least, strong = 0.0, 0.0, 0.0
    keys: set[str] = set()
    for phase in one.phases:
        name = "lmpc"
        if phase.mode in (Mode.FRONT, Mode.REAR):
            name = "multiphase" if foresees else "bound"
        section = getattr(config, name)
        rows = config.lmpc if name == "bound" else section
        feet = int(MODE_ALPHA[phase.mode].sum())
        if not feet:
            continue
        keys.add(name)
        given += phase.duration * feet * section.force_z_max
        least += phase.duration * feet * section.force_z_min
        strong += phase.duration * feet * rows.torque_fraction * _calf_force(config, robot, one)
    cycle = f"in a cycle of {one.name} ({period:g} s)"
    mass = f"{float(robot.mass):.4g} kg"
    if given < needed:
        raise ValueError(
            f"{_names(keys, 'force_z_max')}: {cycle} the feet can give {given:.4g} N s, and "
            f"{needed:.4g} N s are needed for {mass} ({MARGIN:g} times its weight); raise it by a "
            f"factor of {needed / given:.3g}"
        )
    if MARGIN * least > weight:
        raise ValueError(
            f"{_names(keys, 'force_z_min')}: {cycle} the feet give at least {least:.4g} N s, and "
            f"{mass} weigh {weight:.4g} N s: the robot would fly off; it must be at most "
            f"{weight / (MARGIN * least):.3g} of what it is"
        )
    if strong < needed:
        keys = {"lmpc" if name == "bound" else name for name in keys}
        raise ValueError(
            f"{_names(keys, 'torque_fraction')}: {cycle} the calf joints can press {strong:.4g} "
            f"N s, and {needed:.4g} N s are needed for {mass} ({MARGIN:g} times its weight)"
        )


def _names(sections: set[str], key: str) -> str:
    return " and ".join(f"{section}.{key}" for section in sorted(sections))


def _calf_force(config: RunConfig, robot: RobotParams, one: gait.Gait) -> float:
    """Vertical force at which the calf's torque limit is reached, foot below the hip [N]."""
    thigh, calf = float(robot.thigh_length), float(robot.calf_length)
    drop = _drop(config, robot, one.name)
    # Height of the knee's triangle (law of cosines): the lever of a force along the line hip-foot.
    along = (thigh**2 - calf**2 + drop**2) / (2.0 * drop)
    lever = np.sqrt(max(thigh**2 - along**2, 1e-12))
    return float(np.min(robot.torque_limit[..., 2]) / lever)


def _drop(config: RunConfig, robot: RobotParams, name: str) -> float:
    """Depth of the foot centre below the hip at the reference height [m]."""
    height = (config.bound if name == "bound" else config.lmpc).height
    return height - float(robot.foot_radius) + float(robot.hip_pos[:, 2].mean())


def _check_reach(config: RunConfig, robot: RobotParams, name: str) -> None:
    section = "bound" if name == "bound" else "lmpc"
    height = getattr(config, section).height
    low, high = np.array(REACH) * float(robot.thigh_length + robot.calf_length)
    drop = _drop(config, robot, name)
    asked = (0.0, *config.command.height)
    if not (low < drop + min(asked) and drop + max(asked) < high):
        key = f"{section}.height is {height:g} m"
        if any(asked):
            key += f" and command.height {min(asked):+g} to {max(asked):+g} m"
        raise ValueError(
            f"{key}; the legs reach {low:.3g} to {high:.3g} m below the "
            f"hips, so that it must be about {low + height - drop:.2f} to "
            f"{high + height - drop:.2f} m"
        )
