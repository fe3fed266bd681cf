"""From a config to what a controller is made of: its spec (static) and its parameters (data)."""

import warnings
from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace
from functools import lru_cache
from math import inf
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from kjax import gait
from kjax.config import CommandConfig, KoopmanConfig, Overlay, RunConfig, SrbConfig
from kjax.gait.reference import SAMPLES, periodic_reference
from kjax.koopman.edmd import fit_modes, srb_params
from kjax.koopman.prediction import build_prediction, model_spec
from kjax.koopman.validate import force_response_error
from kjax.legs import lateral, swing
from kjax.mpc import multiphase
from kjax.mpc.lmpc import ModeSettings
from kjax.params import ControllerParams, Fits
from kjax.rigid_body import body_numbers, mean_force, own_body
from kjax.spec import ControllerSpec, CycleSpec
from kjax.types import COMMAND_NAMES, MODE_ALPHA, Command, Mode, RobotParams
from kjax.walkable import build_gaits, check_walkable, cycle_nodes


def resolve(config: RunConfig, robot: RobotParams) -> tuple[ControllerSpec, ControllerParams]:
    """Spec and parameters of a controller; fits the Koopman models.

    A fit whose response to forces is far from the rigid body's along the LMPC's horizon is warned
    of.

    Args:
      config: of the run.
      robot: e.g. ``kjax.robots.go1.PARAMS``.

    Returns:
      What ``build_controller`` takes, and its parameters, NumPy arrays in float64: change or batch
      them, then ``condense`` both to what the controller's functions take.

    Raises:
      ValueError: for a config that this robot cannot walk with, naming the key.
    """
    spec = controller_spec(config)
    check_walkable(config, robot)
    with jax.enable_x64(True):
        fits = fit_models(config, robot)
        _warn_of_fits(config, robot, fits)
        return spec, jax.device_get(gather(config, robot, fits))


def controller_spec(config: RunConfig) -> ControllerSpec:
    """The static choices of a config.

    Raises:
      ConfigError: for a file of a model that cannot be used.
    """
    lmpc, chosen = config.lmpc, config.multiphase
    gaits = build_gaits(config)
    nodes = int(cycle_nodes(gaits, config).sum(axis=1).max())
    cycle = CycleSpec(nodes=nodes, tolerance=chosen.tolerance, max_iterations=chosen.max_iterations)
    return ControllerSpec(
        base=config.sim.base,
        act_dt=config.leg.act_dt,
        control_dt=lmpc.control_dt,
        model_dt=lmpc.model_dt,
        horizon=lmpc.horizon,
        model=model_spec(config.koopman),
        discounts_uncertainty=lmpc.caution > 0,
        friction_rows=lmpc.friction < inf,
        torque_rows=lmpc.torque_fraction < inf,
        solver=lmpc.solver,
        warm_start=lmpc.warm_start,
        tolerance=lmpc.tolerance,
        max_iterations=lmpc.max_iterations,
        cycle=cycle if nodes else None,
        gaits=tuple((len(one.phases), one.ramp_cycles) for one in gaits),
    )


@lru_cache(maxsize=8192)
def controller_key(config: RunConfig) -> Hashable:
    """What ``resolve`` reads of a config, but for the command and the times of gaits.

    Configs with the same key have the same parameters, but for these.
    """
    asked = replace(config.gait, times=tuple(map(float, range(len(config.gait.times)))))
    return (
        config.srb,
        config.koopman,
        config.lmpc,
        asked,
        config.bound,
        config.multiphase,
        config.leg,
        config.lateral,
        config.sim.base,
    )


def fit_models(config: RunConfig, robot: RobotParams) -> Fits:
    """Fit the Koopman models of a config; call it in float64.

    Configs that differ elsewhere, in weights or bounds, share one fit.
    """
    bound = config.bound
    sole = float(robot.foot_radius - bound.height)
    srb = own_body(config.srb, robot, config.lmpc.height)
    feet = ((bound.feet_front, sole), (-bound.feet_rear, sole))
    height = config.lmpc.height if config.koopman.model == "srb_hover" else 0.0
    # What a file holds may have changed since.
    fit = _fit.__wrapped__ if config.koopman.file else _fit
    return fit(srb, config.koopman, feet, height)


@lru_cache(maxsize=32)
def _fit(
    srb: SrbConfig,
    koopman: KoopmanConfig,
    bound_feet: tuple[tuple[float, float], tuple[float, float]],
    height: float,
) -> Fits:
    body = srb_params(srb, {Mode.FRONT: bound_feet, Mode.REAR: bound_feet})
    key = jax.random.key(koopman.dataset.seed)
    model, report = _fit_modes(body, koopman, key)
    if not bool(report.finite.all()):
        raise ValueError("the EDMD fit is not finite: check srb and koopman.dataset ranges")
    prediction = None
    if koopman.model != "linear":
        prediction = build_prediction(body, koopman, key, height=height)
    spread = report.residual_rms if prediction is None else prediction.spread
    return jax.device_get(Fits(model, body.feet, spread, prediction))


