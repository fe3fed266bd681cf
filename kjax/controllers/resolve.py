"""From a config to what a controller is made of: its spec (static) and its parameters (data)."""

from collections.abc import Hashable, Sequence
from dataclasses import replace
from functools import lru_cache
from math import inf
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from kjax import gait
from kjax.concrete import array_library, stacked
from kjax.config import CommandConfig, Overlay, RunConfig
from kjax.config.gaits import gait_setting
from kjax.config.units import InSi, in_si
from kjax.controllers.params import ControllerParams, Fits
from kjax.controllers.resolve_fits import fit_models, warn_of_fits
from kjax.controllers.resolve_model import resolve_model
from kjax.controllers.resolve_spatial import spatial_params, spatial_spec
from kjax.controllers.rigid_body import body_numbers, levers, mean_force
from kjax.controllers.walkable import (
    Problem,
    build_gaits,
    check_walkable,
    contact_problems,
    cycle_nodes,
)
from kjax.gait.reference import SAMPLES, periodic_reference
from kjax.legs import lateral, swing
from kjax.mpc import horizon
from kjax.mpc.lmpc import ModeSettings
from kjax.robots import get_robot
from kjax.spec import ControllerSpec, CycleSpec
from kjax.types import COMMAND_NAMES, MODE_ALPHA, Command, RobotParams, contact_mode


def resolve(
    config: RunConfig, robot: RobotParams | None = None
) -> tuple[ControllerSpec, ControllerParams]:
    """Spec and parameters of a controller; fits the Koopman models of a planar one.

    A fit whose response to forces is far from the rigid body's along the LMPC's horizon is warned
    of.

    Args:
      config: of the run.
      robot: parameters of the robot; those of ``config.robot`` if ``None``.

    Returns:
      What ``build_controller`` takes, and its parameters, NumPy arrays in float64: change or batch
      them, then ``condense`` both to what the controller's functions take.

    Raises:
      ValueError: for a config that this robot cannot walk with, naming the key.
    """
    robot = get_robot(config.robot).params if robot is None else robot
    spec = controller_spec(config)
    check_walkable(config, robot)
    with jax.enable_x64(True):
        fits = None if spec.spatial is not None else fit_models(config, robot)
        warn_of_fits(config, robot, fits)
        return spec, jax.device_get(gather(config, robot, fits))


def controller_spec(config: RunConfig) -> ControllerSpec:
    """The static choices of a config.

    Raises:
      ConfigError: for a file of a model that cannot be used.
    """
    lmpc, chosen = config.lmpc, config.multiphase
    gaits = build_gaits(config)
    nodes = int(cycle_nodes(gaits, config).sum(axis=1).max())
    cycle = CycleSpec(
        nodes=nodes,
        linearise=chosen.linearise,
        tolerance=chosen.tolerance,
        max_iterations=chosen.max_iterations,
    )
    return ControllerSpec(
        base=config.sim.base,
        act_dt=config.leg.act_dt,
        control_dt=lmpc.control_dt,
        model_dt=lmpc.model_dt,
        horizon=lmpc.horizon,
        model=resolve_model(config.koopman),
        discounts_uncertainty=lmpc.uncertainty_discount > 0,
        friction_rows=lmpc.friction < inf,
        torque_rows=lmpc.torque_fraction < inf,
        solver=lmpc.solver,
        warm_start=lmpc.warm_start,
        tolerance=lmpc.tolerance,
        max_iterations=lmpc.max_iterations,
        cycle=cycle if nodes else None,
        spatial=spatial_spec(gaits, config.spatial) if config.controller == "spatial" else None,
        gaits=tuple((len(one.phases), one.ramp_cycles) for one in gaits),
        modes=tuple(problem.mode for problem in contact_problems(gaits, config)[0]),
    )


@lru_cache(maxsize=8192)
def controller_key(config: RunConfig) -> Hashable:
    """What ``resolve`` reads of a config, but for the command and the times of gaits.

    Configs with the same key have the same parameters, but for these.
    """
    asked = replace(config.gait, times=tuple(map(float, range(len(config.gait.times)))))
    return (
        config.robot,
        config.srb,
        config.koopman,
        config.lmpc,
        asked,
        config.gaits,
        config.multiphase,
        config.controller,
        config.spatial,
        config.leg,
        config.lateral,
        config.sim.base,
    )


