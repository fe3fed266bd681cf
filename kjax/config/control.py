"""The controller: command, LMPC, gaits, legs."""

from math import inf
from typing import Annotated, Literal

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from kjax.config.checks import (
    COST,
    DAMPING,
    DURATION,
    FORCE,
    GAIN,
    GRF,
    HEIGHT,
    INPUT_COST,
    LENGTH,
    LINEAR_DAMPING,
    MIN_GRF,
    OMEGA_COST,
    POSITION_COST,
    RATE,
    STATE_COST,
    STIFFNESS,
    STRICT,
    TIME,
    VELOCITY_COST,
    WRENCH_COST,
    Bound,
    Count,
    Friction,
    NonNegative,
    Positive,
    Six,
    Three,
    TorqueFraction,
    Tunable,
    require_fraction,
    require_order,
    require_timeline,
)


@dataclass(frozen=True, kw_only=True, config=STRICT)
class CommandConfig:
    """What the robot is asked to do: step functions of time; a list left empty is zero."""

    times: tuple[NonNegative, ...] = (0.0, 6.0, 10.0, 14.0, 18.0)
    """Start of each piece, increasing, the first one 0 [s]."""
    v_x: tuple[float, ...] = (0.0, 0.1, 0.3, 0.2, 0.0)
    """Forward velocity from each of those times on [m/s]."""
    v_y: tuple[float, ...] = ()
    """Velocity to the left [m/s]."""
    yaw_rate: tuple[float, ...] = ()
    """To the left positive [rad/s]."""
    height: tuple[float, ...] = ()
    """Height of the centre of mass above the gait's own [m]."""
    roll: tuple[float, ...] = ()
    """Right side down positive [rad]."""
    pitch: tuple[float, ...] = ()
    """Nose up positive [rad]."""

    @model_validator(mode="after")
    def _check(self) -> "CommandConfig":
        require_timeline(self.times, "v_x", self.v_x)
        for name in ("v_y", "yaw_rate", "height", "roll", "pitch"):
            values = getattr(self, name)
            if values and len(values) != len(self.times):
                raise ValueError(
                    f"{name} must be empty or as long as times, got {len(values)} and "
                    f"{len(self.times)}"
                )
        return self


