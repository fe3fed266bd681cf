"""Configuration: frozen dataclasses filled from TOML; a wrong key or value is one clear line.

Every field's docstring ends with its unit in brackets; ``--help`` of the experiments shows them.
"""

import dataclasses
import difflib
import itertools
import json
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from math import inf
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError, model_validator
from pydantic.dataclasses import dataclass
from pydantic.fields import FieldInfo

_STRICT = ConfigDict(extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False)

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Count = Annotated[int, Field(gt=0)]
# The only quantities that may be infinite: bounds that a user wants to switch off.
Bound = Annotated[float, Field(allow_inf_nan=True)]


T = TypeVar("T")


class ConfigError(ValueError):
    """A configuration that cannot be used; the message names file, key, value and wish."""


def _require_timeline(times: Sequence[float], name: str, values: Sequence[object]) -> None:
    """Refuse pieces in time that are not as many as their values, or not in order from 0 on."""
    if not times or len(times) != len(values):
        raise ValueError(
            f"times and {name} must be equally long and not empty, got {len(times)} and "
            f"{len(values)}"
        )
    if times[0] != 0.0:
        raise ValueError(f"times must start at 0, got {list(times)}")
    if any(b <= a for a, b in itertools.pairwise(times)):
        raise ValueError(f"times must increase, got {list(times)}")


def _require_multiple(name: str, value: float, base_name: str, base: float) -> None:
    ratio = value / base
    if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6:
        raise ValueError(
            f"{name} must be a whole multiple of {base_name}, got {value} s and {base} s"
        )