def _warn_of_fits(config: RunConfig, robot: RobotParams, fits: Fits) -> None:
    """Warn of a linear EDMD model that an LMPC over this horizon should not rely on."""
    if config.koopman.model != "linear":
        return
    gaits = build_gaits(config)
    planned = {
        phase.mode
        for one, nodes in zip(gaits, cycle_nodes(gaits, config), strict=True)
        for phase in one.phases
        if one.name in config.gait.names and not nodes.any()
    }
    srb = own_body(config.srb, robot, config.lmpc.height)
    body = jax.device_get(srb_params(srb)._replace(feet=fits.feet))
    duration = config.lmpc.model_dt * config.lmpc.horizon
    for mode in sorted(planned - {Mode.FLIGHT}):
        model, here = (jax.tree.map(lambda a, m=mode: a[m], part) for part in (fits.model, body))
        error = force_response_error(
            model,
            here,
            MODE_ALPHA[mode],
            steps=round(duration / config.koopman.dataset.dt),
            duration=duration,
        )
        if error > 1.0:
            warnings.warn(
                f"koopman: over the LMPC's {duration:g} s the velocity that the fitted "
                f"{mode.name.lower()} model predicts for a held force is {error:.1f} times the "
                "rigid body's response away from it, so it may throw the robot over; try fewer "
                "powers (koopman.order), more koopman.dataset.rollouts or another "
                "koopman.dataset.seed",
                stacklevel=3,
            )


def gather(config: RunConfig | Overlay, robot: RobotParams, fits: Fits) -> ControllerParams:
    """Parameters from a config, or an ``Overlay`` with traced values, and its fits."""
    gaits = build_gaits(config)
    names = [g.name for g in gaits]
    leg, bound, sideways = config.leg, config.bound, config.lateral
    is_bound = np.array([name == "bound" for name in names])
    foresees = cycle_nodes(gaits, config).any(axis=1)
    mass, inertia = body_numbers(config, robot)
    return ControllerParams(
        robot=robot,
        fits=fits,
        modes=mode_settings(config.lmpc, bound, mean_force(config, mass)),
        uncertainty_discount=jnp.asarray(config.lmpc.caution, float),
        friction=jnp.asarray(config.lmpc.friction, float),
        torque_fraction=jnp.asarray(config.lmpc.torque_fraction, float),
        schedule=gait.build_schedule(gaits),
        gait_times=jnp.asarray(config.gait.times),
        gaits=jnp.asarray([names.index(name) for name in config.gait.names]),
        reference=_reference_tables(gaits, config, mass, inertia),
        multiphase=multiphase_params(gaits, config, robot),
        swing=swing.SwingParams(
            apex=jnp.where(is_bound, bound.apex, leg.apex),
            velocity_gain=jnp.where(is_bound, bound.velocity_gain, leg.velocity_gain),
            offset=jnp.asarray(is_bound)[:, None] * _bound_offset(robot, config),
            horizontal_fraction=jnp.asarray(leg.horizontal_fraction),
            hold_after=jnp.asarray(leg.hold_after),
            reach_speed=jnp.asarray(leg.reach_speed),
            kp=jnp.asarray([leg.kp_abduction, leg.kp, leg.kp]),
            kd=jnp.asarray([leg.kd_abduction, leg.kd, leg.kd]),
        ),
        lateral=lateral.LateralParams(
            roll=jnp.asarray([sideways.roll_stiffness, sideways.roll_damping]),
            yaw=jnp.asarray([sideways.yaw_stiffness, sideways.yaw_damping]),
            damping=jnp.asarray(sideways.damping),
            weights=jnp.asarray(sideways.wrench_weights),
            ridge=jnp.asarray(sideways.force_weight),
            friction=jnp.minimum(
                sideways.friction,
                jnp.where(foresees, config.multiphase.friction, config.lmpc.friction),
            ),
            torque_fraction=jnp.minimum(
                1.0,
                jnp.where(foresees, config.multiphase.torque_fraction, config.lmpc.torque_fraction),
            ),
            foothold_gain=jnp.asarray(sideways.velocity_gain),
        ),
        command=build_command(config.command),
        height=jnp.where(is_bound, bound.height, config.lmpc.height),
        command_slew=jnp.asarray(config.lmpc.command_slew, float),
        height_slew=jnp.asarray(config.lmpc.height_slew, float),
        integral=jnp.stack(
            [jnp.asarray(config.lmpc.integral_gains), jnp.asarray(config.lmpc.integral_limits)]
        ),
        position_slack=jnp.asarray(config.lmpc.position_slack),
        hold_time=jnp.asarray(leg.hold_time),
        blind_damping=jnp.asarray(leg.blind_damping),
    )