@dataclass(frozen=True, kw_only=True, config=STRICT)
class LmpcConfig:
    """Linear MPC on the lifted models; weights and bounds of gaits that give none of their own."""

    control_dt: Positive = 0.005
    """Time between two plans [s]."""
    model_dt: Positive = 0.001
    """Step of the prediction model, a multiple of koopman.dataset.dt [s]."""
    horizon: Count = 6
    """Length of the prediction, in steps of model_dt [-]."""
    Q: Annotated[Six, COST, STATE_COST] = (363.0, 5444.0, 1200.0, 50.15, 12.54, 4.606)
    """Weights of the squared errors of (p_x, p_z, theta, v_x, v_z, omega) [1/L^2, 1/L^2, 1/rad^2,
    1/(g L), 1/(g L), L/g]."""
    R: Annotated[Positive, COST, INPUT_COST] = 0.1563
    """Weight of every squared force [1/(m g)^2]."""
    input_reference: Literal["mean", "zero"] = "mean"
    """What R penalises the distance from: the gait's mean force, which carries the weight, or no
    force (the paper), which leaves a droop [-]."""
    grf_x_max: Annotated[float, Field(ge=0, allow_inf_nan=True), GRF, FORCE] = 0.48
    """Bound of |F_x| per leg, body frame [m g]."""
    grf_z_min: Annotated[Bound, MIN_GRF, FORCE] = 0.0
    """Lower bound of F_z per leg, body frame [m g]."""
    grf_z_max: Annotated[Bound, GRF, FORCE] = 1.28
    """Upper bound of F_z per leg, body frame [m g]."""
    body_height: Annotated[Positive, HEIGHT, LENGTH] = 0.6338
    """Reference height of the centre of mass above the ground under the stance feet [L]."""
    command_slew: Annotated[float, Field(gt=0, allow_inf_nan=True)] = 4.0
    """Largest rate at which the reference velocity follows the command; inf for none [m/s^2]."""
    height_slew: Positive = 0.2
    """Largest rate at which the reference height follows the command [m/s]."""
    integral_gains: Annotated[tuple[NonNegative, NonNegative], RATE] = (0.0, 0.0)
    """Rates at which the errors of velocity and pitch move their references; 0: not [1/s]."""
    integral_limits: tuple[NonNegative, NonNegative] = (0.15, 0.15)
    """Largest correction of velocity and pitch reference by that [m/s, rad]."""
    position_slack: Annotated[Positive, Tunable(low=1e-4)] = 0.10
    """Largest lead or lag of the integrated position reference before the body [m]."""
    uncertainty_discount: NonNegative = 0.0
    """How much less a step of the horizon weighs where the model is less certain; 0: none [-]."""
    solver: Literal["tableau", "admm", "projected_gradient"] = "tableau"
    """Method of the QP: the first is exact, the last keeps no rows (friction, torque) [-]."""
    warm_start: bool = True
    """Carry the tableau from tick to tick; without, a batch of robots keeps a smaller state [-]."""
    tolerance: Positive = 1e-9
    """Relative KKT residual at which the QP counts as solved; floored by float32's rounding [-]."""
    max_iterations: Count = 2000
    """Iteration limit of the QP [-]."""
    friction: Friction = 0.6
    """mu of rows |F_x| <= mu F_z within a stance; inf for the paper's box alone [-]."""
    torque_fraction: TorqueFraction = 0.95
    """Part of the joint torque limits that planned forces may take, as rows; inf for none [-]."""

    @model_validator(mode="after")
    def _check(self) -> "LmpcConfig":
        require_order(self)
        require_fraction(self)
        if self.solver == "projected_gradient" and min(self.friction, self.torque_fraction) < inf:
            raise ValueError(
                "solver = 'projected_gradient' cannot keep rows of friction and torque_fraction:"
                " set solver = 'tableau' or 'admm', or friction = torque_fraction = inf"
            )
        return self


@dataclass(frozen=True, kw_only=True, config=STRICT)
class GaitScheduleConfig:
    """Which gait when."""

    names: tuple[str, ...] = ("trot",)
    """Gaits to walk in, one after the other: names of [gaits] [-]."""
    times: tuple[NonNegative, ...] = (0.0,)
    """When each of them is asked for, increasing, the first one 0 [s]."""
    also: tuple[str, ...] = ("trot", "bound", "stand")
    """Gaits that are compiled besides, so that they may be asked for while it runs [-]."""

    @model_validator(mode="after")
    def _check(self) -> "GaitScheduleConfig":
        require_timeline(self.times, "names", self.names)
        return self