def _require_order(config: Any) -> None:
    if not config.force_z_min <= config.force_z_max:
        raise ValueError(
            f"force_z_min must not exceed force_z_max, got {config.force_z_min} and "
            f"{config.force_z_max}"
        )


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class CommandConfig:
    """Forward velocity command: a step function of time."""

    times: tuple[NonNegative, ...] = (0.0, 6.0, 10.0, 14.0, 18.0)
    """Start of each piece, increasing, the first one 0 [s]."""
    velocities: tuple[float, ...] = (0.0, 0.1, 0.3, 0.2, 0.0)
    """Velocity that holds from each of those times on [m/s]."""

    @model_validator(mode="after")
    def _check(self) -> "CommandConfig":
        _require_timeline(self.times, "velocities", self.velocities)
        return self


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class SrbConfig:
    """Single rigid body that the models are fitted to."""

    mass: Positive = 12.743
    """Mass of the body; the Go1's by default [kg]."""
    inertia: Positive = 0.394
    """Pitch inertia about the centre of mass; the whole Go1's in its stance by default [kg m^2]."""
    feet_front: tuple[float, float] = (0.190, -0.250)
    """Front contact point (x, z) relative to the centre of mass, body frame [m]."""
    feet_rear: tuple[float, float] = (-0.186, -0.250)
    """Rear contact point (x, z) relative to the centre of mass, body frame [m]."""


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class DatasetConfig:
    """Random SRB rollouts that the models are fitted to; uniform in the ranges given here."""

    rollouts: Count = 100
    """Number of rollouts per contact mode [-]."""
    duration: Positive = 0.1
    """Length of a rollout [s]."""
    dt: Positive = 0.001
    """Runge-Kutta and snapshot step [s]."""
    hold: Count = 1
    """Number of steps for which each random force is held [-]."""
    height: Positive = 0.27
    """Centre of the sampled heights [m]."""
    state_range: tuple[
        NonNegative, NonNegative, NonNegative, NonNegative, NonNegative, NonNegative
    ] = (0.5, 0.1, 0.3, 1.0, 0.5, 2.0)
    """Half-ranges of the initial (p_x, p_z, theta, v_x, v_z, omega) [m, rad, m/s, rad/s]."""
    force_x: NonNegative = 60.0
    """Half-range of each leg's F_x, body frame [N]."""
    force_z: tuple[float, float] = (0.0, 150.0)
    """Range of each leg's F_z, body frame [N]."""
    feet_range: tuple[NonNegative, NonNegative] = (0.12, 0.05)
    """Half-ranges of the contact points' (x, z); used by koopman.feet = "measured" only [m]."""
    seed: int = 1
    """Seed of the training rollouts [-]."""

    @model_validator(mode="after")
    def _check(self) -> "DatasetConfig":
        if self.force_z[0] > self.force_z[1]:
            raise ValueError(f"force_z must be (low, high), got {list(self.force_z)}")
        if round(self.duration / self.dt) < 1:
            raise ValueError(f"duration {self.duration} s holds no step of dt {self.dt} s")
        return self


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class KoopmanConfig:
    """EDMD models, one per contact mode."""

    dictionary: Literal["paper", "paper_literal"] = "paper"
    """The paper's dictionary without its duplicate columns, or letter by letter [-]."""
    order: Annotated[int, Field(ge=0, le=8)] = 4
    """Highest power p of the pitch rate in the dictionary [-]."""
    constant_rotation: bool = False
    """Whether to add R itself (the k = 0 term), which the paper leaves out [-]."""
    feet: Literal["fixed", "measured"] = "fixed"
    """Contact points of the model: constant per mode (the paper) or the robot's own [-]."""
    dataset: DatasetConfig = DatasetConfig()
    """Training data."""


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class LmpcConfig:
    """Linear MPC on the lifted models."""

    control_dt: Positive = 0.005
    """Time between two plans [s]."""
    model_dt: Positive = 0.001
    """Step of the prediction model, a multiple of koopman.dataset.dt [s]."""
    horizon: Count = 6
    """Length of the prediction, in steps of model_dt [-]."""
    state_weights: tuple[
        NonNegative, NonNegative, NonNegative, NonNegative, NonNegative, NonNegative
    ] = (2000.0, 3e4, 1200.0, 12.0, 3.0, 0.08)
    """Q of (p_x, p_z, theta, v_x, v_z, omega) [1/m^2, 1/rad^2, s^2/m^2, s^2/rad^2]."""
    input_weight: Positive = 1e-5
    """R of every force [1/N^2]."""
    input_reference: Literal["zero", "hover"] = "zero"
    """What R penalises the distance from: no force (the paper) or half the weight each [-]."""
    force_x_max: Annotated[float, Field(ge=0, allow_inf_nan=True)] = 60.0
    """Bound of |F_x| per leg, body frame [N]."""
    force_z_min: Bound = 0.0
    """Lower bound of F_z per leg, body frame [N]."""
    force_z_max: Bound = 160.0
    """Upper bound of F_z per leg, body frame [N]."""
    height: Positive = 0.27
    """Reference height of the centre of mass above ground [m]."""
    height_above: Literal["ground", "feet"] = "ground"
    """What the reference height is measured from: z = 0, or the stance feet (rough ground) [-]."""
    command_slew: Annotated[float, Field(gt=0, allow_inf_nan=True)] = 4.0
    """Largest rate at which the reference velocity follows the command; inf for none [m/s^2]."""
    integral_gains: tuple[NonNegative, NonNegative] = (0.0, 0.0)
    """Rates at which the errors of velocity and pitch move their references; 0: not [1/s]."""
    integral_limits: tuple[NonNegative, NonNegative] = (0.15, 0.15)
    """Largest correction of velocity and pitch reference by that [m/s, rad]."""
    position_slack: Positive = 0.10
    """Largest lead or lag of the integrated position reference before the body [m]."""
    solver: Literal["admm", "projected_gradient"] = "admm"
    """Method of the box QP [-]."""
    tolerance: Positive = 1e-6
    """Relative KKT residual at which the QP counts as solved [-]."""
    max_iterations: Count = 2000
    """Iteration limit of the QP [-]."""

    @model_validator(mode="after")
    def _check(self) -> "LmpcConfig":
        _require_order(self)
        return self