def build_command(command: CommandConfig) -> Command:
    """The command of a config as arrays, NumPy in float64."""
    columns = [getattr(command, name) or [0.0] * len(command.times) for name in COMMAND_NAMES]
    values = np.stack([np.asarray(column, float) for column in columns], axis=-1)
    return Command(np.asarray(command.times, float), values)  # type: ignore[arg-type]


_fit_modes = jax.jit(fit_modes, static_argnames="config")


def mode_settings(lmpc: Any, bound: Any, mean_force: Float[Array, "M 2"]) -> ModeSettings:
    """Settings per mode: the bound's own in front and rear stance, the LMPC's elsewhere.

    Args:
      lmpc: section of the config, or an ``Overlay``: weights and bounds.
      bound: likewise, of front and rear stance.
      mean_force: (M, 2) F_z per front and rear leg that R penalises the distance from [N].
    """
    single = np.isin(np.arange(len(Mode)), [Mode.FRONT, Mode.REAR])[:, None]
    standing = np.repeat(MODE_ALPHA > 0, 2, axis=1)

    def chosen(of: Callable[[Any], Sequence[float]]) -> Array:
        return jnp.where(single, jnp.asarray(of(bound), float), jnp.asarray(of(lmpc), float))

    hover = jnp.stack([jnp.zeros_like(mean_force), mean_force], axis=-1).reshape(len(Mode), 4)
    lower = chosen(lambda config: [-config.force_x_max, config.force_z_min] * 2)
    upper = chosen(lambda config: [config.force_x_max, config.force_z_max] * 2)
    return ModeSettings(
        state_weights=chosen(lambda config: config.state_weights),
        input_weights=chosen(lambda config: [config.input_weight] * 4),
        lower=jnp.where(standing, lower, 0.0),
        upper=jnp.where(standing, upper, 0.0),
        input_reference=jnp.where(standing, hover, 0.0),
    )


def multiphase_params(
    gaits: list[gait.Gait], config: RunConfig | Overlay, robot: RobotParams
) -> multiphase.MultiPhaseParams:
    """Numbers of the multi-phase LMPC; of no effect on gaits without nodes."""
    chosen, bound = config.multiphase, config.bound
    mass, inertia = body_numbers(config, robot)
    return multiphase.MultiPhaseParams(
        nodes=jnp.asarray(cycle_nodes(gaits, config)),
        state_weights=jnp.asarray(chosen.state_weights),
        input_weight=jnp.asarray(chosen.input_weight),
        mass=jnp.asarray(mass),
        inertia=jnp.asarray(inertia * chosen.inertia_scale),
        friction=jnp.asarray(chosen.friction),
        torque_limit=jnp.asarray(chosen.torque_fraction * robot.torque_limit[1:]),
        force_x_max=jnp.asarray(chosen.force_x_max),
        force_z=jnp.asarray([chosen.force_z_min, chosen.force_z_max]),
        feet=jnp.asarray([bound.feet_front, -bound.feet_rear]),
        velocity_gain=jnp.asarray(bound.velocity_gain),
        velocity_time=jnp.asarray(chosen.velocity_time),
        height_time=jnp.asarray(chosen.height_time),
    )


def _reference_tables(
    gaits: list[gait.Gait], config: RunConfig | Overlay, mass: Any, inertia: Any
) -> Array:
    """Periodic motion of every gait at every ramp level; zero but for a bound that wants one."""
    bound = config.bound
    levels = 1 + max(g.ramp_cycles for g in gaits)
    rows = jnp.zeros((len(gaits), levels, max(len(g.phases) for g in gaits), SAMPLES, 4))
    for index, one in enumerate(gaits):
        if one.name != "bound" or bound.reference != "periodic":
            continue
        modes = [phase.mode for phase in one.phases]
        cycles = [
            periodic_reference(
                np.array(one.durations(level)),
                modes,
                bound.feet_front,
                bound.feet_rear,
                mass,
                inertia,
                bound.force_edge,
            ).rows
            for level in range(levels)
        ]
        rows = rows.at[index].set(jnp.stack(cycles))
    return rows


def _bound_offset(robot: RobotParams, config: RunConfig | Overlay) -> Array:
    """Foothold of a bound ahead of the hip, standing still, for each leg [m]."""
    wanted = [config.bound.feet_front] * 2 + [-config.bound.feet_rear] * 2
    return jnp.stack([jnp.asarray(one, float) for one in wanted]) - robot.hip_pos[:, 0]
