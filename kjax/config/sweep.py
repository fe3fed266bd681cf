"""A sweep: closed loops over a grid or a random sample of configs."""

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from kjax.config.checks import STRICT, Count


@dataclass(frozen=True, kw_only=True, config=STRICT)
class AxisConfig:
    """One quantity that a sweep varies: a list of values, or a range."""

    values: tuple[Any, ...] = ()
    """The values, numeric or words; of a grid [-]."""
    low: float | None = None
    """Lower end of a range; of a grid or of a sample [-]."""
    high: float | None = None
    """Upper end of the range [-]."""
    count: Count | None = None
    """Number of values in the range, ends included; of a grid [-]."""
    unit: str = "-"
    """Unit, for the record and the figure [-]."""
    label: str = ""
    """What the figure calls it; the axis' name by default [-]."""

    @model_validator(mode="after")
    def _check(self) -> "AxisConfig":
        has_range = self.low is not None and self.high is not None
        if bool(self.values) == has_range or (self.low is None) != (self.high is None):
            raise ValueError("give either values, or low and high")
        if has_range and not self.low < self.high:  # type: ignore[operator]
            raise ValueError(f"low must be below high, got {self.low} and {self.high}")
        if self.values and self.count is not None:
            raise ValueError("count belongs to low and high, not to values")
        return self


@dataclass(frozen=True, kw_only=True, config=STRICT)
class FigureConfig:
    """A sweep's figure: a heat map over two axes, or curves over one; one panel for each metric."""

    metrics: tuple[str, ...] = ("success", "velocity_rmse_mps")
    """What to show: metrics, or 'success', the part of episodes without a fall that got across
    where there is a field [-]."""
    x: str = ""
    """Axis along x; the last one by default [-]."""
    y: str = ""
    """Axis along y of a heat map; the one before it by default, none for curves [-]."""
    panels: str = ""
    """Axis whose values get a row of panels each [-]."""
    title: str = ""
    """Title [-]."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class SweepConfig:
    """A sweep over configs: ``axes`` name what varies, ``set`` says what becomes of it."""

    base: str
    """Shipped config of a closed loop by its name, or a TOML file seen from the sweep's own [-]."""
    axes: Annotated[dict[str, AxisConfig], Field(min_length=1)]
    """What varies: name and values; the order is that of the dimensions [-]."""
    set: dict[str, Any] = Field(default_factory=dict)
    """Config keys and their values; text that begins with '=' is an expression of the axes [-]."""
    sample: Annotated[int, Field(ge=0)] = 0
    """Number of points drawn at random from the axes' ranges; 0 for the grid of all values [-]."""
    sample_seed: int = 0
    """Seed of that draw [-]."""
    seeds: Count = 1
    """Episodes per point, each with another seed of noise and of terrain [-]."""
    first_seed: int = 0
    """The first of them [-]."""
    engine: str = "mujoco_batch"
    """Batches on C MuJoCo, the faster on a CPU; mjx; mujoco (one robot at a time); or "module:NAME"
    for one of one's own [-]."""
    torques: Literal["every_step", "held"] = "held"
    """Torques at every physics step, or held over a control tick, which is cheaper [-]."""
    precision: Literal["float32", "float64"] = "float32"
    """Floating type of the controller, and of MJX's physics [-]."""
    chunk: Count = 256
    """Robots that walk together, and are kept together [-]."""
    figure: FigureConfig | None = None
    """What to draw; nothing if left out [-]."""

    @model_validator(mode="after")
    def _check(self) -> "SweepConfig":
        for name, axis in self.axes.items():
            if not name.isidentifier() or name == "seed":
                raise ValueError(f"axes.{name}: wanted a name of letters, digits and _, not 'seed'")
            if self.sample and axis.values:
                raise ValueError(f"axes.{name}: a sample needs low and high, not values")
            if not self.sample and not axis.values and axis.count is None:
                raise ValueError(f"axes.{name}: a grid needs a count with low and high")
        return self