GaitName = Literal["trot", "bound", "stand"]


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class GaitConfig:
    """Which gait when."""

    names: tuple[GaitName, ...] = ("trot",)
    """Gaits to walk in, one after the other [-]."""
    times: tuple[NonNegative, ...] = (0.0,)
    """When each of them is asked for, increasing, the first one 0 [s]."""
    stance_time: Positive = 0.25
    """Duration of each trot stance; the other diagonal swings meanwhile [s]."""
    trot_flight: NonNegative = 0.0
    """Flight after each trot stance; more than 0 makes a flying trot [s]."""
    switch_rule: Literal["flight", "anywhere"] = "flight"
    """When a bound may be left: in the flight after front stance (Raibert), or at once [-]."""
    landing_time: NonNegative = 0.0
    """Four-leg stance between a bound and the next gait [s]."""

    @model_validator(mode="after")
    def _check(self) -> "GaitConfig":
        _require_timeline(self.times, "names", self.names)
        return self


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class BoundConfig:
    """The bound: timing, feet, reference, and its own LMPC weights and bounds."""

    front_stance: Positive = 0.1
    """Duration of the front stance [s]."""
    first_flight: Positive = 0.1
    """Duration of the flight after it [s]."""
    rear_stance: Positive = 0.05
    """Duration of the rear stance [s]."""
    second_flight: Positive = 0.1
    """Duration of the flight after it [s]."""
    ramp_start: Annotated[float, Field(gt=0, le=1)] = 0.3
    """Length of the flights in the first cycle, as a fraction of the full one [-]."""
    ramp_cycles: Annotated[int, Field(ge=0)] = 10
    """Number of cycles over which the flights grow to their full length [-]."""
    feet_front: Positive = 0.075
    """Distance of the front footholds ahead of the centre of mass, standing still [m]."""
    feet_rear: Positive = 0.148
    """Distance of the rear footholds behind the centre of mass, standing still [m]."""
    horizon: Literal["stance", "multiphase"] = "stance"
    """What the prediction covers: the present stance (the paper), or a whole cycle ([multiphase],
    which then has the weights and bounds) [-]."""
    reference: Literal["periodic", "constant"] = "periodic"
    """Reference of height and pitch: the cycle's own motion, or constant (the paper) [-]."""
    height: Positive = 0.27
    """Mean height of the centre of mass in stance [m]."""
    state_weights: tuple[
        NonNegative, NonNegative, NonNegative, NonNegative, NonNegative, NonNegative
    ] = (1084.0, 1211.0, 60.0, 3.06, 3.05, 0.1)
    """Q of (p_x, p_z, theta, v_x, v_z, omega) [1/m^2, 1/rad^2, s^2/m^2, s^2/rad^2]."""
    input_weight: Positive = 5.7e-7
    """R of every force [1/N^2]."""
    force_x_max: Annotated[float, Field(ge=0, allow_inf_nan=True)] = 51.5
    """Bound of |F_x| per leg, body frame [N]."""
    force_z_min: Bound = 20.0
    """Lower bound of F_z per leg: a foot that carries no weight slips [N]."""
    force_z_max: Bound = 300.0
    """Upper bound of F_z per leg, body frame [N]."""
    velocity_gain: NonNegative = 0.075
    """Raibert gain on the velocity error in the foothold [s]."""
    apex: Positive = 0.064
    """Height of the swing above the higher of lift-off and target [m]."""

    @model_validator(mode="after")
    def _check(self) -> "BoundConfig":
        _require_order(self)
        return self


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class MultiPhaseConfig:
    """LMPC of the bound over one gait cycle, through flight; for bound.horizon = "multiphase"."""

    node_dt: Positive = 0.0125
    """Longest node of a stance; a flight is one node [s]."""
    state_weights: tuple[
        NonNegative, NonNegative, NonNegative, NonNegative, NonNegative, NonNegative
    ] = (32.6, 95.3, 12.9, 50.7, 1.59, 0.323)
    """Q of (p_x, p_z, theta, v_x, v_z, omega), per second [1/s times that of bound]."""
    input_weight: Positive = 1.64e-5
    """R of every force's distance from the periodic one, per second [1/(N^2 s)]."""
    force_x_max: Annotated[float, Field(ge=0, allow_inf_nan=True)] = 80.0
    """Bound of |F_x| per leg, world frame [N]."""
    force_z_min: Bound = 10.0
    """Lower bound of F_z per leg, world frame [N]."""
    force_z_max: Bound = 305.0
    """Upper bound of F_z per leg, world frame [N]."""
    friction: Positive = 0.72
    """mu of the pyramid |F_x| <= mu F_z; below the ground's, for margin [-]."""
    torque_fraction: Annotated[float, Field(gt=0, le=1)] = 0.95
    """Part of the thigh's and the calf's torque limit that planned forces may take [-]."""
    inertia_scale: Positive = 0.883
    """Pitch inertia of the prediction over srb.inertia: legs in swing count for less [-]."""
    velocity_time: Positive = 0.51
    """Time in which the velocity is predicted to reach its reference, for moment arms [s]."""
    height_time: Positive = 0.16
    """The same of height and pitch [s]."""
    tolerance: Positive = 1e-6
    """Relative residuals and gap at which the QP counts as solved [-]."""
    max_iterations: Count = 30
    """Iteration limit of the interior point [-]."""

    @model_validator(mode="after")
    def _check(self) -> "MultiPhaseConfig":
        _require_order(self)
        return self


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class LegConfig:
    """Swing trajectory, footholds and joint control."""

    apex: Positive = 0.06
    """Height of the swing above the higher of lift-off and target [m]."""
    horizontal_fraction: Annotated[float, Field(gt=0, le=1)] = 0.9
    """Part of the swing after which the foot has arrived above its foothold [-]."""
    velocity_gain: NonNegative = 0.03
    """Raibert gain on the velocity error in the foothold [s]."""
    reach_speed: NonNegative = 1.0
    """Speed at which a foot feels for the ground when a change of gait has cut its swing short;
    0: its leg presses at once [m/s]."""
    hold_after: Annotated[float, Field(ge=0, le=1)] = 0.3
    """Part of the swing after which a contact is an obstacle and the foot is held [-]."""
    kp: NonNegative = 150.0
    """Stiffness of thigh and calf joint in swing [N m/rad]."""
    kd: NonNegative = 3.0
    """Damping of thigh and calf joint in swing [N m s/rad]."""
    kp_abduction: NonNegative = 200.0
    """Stiffness of the abduction joint: in swing, or always on the planar base [N m/rad]."""
    kd_abduction: NonNegative = 4.0
    """Damping of the abduction joint, likewise [N m s/rad]."""


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class LateralConfig:
    """Regulator of roll, yaw and sideways motion; for sim.base = "free" only."""

    roll_stiffness: NonNegative = 60.0
    """Roll moment per roll [N m/rad]."""
    roll_damping: NonNegative = 4.0
    """Roll moment per roll rate [N m s/rad]."""
    yaw_stiffness: NonNegative = 20.0
    """Yaw moment per yaw away from the heading at the start [N m/rad]."""
    yaw_damping: NonNegative = 3.0
    """Yaw moment per yaw rate [N m s/rad]."""
    damping: NonNegative = 30.0
    """Sideways force per sideways velocity of the centre of mass [N s/m]."""
    wrench_weights: tuple[
        NonNegative, NonNegative, NonNegative, NonNegative, NonNegative, NonNegative
    ] = (1.0, 0.3, 1.0, 20.0, 20.0, 10.0)
    """Weights of the wrench (force x, y, z, moment x, y, z) [1/N^2, 1/(N m)^2]."""
    force_weight: Positive = 1e-3
    """Weight of a change of the planned foot forces [1/N^2]."""
    friction: NonNegative = 0.7
    """Sideways over vertical force of a foot, at most [-]."""
    friction_offset: NonNegative = 3.0
    """Horizontal force allowed beyond that [N]."""
    plan_friction: Annotated[float, Field(ge=0, allow_inf_nan=True)] = 0.8
    """The planned F_x is cut at this part of F_z; inf leaves it to the LMPC's box [-]."""
    plan_friction_bound: Annotated[float, Field(ge=0, allow_inf_nan=True)] = inf
    """The same in a bound, which loses speed by it: its F_z falls to bound.force_z_min [-]."""
    velocity_gain: NonNegative = 0.05
    """Sideways foothold per sideways velocity, beyond Raibert's law [s]."""


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class TerrainConfig:
    """Obstacles on the way."""

    kind: Literal["flat", "paper", "blocks", "steps", "slope", "patches"] = "flat"
    """None; the paper's blocks, cubes and capsules; or one of ours [-]."""
    seed: int = 0
    """Seed of the field; independent of the noise's [-]."""
    count: Count = 8
    """Number of obstacles, steps or patches [-]."""
    start: Positive = 0.8
    """Where the field begins, measured from the robot's start [m]."""
    end: Positive = 2.6
    """Where it ends [m]."""
    height_min: Positive = 0.05
    """Lowest obstacle, or rise of a step [m]."""
    height_max: Positive = 0.07
    """Highest obstacle, or rise of a step [m]."""
    slope: Annotated[float, Field(gt=0, lt=45)] = 8.0
    """Inclination of a slope [deg]."""
    patch_friction: Positive = 0.3
    """Friction of a foot on a patch [-]."""

    @model_validator(mode="after")
    def _check(self) -> "TerrainConfig":
        for low, high in (("start", "end"), ("height_min", "height_max")):
            if not getattr(self, low) <= getattr(self, high):
                raise ValueError(
                    f"{low} must not exceed {high}, got {getattr(self, low)} and "
                    f"{getattr(self, high)}"
                )
        return self


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class PushConfig:
    """Pushes on the trunk, at its centre of mass, in the world frame."""

    times: tuple[NonNegative, ...] = ()
    """When each push begins; none by default [s]."""
    forward: float | tuple[float, ...] = 0.0
    """Impulse along x, of every push or of each [N s]."""
    lateral: float | tuple[float, ...] = 0.0
    """Impulse along y, to the left; the free base only [N s]."""
    duration: Positive = 0.1
    """Time over which an impulse is spread evenly [s]."""

    @model_validator(mode="after")
    def _check(self) -> "PushConfig":
        for name in ("forward", "lateral"):
            value = getattr(self, name)
            if isinstance(value, tuple) and len(value) != len(self.times):
                raise ValueError(
                    f"{name} must be one number or as many as times, got {len(value)} and "
                    f"{len(self.times)}"
                )
        return self


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class NoiseConfig:
    """Sensor noise (white, each physics step) and spread of the initial state; 1 sigma each."""

    enabled: bool = True
    """Whether noise and initial spread are applied [-]."""
    position: NonNegative = 0.001
    """Trunk position [m]."""
    pitch: NonNegative = 0.003
    """Trunk orientation [rad]."""
    velocity: NonNegative = 0.02
    """Trunk velocity [m/s]."""
    pitch_rate: NonNegative = 0.05
    """Trunk angular velocity [rad/s]."""
    joint_position: NonNegative = 0.001
    """Joint angles [rad]."""
    joint_velocity: NonNegative = 0.02
    """Joint rates [rad/s]."""
    initial_pitch: NonNegative = 0.02
    """Pitch at the start [rad]."""
    initial_velocity: NonNegative = 0.05
    """Trunk velocity at the start [m/s]."""
    initial_pitch_rate: NonNegative = 0.2
    """Trunk pitch rate at the start [rad/s]."""


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class SimConfig:
    """Physics."""

    sim_dt: Positive = 0.001
    """Physics step; torques are recomputed at each [s]."""
    base: Literal["planar", "free"] = "planar"
    """Trunk on two slides and a pitch hinge, or free; the controller is built for either [-]."""
    friction: Positive = 0.8
    """Sliding friction coefficient of the feet [-]."""
    cone: Literal["pyramidal", "elliptic"] = "pyramidal"
    """Friction cone of the contact solver; MJX wants the pyramid [-]."""
    contacts: Literal["all", "feet"] = "all"
    """Which of the robot's bodies touch the ground: all, or the feet only (faster) [-]."""
    joint_damping: NonNegative = 0.1
    """Viscous joint damping [N m s/rad]."""
    joint_armature: NonNegative = 0.01
    """Reflected rotor inertia [kg m^2]."""
    contact_threshold: NonNegative = 5.0
    """Foot force above which the contact sensor fires [N]."""


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class RunConfig:
    """One closed-loop run."""

    duration: Positive = 22.0
    """Simulated time [s]."""
    seed: int = 0
    """Seed of noise and initial state [-]."""
    command: CommandConfig = CommandConfig()
    """Velocity command."""
    srb: SrbConfig = SrbConfig()
    """Single rigid body of the prediction."""
    koopman: KoopmanConfig = KoopmanConfig()
    """Prediction models."""
    lmpc: LmpcConfig = LmpcConfig()
    """Model predictive control."""
    gait: GaitConfig = GaitConfig()
    """Gait."""
    bound: BoundConfig = BoundConfig()
    """Bound."""
    multiphase: MultiPhaseConfig = MultiPhaseConfig()
    """Multi-phase horizon of the bound."""
    leg: LegConfig = LegConfig()
    """Swing legs."""
    lateral: LateralConfig = LateralConfig()
    """Roll, yaw and sideways motion of a free base."""
    sim: SimConfig = SimConfig()
    """Physics."""
    terrain: TerrainConfig = TerrainConfig()
    """Terrain."""
    push: PushConfig = PushConfig()
    """Pushes."""
    noise: NoiseConfig = NoiseConfig()
    """Noise."""

    @model_validator(mode="after")
    def _check(self) -> "RunConfig":
        _require_multiple("lmpc.control_dt", self.lmpc.control_dt, "sim.sim_dt", self.sim.sim_dt)
        _require_multiple(
            "lmpc.model_dt", self.lmpc.model_dt, "koopman.dataset.dt", self.koopman.dataset.dt
        )
        _require_multiple("push.duration", self.push.duration, "sim.sim_dt", self.sim.sim_dt)
        lateral = self.push.lateral
        if self.sim.base == "planar" and any(lateral if isinstance(lateral, tuple) else [lateral]):
            raise ValueError(f"push.lateral needs sim.base = 'free', got {lateral} and 'planar'")
        bound = self.bound
        shortest = {
            "gait.stance_time": self.gait.stance_time,
            "bound.front_stance": bound.front_stance,
            "bound.rear_stance": bound.rear_stance,
            "bound.first_flight times ramp_start": bound.first_flight * bound.ramp_start,
            "bound.second_flight times ramp_start": bound.second_flight * bound.ramp_start,
        }
        for name, value in (
            ("gait.trot_flight", self.gait.trot_flight),
            ("gait.landing_time", self.gait.landing_time),
        ):
            if value > 0:
                shortest[name] = value
        for name, value in shortest.items():
            if value < self.lmpc.control_dt:
                raise ValueError(
                    f"{name} is {value} s, shorter than lmpc.control_dt {self.lmpc.control_dt} s"
                )
        return self


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class FitStudyConfig:
    """The fit study of the paper's Fig. 3."""

    srb: SrbConfig = SrbConfig()
    """Single rigid body."""
    koopman: KoopmanConfig = KoopmanConfig()
    """Models and training data."""
    test_states: Count = 50
    """Number of random initial states per mode [-]."""
    test_profiles: Count = 50
    """Number of random force profiles, each applied to every initial state [-]."""
    test_duration: Positive = 0.05
    """Length of a test rollout [s]."""
    test_seed: int = 1000
    """Seed of the test set [-]."""
    scales: tuple[Positive, ...] = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01)
    """Sampling ranges of the scan, as fractions of koopman.dataset's [-]."""
    tolerance: Positive = 1e-4
    """Error that the paper claims; the scan reports the largest range within it [m, rad, ...]."""

    @model_validator(mode="after")
    def _check(self) -> "FitStudyConfig":
        _require_multiple(
            "test_duration", self.test_duration, "koopman.dataset.dt", self.koopman.dataset.dt
        )
        return self