def gather(config: RunConfig | Overlay, robot: RobotParams, fits: Fits | None) -> ControllerParams:
    """Parameters from a config, or an ``Overlay`` with traced values, and its fits."""
    si = in_si(config, robot)
    gaits = build_gaits(si)
    names = [one.name for one in gaits]
    leg, sideways = si.leg, si.lateral
    uses_gait_cycle = cycle_nodes(gaits, si).any(axis=1)
    problems, index = contact_problems(gaits, si)

    known: dict[str, Any] = {
        "problem": index,
        "gaits": np.asarray([names.index(name) for name in si.gait.names]),
    }
    return ControllerParams(
        **known,
        robot=robot,
        fits=fits,
        modes=problem_settings(si, problems, names, mean_force(gaits, si, robot)),
        uncertainty_discount=_number(si.lmpc.uncertainty_discount),
        friction=_number(si.lmpc.friction),
        torque_fraction=_number(si.lmpc.torque_fraction),
        schedule=gait.build_schedule(gaits),
        gait_times=_number(si.gait.times),
        reference=_reference_tables(gaits, si, robot),
        multiphase=multiphase_params(gaits, si, robot),
        spatial=spatial_params(gaits, si, robot) if config.controller == "spatial" else None,
        swing=swing.SwingParams(
            apex=_column(si, names, "swing_height"),
            velocity_gain=_column(si, names, "foothold_gain"),
            offset=stacked([_foothold_offset(robot, si.gaits[name]) for name in names]),
            horizontal_fraction=_number(leg.horizontal_fraction),
            hold_after=_number(leg.hold_after),
            reach_speed=_number(leg.reach_speed),
            lift=_number(si.spatial.lift),
            kp=stacked([leg.abduction_kp, leg.swing_kp, leg.swing_kp]),
            kd=stacked([leg.abduction_kd, leg.swing_kd, leg.swing_kd]),
        ),
        lateral=lateral.LateralParams(
            roll=stacked([sideways.roll_kp, sideways.roll_kd]),
            yaw=stacked([sideways.yaw_kp, sideways.yaw_kd]),
            damping=_number(sideways.sideways_kd),
            weights=_number(sideways.wrench_cost),
            ridge=_number(sideways.force_weight),
            friction=_smaller(
                sideways.friction, uses_gait_cycle, si.multiphase.friction, si.lmpc.friction
            ),
            torque_fraction=_smaller(
                1.0, uses_gait_cycle, si.multiphase.torque_fraction, si.lmpc.torque_fraction
            ),
            foothold_gain=_number(sideways.foothold_gain),
        ),
        command=build_command(si.command),
        height=_column(si, names, "body_height"),
        command_slew=_number(si.lmpc.command_slew),
        height_slew=_number(si.lmpc.height_slew),
        integral=stacked([si.lmpc.integral_gains, si.lmpc.integral_limits]),
        position_slack=_number(si.lmpc.position_slack),
        hold_time=_number(leg.hold_time),
        blind_damping=_number(leg.blind_kd),
    )


def build_command(command: CommandConfig) -> Command:
    """The command of a config as arrays, NumPy in float64."""
    columns = [getattr(command, name) or [0.0] * len(command.times) for name in COMMAND_NAMES]
    values = np.stack([np.asarray(column, float) for column in columns], axis=-1)
    return Command(np.asarray(command.times, float), values)  # type: ignore[arg-type]


def _column(config: InSi, names: Sequence[str], key: str) -> Array:
    """One setting of several gaits, stacked."""
    return stacked([gait_setting(config, name, key) for name in names])


def _number(value: Any) -> Array:
    """A value, or several, of a config as floats."""
    return array_library(value).asarray(value, float)


def _smaller(limit: Any, where: Any, one: Any, other: Any) -> Array:
    """The limit, or one of two others if that is smaller."""
    xp = array_library(limit, one, other)
    return xp.minimum(limit, xp.where(where, one, other))