@dataclass(frozen=True, kw_only=True, config=STRICT)
class MultiPhaseConfig:
    """LMPC over one gait cycle, through flight; for gaits whose horizon is "multiphase"."""

    node_dt: Positive = 0.0125
    """Longest node of a stance; a flight is one node [s]."""
    friction: Annotated[float, Field(ge=0.05)] = 0.6
    """mu of the pyramid |F_x| <= mu F_z; below the ground's, for margin [-]."""
    torque_fraction: Annotated[float, Field(gt=0, le=1)] = 0.95
    """Part of the thigh's and the calf's torque limit that planned forces may take [-]."""
    inertia_scale: Annotated[Positive, Tunable(low=0.3, high=2.0)] = 0.937
    """Pitch inertia of the prediction over srb.inertia: legs in swing count for less [-]."""
    velocity_time: Annotated[Positive, TIME] = 0.38
    """Time in which the velocity is predicted to reach its reference, for moment arms [s]."""
    height_time: Annotated[Positive, TIME] = 0.095
    """The same of height and pitch [s]."""
    linearise: Literal["forecast", "last_plan"] = "forecast"
    """What moment arms are taken from: a path with these times, as if it did not depend on the
    forces; or the last plan's roll-out, and how forces move body and footholds from it [-]."""
    tolerance: Positive = 1e-6
    """Relative residuals and gap at which the QP counts as solved [-]."""
    max_iterations: Count = 30
    """Iteration limit of the QP [-]."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class SpatialConfig:
    """LMPC in three dimensions, for controller = "spatial".

    Weights are per second of the horizon, of errors ahead, to the left and up.
    """

    model: Literal["momentum", "convex", "present", "edmd", "bilinear", "residual"] = "momentum"
    """What predicts: exact momentum about the last plan's roll-out; Di Carlo's convex model; the
    rigid body linearised where the robot is; EDMD on SO(3) observables, linear or bilinear; or the
    momentum with a residual from the whole robot's episodes [-]."""
    file: str = ""
    """Fitted residual (.npz), of `kjax study spatial_residual`; for model = "residual" [-]."""
    snapshots: Annotated[int, Field(ge=100)] = 4000
    """Steps that EDMD learns from, where the model is a learned one [-]."""
    training_seed: Annotated[int, Field(ge=0)] = 0
    """Of these [-]."""
    horizon: Positive = 0.25
    """Length of the prediction, at most a gait cycle [s]."""
    node_dt: Positive = 0.025
    """Longest node where two feet stand, longer in proportion where more do [s]."""
    attitude: Annotated[Three, COST] = (25.0, 20.0, 100.0)
    """Weights of the squared errors of roll, pitch and yaw [1/rad^2]."""
    position: Annotated[Three, COST, POSITION_COST] = (0.2, 0.2, 9.0)
    """Of the centre of mass's place [1/L^2]."""
    omega: Annotated[Three, COST, OMEGA_COST] = (1.0, 1.0, 1.0)
    """Of the angular velocity [L/g]."""
    velocity: Annotated[Three, COST, VELOCITY_COST] = (12.0, 4.0, 2.0)
    """Of the centre of mass's velocity [1/(g L)]."""
    force: Annotated[Positive, COST, INPUT_COST] = 0.2
    """Weight of every squared force's distance from the gait's mean force [1/(m g)^2]."""
    friction: Annotated[float, Field(ge=0.05)] = 0.6
    """mu of the friction cones, as pyramids of eight sides; below the ground's, for margin [-]."""
    torque_fraction: TorqueFraction = 0.95
    """Part of the joint torque limits that stance forces may take; inf: any [-]."""
    grf_z_min: Annotated[Bound, MIN_GRF, FORCE] = 0.04
    """Lower bound of F_z per leg [m g]."""
    grf_z_max: Annotated[Bound, GRF, FORCE] = 2.0
    """Upper bound of F_z per leg [m g]."""
    yaw_slew: Positive = 8.0
    """Largest rate at which the reference yaw rate follows the command [rad/s^2]."""
    velocity_slack: Positive = 0.5
    """Largest lead of the velocity's reference before the robot, ahead and to the left: after a
    push the way back is no faster [m/s]."""
    heading_slack: Positive = 0.3
    """Largest lead or lag of the heading's reference before the trunk [rad]."""
    integral_gains: Annotated[Three, RATE] = (1.0, 1.0, 0.5)
    """Rates at which the errors of velocity, ahead and to the left, and of the heading move their
    references; 0: not [1/s]."""
    integral_limits: Three = (0.4, 0.4, 0.3)
    """Largest corrections of these references [m/s, m/s, rad]."""
    velocity_time: Annotated[Positive, TIME] = 0.15
    """Time in which the velocity is predicted to reach its reference, for the next footholds
    [s]."""
    slope_time: Annotated[Positive, TIME] = 0.15
    """Time in which the ground's slope, a plane through the last footholds, is filtered [s]."""
    alignment: Annotated[float, Field(ge=0, le=1)] = 1.0
    """Part of the ground's slope that the trunk takes; 0: it stays level [-]."""
    lift: Annotated[NonNegative, LENGTH] = 0.14
    """Further height of the swings once a foot has hit something on its way up [L]."""
    tolerance: Positive = 1e-6
    """Relative residuals and gap at which the QP counts as solved [-]."""
    max_iterations: Count = 200
    """Iteration limit of the QP [-]."""

    @model_validator(mode="after")
    def _check_file(self) -> "SpatialConfig":
        if self.model == "residual" and not self.file:
            raise ValueError("file must name a fitted residual for model = 'residual', got ''")
        if self.file and self.model != "residual":
            raise ValueError(f"file: model = '{self.model}' takes no file, got '{self.file}'")
        return self


