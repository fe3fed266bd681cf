"""The world: terrain, pushes, noise, physics."""

from typing import Annotated, Literal

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from kjax.config.checks import STRICT, Count, NonNegative, Positive


@dataclass(frozen=True, kw_only=True, config=STRICT)
class TerrainConfig:
    """Obstacles on the way."""

    kind: Literal[
        "flat", "paper", "blocks", "steps", "slope", "cross_slope", "tiles", "patches"
    ] = "flat"
    """None; the paper's blocks, cubes and capsules; or one of ours [-]."""
    seed: int = 0
    """Seed of the field; independent of the noise's [-]."""
    count: Count = 8
    """Number of obstacles, steps, patches, or tiles along the way [-]."""
    start: Positive = 0.8
    """Where the field begins, measured from the robot's start [m]."""
    end: Positive = 2.6
    """Its far end [m]."""
    height_min: Positive = 0.05
    """Lowest obstacle or tile, or rise of a step [m]."""
    height_max: Positive = 0.07
    """Highest obstacle or tile, or rise of a step [m]."""
    width: Positive = 0.8
    """Width of what reaches across both tracks [m]."""
    slope: Annotated[float, Field(gt=-45, lt=45)] = 8.0
    """Inclination of a slope; below 0 it leads down first, from a platform and up to another. Of
    one across the way, rising to the left, or to the right below 0 [deg]."""
    patch_friction: Positive = 0.3
    """Friction of a foot on a patch [-]."""

    @model_validator(mode="after")
    def _check(self) -> "TerrainConfig":
        if self.slope == 0.0:
            raise ValueError("slope must not be 0 deg; kind = 'flat' is level ground")
        for low, high in (("start", "end"), ("height_min", "height_max")):
            if not getattr(self, low) <= getattr(self, high):
                raise ValueError(
                    f"{low} must not exceed {high}, got {getattr(self, low)} and "
                    f"{getattr(self, high)}"
                )
        return self


@dataclass(frozen=True, kw_only=True, config=STRICT)
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


@dataclass(frozen=True, kw_only=True, config=STRICT)
class NoiseConfig:
    """Sensor noise (white, each physics step), initial spread, random forces; 1 sigma each."""

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
    force: NonNegative = 0.0
    """Forces of the standing legs, drawn anew at every control tick [N]."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class SimConfig:
    """Physics."""

    sim_dt: Positive = 0.001
    """Physics step; leg.act_dt is a multiple of it [s]."""
    base: Literal["free", "planar"] = "free"
    """A free trunk, or one on two slides and a pitch hinge (the paper); the controller is built for
    either [-]."""
    start: tuple[float, float] = (0.0, 0.0)
    """Where the robot starts and the terrain is measured from, world (x, y); x only on the planar
    base [m]."""
    heading: float = 0.0
    """Heading at the start, about which the terrain is turned too; the free base only [rad]."""
    floor: float = 0.0
    """Height of the floor [m]."""
    friction: Positive = 0.8
    """Sliding friction coefficient of the feet [-]."""
    cone: Literal["pyramidal", "elliptic"] = "pyramidal"
    """Friction cone of the contact solver; MJX wants the pyramid [-]."""
    contacts: Literal["all", "feet"] = "all"
    """Which of the robot's bodies touch the ground: all, or the feet only (faster) [-]."""
    joint_damping: NonNegative | None = None
    """Viscous damping of all joints; where not given, the robot's own (Go1: 0.1) [N m s/rad]."""
    joint_armature: NonNegative | None = None
    """Reflected rotor inertia of all joints; likewise (Go1: 0.01) [kg m^2]."""
    payload: NonNegative = 0.0
    """Mass on the trunk, at its centre of mass, that the controller knows nothing of [kg]."""
    delay: NonNegative = 0.0
    """Time from a torque's computation to its effect, a multiple of sim_dt [s]."""
    contact_threshold: NonNegative = 5.0
    """Foot force above which the contact sensor fires [N]."""