def problem_settings(
    config: InSi,
    problems: Sequence[Problem],
    names: Sequence[str],
    mean_force: Float[Array, "G 2"],
) -> ModeSettings:
    """Weights and bounds of every problem: those of its gait.

    Args:
      config: of the run, in SI units.
      problems: contact modes of the gaits.
      names: of the gaits.
      mean_force: (G, 2) F_z per front and rear leg that R penalises the distance from [N].
    """
    standing = np.repeat(MODE_ALPHA[[problem.mode for problem in problems]] > 0, 2, axis=1)

    own = [names[problem.gait] for problem in problems]

    def standing_only(x: Array, z: Array) -> Array:
        xp = array_library(x, z)
        return xp.where(standing, xp.tile(xp.stack([x, z], axis=-1), 2), 0.0)

    lower, upper = (
        standing_only(
            sign * _column(config, own, "grf_x_max"), _column(config, own, f"grf_z_{end}")
        )
        for sign, end in ((-1.0, "min"), (1.0, "max"))
    )
    xp = array_library(mean_force)
    force = mean_force[np.array([problem.gait for problem in problems])]
    hover = xp.stack([xp.zeros_like(force), force], axis=-1).reshape(len(problems), 4)
    weights = _column(config, own, "R")
    return ModeSettings(
        state_weights=_column(config, own, "Q"),
        input_weights=array_library(weights).tile(weights[:, None], 4),
        lower=lower,
        upper=upper,
        input_reference=xp.where(standing, hover, 0.0),
    )


def multiphase_params(
    gaits: list[gait.Gait], config: InSi, robot: RobotParams
) -> horizon.MultiPhaseParams:
    """Numbers of the multi-phase LMPC; of no effect on gaits without nodes."""
    chosen = config.multiphase
    mass, inertia = body_numbers(config, robot)

    names = [one.name for one in gaits]
    arms = [levers(config.gaits[name], robot) for name in names]
    limit = robot.torque_limit[1:]
    nodes: Any = cycle_nodes(gaits, config)
    return horizon.MultiPhaseParams(
        nodes=nodes,
        state_weights=_column(config, names, "Q"),
        input_weight=_column(config, names, "R"),
        mass=_number(mass),
        inertia=_number(inertia * chosen.inertia_scale),
        friction=_number(chosen.friction),
        torque_limit=_number(chosen.torque_fraction * limit),
        force_x_max=_column(config, names, "grf_x_max"),
        force_z=stacked(
            [
                [gait_setting(config, name, key) for key in ("grf_z_min", "grf_z_max")]
                for name in names
            ]
        ),
        feet=stacked([[front, -rear] for front, rear in arms]),
        velocity_gain=_column(config, names, "foothold_gain"),
        velocity_time=_number(chosen.velocity_time),
        height_time=_number(chosen.height_time),
    )


def _reference_tables(gaits: list[gait.Gait], config: InSi, robot: RobotParams) -> Array:
    """Periodic motion of every gait at every ramp level; zero where the reference is constant."""
    mass, inertia = body_numbers(config, robot)
    levels, phases = 1 + max(g.ramp_cycles for g in gaits), max(len(g.phases) for g in gaits)
    rows: list[Any] = []
    for one in gaits:
        own = config.gaits[one.name]
        rows.append(np.zeros((levels, phases, SAMPLES, 4)))
        if own.reference != "periodic":
            continue
        modes = [contact_mode(phase.stance) for phase in one.phases]
        cycles = [
            periodic_reference(
                np.array(one.durations(min(level, one.ramp_cycles))),
                modes,
                *levers(own, robot),
                mass,
                inertia,
                own.force_edge,
            ).rows
            for level in range(levels)
        ]
        xp = array_library(cycles)
        rows[-1] = xp.pad(xp.stack(cycles), [(0, 0), (0, phases - len(modes)), (0, 0), (0, 0)])
    return stacked(rows)


def _foothold_offset(robot: RobotParams, own: Any) -> Any:
    """Foothold of a gait ahead of the hip, standing still, for each leg [m]."""
    if own.foothold_front is None:
        return np.zeros(4)
    return stacked([own.foothold_front] * 2 + [-own.foothold_rear] * 2) - robot.hip_pos[:, 0]