def fields(cls: type, prefix: str = "") -> Iterator[tuple[str, FieldInfo, Any]]:
    """Leaf keys of a config class as (dotted name, field, default)."""
    for name, info in cls.__pydantic_fields__.items():  # type: ignore[attr-defined]
        if dataclasses.is_dataclass(info.annotation):
            yield from fields(info.annotation, f"{prefix}{name}.")  # type: ignore[arg-type]
        else:
            yield f"{prefix}{name}", info, info.default


def load_config(
    cls: type[T], path: str | Path | None = None, overrides: Mapping[str, Any] | None = None
) -> T:
    """Config of type ``cls`` from a TOML file, with overrides by dotted name.

    Args:
      cls: a config dataclass of this module.
      path: TOML file; ``None`` means all defaults.
      overrides: e.g. ``{"lmpc.horizon": 10}``; they win over the file.

    Raises:
      ConfigError: with one line that names the file, the key, what came and what was wanted.
    """
    data: dict[str, Any] = {}
    source = "command line"
    if path is not None:
        source = str(path)
        try:
            data = tomllib.loads(Path(path).read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise ConfigError(f"{source}: no such file{_nearest_file(Path(path))}") from None
        except OSError as error:
            raise ConfigError(f"{source}: cannot be read: {error.strerror}") from None
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise ConfigError(f"{source}: not valid TOML: {error}") from None
    for key, value in (overrides or {}).items():
        *sections, leaf = key.split(".")
        node = data
        for section in sections:
            node = node.setdefault(section, {})
            if not isinstance(node, dict):
                raise ConfigError(f"{source}: {key}: '{section}' is a value, not a section")
        node[leaf] = value
    try:
        # Through JSON, since strict mode then takes lists for tuples but still no "3" for 3.
        return TypeAdapter(cls).validate_json(json.dumps(data, default=str), strict=True)
    except ValidationError as error:
        raise ConfigError(f"{source}: {_explain(error, cls)}") from None


def _explain(error: ValidationError, cls: type) -> str:
    """One line on the first problem, and how many more there are."""
    first, *rest = error.errors(include_url=False)
    loc = tuple(str(part) for part in first["loc"])
    key = ".".join(loc)
    came = first["input"]
    if first["type"] in ("unexpected_keyword_argument", "extra_forbidden"):
        names = {name for name, _, _ in fields(cls)}
        names |= {name.rsplit(".", 1)[0] for name in names if "." in name}
        near = difflib.get_close_matches(key, names, n=1, cutoff=0.5)
        hint = f"; did you mean '{near[0]}'?" if near else ""
        text = f"{key}: unknown key (got {came!r}){hint}"
    elif first["type"] == "value_error":
        wish = first["msg"].removeprefix("Value error, ")
        text = f"{key}: {wish}" if key else wish
    else:
        wish = first["msg"].removeprefix("Input should be ")
        options = [str(o) for o in first.get("ctx", {}).get("expected", "").split("'")[1::2]]
        near = difflib.get_close_matches(str(came), options, n=1, cutoff=0.5)
        hint = f"; did you mean '{near[0]}'?" if near else ""
        text = f"{key}: got {came!r}, wanted {wish}{hint}"
    return text + (f" (and {len(rest)} more)" if rest else "")


def _nearest_file(path: Path) -> str:
    if not path.parent.is_dir():
        return ""
    near = difflib.get_close_matches(path.name, [p.name for p in path.parent.glob("*.toml")], n=1)
    return f"; did you mean '{path.parent / near[0]}'?" if near else ""


def to_dict(config: Any) -> dict[str, Any]:
    """The config as nested plain data (lists for tuples), ready for TOML or JSON."""
    return TypeAdapter(type(config)).dump_python(config, mode="json")