@dataclass(frozen=True, kw_only=True, config=STRICT)
class LegConfig:
    """Swing trajectory, footholds and joint control."""

    act_dt: Positive = 0.001
    """Time between two calls of act: control_dt is a multiple of it, it is one of sim_dt [s]."""
    hold_time: NonNegative = 0.02
    """How long the last torque holds when no valid sample comes [s]."""
    blind_kd: Annotated[NonNegative, DAMPING] = 0.18
    """Joint damping that takes its place after that [m g L sqrt(L/g)/rad]."""
    swing_height: Annotated[Positive, LENGTH] = 0.1408
    """Height of the swing's apex above the higher of lift-off and target [L]."""
    horizontal_fraction: Annotated[float, Field(gt=0, le=1)] = 0.9
    """Part of the swing after which the foot has arrived above its foothold [-]."""
    foothold_gain: Annotated[NonNegative, GAIN, DURATION] = 0.144
    """Raibert gain on the velocity error in the foothold [sqrt(L/g)]."""
    reach_speed: NonNegative = 1.0
    """Speed at which a foot feels for the ground when a change of gait has cut its swing short;
    0: its leg presses at once [m/s]."""
    hold_after: Annotated[float, Field(ge=0, le=1)] = 0.3
    """Part of the swing after which a contact is an obstacle and the foot is held [-]."""
    swing_kp: Annotated[NonNegative, STIFFNESS] = 2.817
    """Proportional gain of thigh and calf joint in swing [m g L/rad]."""
    swing_kd: Annotated[NonNegative, DAMPING] = 0.2703
    """Derivative gain of thigh and calf joint in swing [m g L sqrt(L/g)/rad]."""
    abduction_kp: Annotated[NonNegative, STIFFNESS] = 3.755
    """Proportional gain of the abduction joint: in swing, or always on the planar base
    [m g L/rad]."""
    abduction_kd: Annotated[NonNegative, DAMPING] = 0.3604
    """Its derivative gain, likewise [m g L sqrt(L/g)/rad]."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class LateralConfig:
    """Regulator of roll, yaw and sideways motion; for sim.base = "free" only."""

    roll_kp: Annotated[NonNegative, STIFFNESS] = 1.127
    """Roll moment per roll [m g L/rad]."""
    roll_kd: Annotated[NonNegative, DAMPING] = 0.3604
    """Roll moment per roll rate [m g L sqrt(L/g)/rad]."""
    yaw_kp: Annotated[NonNegative, STIFFNESS] = 0.3755
    """Yaw moment per yaw away from the heading at the start [m g L/rad]."""
    yaw_kd: Annotated[NonNegative, DAMPING] = 0.2703
    """Yaw moment per yaw rate [m g L sqrt(L/g)/rad]."""
    sideways_kd: Annotated[NonNegative, LINEAR_DAMPING] = 0.4906
    """Sideways force per sideways velocity of the centre of mass [m g/sqrt(g L)]."""
    wrench_cost: Annotated[Six, WRENCH_COST] = (1.0, 0.3, 1.0, 3.63, 3.63, 1.815)
    """Relative weights of the squared errors of the wrench (force x, y, z, moment x, y, z over L)
    [-]."""
    force_weight: Positive = 1e-3
    """Weight of a squared change of the planned foot forces beside them [-]."""
    friction: NonNegative = 0.6
    """Horizontal over vertical force of a foot, at most; the LMPC's own where that is less [-]."""
    foothold_gain: Annotated[NonNegative, GAIN, DURATION] = 0.24
    """Sideways foothold per sideways velocity, beyond Raibert's law [sqrt(L/g)]."""
