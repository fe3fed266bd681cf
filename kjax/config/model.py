"""The prediction: rigid body, training data, Koopman models."""

from typing import Annotated, Literal

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from kjax.config.checks import STRICT, Count, NonNegative, Positive, Tunable


@dataclass(frozen=True, kw_only=True, config=STRICT)
class SrbConfig:
    """Single rigid body that the models are fitted to; what is left out is the robot's own."""

    mass: Annotated[Positive | None, Tunable(low=1.0, high=100.0)] = None
    """Mass of the body; the robot's if left out [kg]."""
    inertia: Annotated[Positive | None, Tunable(low=0.01, high=10.0)] = None
    """Pitch inertia about the centre of mass; the whole robot's in its stance if left out
    [kg m^2]."""
    feet_front: tuple[float, float] | None = None
    """Front contact point (x, z) relative to the centre of mass, body frame; the sole in the
    nominal stance if left out [m]."""
    feet_rear: tuple[float, float] | None = None
    """Rear contact point (x, z), likewise [m]."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
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


@dataclass(frozen=True, kw_only=True, config=STRICT)
class KoopmanConfig:
    """EDMD models, one per contact mode."""

    model: str = "linear"
    """Kind of prediction model: linear (the paper), srb_hover, srb, planted, exact, bilinear,
    residual, learned, or "module:NAME" for a kjax.prediction.kind.ModelKind of one's own. All but
    the first two are linearised at every tick where the robot is [-]."""
    file: str = ""
    """Fitted model (.npz): of whole_body.py for residual, of learn_control.py for learned [-]."""
    dictionary: Literal["paper", "paper_literal", "monomials", "fourier"] = "paper"
    """The paper's dictionary without its duplicate columns, or letter by letter; or products of
    states; or random Fourier features [-]."""
    order: Annotated[int, Field(ge=0, le=8)] = 4
    """Highest power p of the pitch rate in the paper's dictionary, or highest degree of the
    monomials [-]."""
    fourier_count: Count = 20
    """Number of random Fourier features [-]."""
    fourier_scale: Positive = 1.0
    """Their spread of frequencies, for states of a walking robot's size [-]."""
    fourier_seed: int = 0
    """Seed of their draw [-]."""
    constant_rotation: bool = False
    """Whether to add R itself (the k = 0 term), which the paper leaves out [-]."""
    feet: Literal["fixed", "measured"] = "fixed"
    """Contact points of the model: constant per mode (the paper) or the robot's own [-]."""
    dataset: DatasetConfig = DatasetConfig()
    """Training data."""
