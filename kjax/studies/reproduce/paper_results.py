"""What is reproduced, as data: experiments, the figures that the paper publishes, our targets.

To add an experiment, add an ``Experiment``: its config file, what changes between its episodes,
and one ``Row`` per number to show.
"""

import dataclasses
import itertools
from dataclasses import dataclass
from typing import Any, Literal

from kjax.config import RunConfig, load_config
from kjax.config.shipped import shipped_config
from kjax.controllers.walkable import build_gaits
from kjax.gait import Gait


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line of the table.

    Attributes:
      metric: key of ``kjax.sim.metrics.metrics``, or ``falls`` (number) or ``crossed`` (share).
      label: what is shown, with its unit.
      paper: what the paper says of it.
      target: bound to meet: an upper one, for ``crossed`` a lower one.
      of: which of our results the target is for.
    """

    metric: str
    label: str
    paper: str = ""
    target: float | None = None
    of: Literal["median", "worst"] = "median"


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """A config, and the episodes that are run of it.

    Attributes:
      name: for ``--only``, files and JSON.
      title: for the table and the figures.
      config: file in configs/.
      overrides: of its keys.
      vary: what changes from episode to episode besides the noise: nothing, the terrain, or the
        time of the last gait request: spread evenly over a cycle of the gait before it, or over the
        middles of its next two stances in turn.
      figure: kind of figure; those of kind ``switch`` share one.
      rows: of the table.
    """

    name: str
    title: str
    config: str
    overrides: dict[str, Any] = dataclasses.field(default_factory=dict)
    vary: Literal["noise", "terrain", "request", "stance"] = "noise"
    figure: Literal["tracking", "terrain", "switch"] = "tracking"
    rows: tuple[Row, ...]


RMSE, PITCH, KNEE = "velocity_rmse_mps", "pitch_p95_deg", "knee_saturation_fraction"
FIT = "koopman_fit"  # name of the study of Fig. 3 among the experiments
ACCELERATION = 4.0  # m/s^2, of the floor of the tracking error, beside mu g
# What holding the torques over a control tick costs, beside fields crossed: metric and label.
HELD = (
    (RMSE, "RMSE against the raw step, more by holding [m/s]"),
    ("field_pitch_p95_deg", "pitch in the field, 95 %, more by holding [deg]"),
)
_REPORTED = (
    Row(metric="foot_slip_m", label="foot slip per stance [m]"),
    Row(metric="torque_saturation_fraction", label="time with a saturated joint [-]"),
    Row(metric="body_contact_fraction", label="time with another body on the ground [-]"),
)
_REPORTED_ROUGH = _REPORTED[:2]  # the batch engine does not see which bodies touch the ground
_NO_FALL = Row(metric="falls", label="falls", target=0)

EXPERIMENTS = (
    Experiment(
        name="trot_velocity",
        title="trot steps, 6 x 1 ms",
        config="trot_velocity.toml",
        rows=(
            Row(metric=RMSE, label="RMSE of v_x [m/s]", paper="0.029", target=0.017),
            _NO_FALL,
            Row(metric=PITCH, label="pitch, 95 % [deg]", paper="small"),
            Row(metric="plan_ms_median", label="plan: lift, QP [ms]", paper="about 3 (QP)"),
            *_REPORTED,
        ),
    ),
    Experiment(
        name="trot_velocity_long",
        title="trot steps, 10 x 20 ms",
        config="trot_velocity_long.toml",
        rows=(
            Row(metric=RMSE, label="RMSE of v_x [m/s]"),
            _NO_FALL,
            Row(metric=PITCH, label="pitch, 95 % [deg]"),
            Row(metric="plan_ms_median", label="plan: lift, QP [ms]"),
            *_REPORTED,
        ),
    ),
    Experiment(
        name="bound_multiphase",
        title="bound steps, the paper's timing, horizon through flight",
        config="bound_multiphase.toml",
        rows=(
            Row(metric=RMSE, label="RMSE of v_x [m/s]", paper="0.189", target=0.075),
            Row(metric="falls", label="falls", paper="0 of 1", target=0),
            Row(metric=PITCH, label="pitch, 95 % [deg]", target=12.0),
            Row(metric=KNEE, label="time with a saturated knee [-]", target=0.01),
            Row(metric="pitch_max_deg", label="largest pitch [deg]"),
            Row(metric="plan_ms_median", label="plan: forecast, QP [ms]"),
            *_REPORTED,
        ),
    ),
    Experiment(
        name="bound_multiphase_short",
        title="bound steps, short flights, horizon through flight",
        config="bound_multiphase_short.toml",
        rows=(
            Row(metric=RMSE, label="RMSE of v_x [m/s]", target=0.06),
            _NO_FALL,
            Row(metric="height_error_mean_m", label="mean height error [m]", target=0.03),
            Row(metric="height_error_max_m", label="largest height error, its bounce in it [m]"),
            Row(metric=PITCH, label="pitch, 95 % [deg]"),
            *_REPORTED,
        ),
    ),
    Experiment(
        name="bound_velocity",
        title="bound steps, the paper's timing and in-stance horizon",
        config="bound_velocity.toml",
        rows=(
            Row(metric=RMSE, label="RMSE of v_x [m/s]", paper="0.189"),
            Row(metric="falls", label="falls", paper="0 of 1", target=0),
            Row(metric=PITCH, label="pitch, 95 % [deg]"),
            Row(metric=KNEE, label="time with a saturated knee [-]"),
            *_REPORTED,
        ),
    ),
    Experiment(
        name="bound_velocity_short",
        title="bound steps, short flights, in-stance horizon",
        config="bound_velocity_short.toml",
        rows=(
            Row(metric=RMSE, label="RMSE of v_x [m/s]"),
            _NO_FALL,
            Row(metric="height_error_mean_m", label="mean height error [m]"),
            Row(metric=PITCH, label="pitch, 95 % [deg]"),
            *_REPORTED,
        ),
    ),
    Experiment(
        name="trot_rough",
        title="rough trot, 0.3 m/s",
        config="trot_rough.toml",
        vary="terrain",
        figure="terrain",
        rows=(
            Row(metric="crossed", label="terrains crossed", paper="1 of 1", target=0.98),
            Row(
                metric="field_pitch_p95_deg",
                label="pitch in the field, 95 % [deg]",
                paper="3 but for two slips",
                target=3.0,
            ),
            Row(metric=RMSE, label="RMSE against the raw step [m/s]"),
            Row(metric="velocity_reference_rmse_mps", label="RMSE, slewed reference [m/s]"),
            Row(metric="velocity_late_rmse_mps", label="RMSE from 2 s after the step [m/s]"),
            *_REPORTED_ROUGH,
        ),
    ),
    Experiment(
        name="bound_rough",
        title="rough bound, 0.75 m/s, the paper's timing",
        config="bound_rough.toml",
        vary="terrain",
        figure="terrain",
        rows=(
            Row(metric="crossed", label="terrains crossed", paper="1 of 1", target=0.97),
            Row(metric=RMSE, label="RMSE against the raw step [m/s]", target=0.09),
            Row(
                metric="velocity_reference_rmse_mps",
                label="RMSE, slewed reference [m/s]",
                target=0.09,
            ),
            Row(metric="velocity_late_rmse_mps", label="RMSE from 2 s after the step [m/s]"),
            Row(metric="field_pitch_p95_deg", label="pitch in the field, 95 % [deg]"),
            *_REPORTED_ROUGH,
        ),
    ),
    Experiment(
        name="trot_to_bound",
        title="trot to bound",
        config="trot_to_bound.toml",
        vary="request",
        figure="switch",
        rows=(
            Row(metric="falls", label="falls", paper="0 of 1", target=0),
            Row(metric="switch_pitch_max_deg", label="largest pitch after the switch [deg]"),
            Row(
                metric="pitch_settle_s",
                label="pitch settled after [s]",
                target=1.5,
                of="worst",
            ),
            *_REPORTED,
        ),
    ),
    Experiment(
        name="bound_to_trot",
        title="bound to trot in flight",
        config="bound_to_trot.toml",
        vary="request",
        figure="switch",
        rows=(
            Row(metric="falls", label="falls", paper="0 of 1", target=0),
            Row(
                metric="switch_pitch_max_deg",
                label="largest pitch after the switch [deg]",
                paper="smooth",
                target=8.0,
                of="worst",
            ),
            Row(
                metric="pitch_settle_s",
                label="pitch settled after [s]",
                target=0.5,
                of="worst",
            ),
            *_REPORTED,
        ),
    ),
    Experiment(
        name="bound_to_trot_naive",
        title="bound to trot in mid-stance (control)",
        config="bound_to_trot.toml",
        overrides={"gaits.bound_multiphase.switch_rule": "anywhere"},
        vary="stance",
        figure="switch",
        rows=(
            Row(metric="falls", label="falls", paper="disturbs"),
            Row(metric="switch_pitch_max_deg", label="largest pitch after the switch [deg]"),
            Row(metric="pitch_settle_s", label="pitch settled after [s]"),
            *_REPORTED,
        ),
    ),
)


def base_config(experiment: Experiment, base: str, *, quick: bool) -> RunConfig:
    """Config of an experiment on a base; ``quick`` keeps its first second and a half.

    Raises:
      ConfigError: where the config does not allow the overrides.
    """
    overrides = {"sim.base": base} | experiment.overrides
    config = load_config(RunConfig, shipped_config(experiment.config), overrides)
    if not quick:
        return config
    last = len(config.gait.times) - 1
    times = tuple(0.5 * (i + 1) / last if i else 0.0 for i in range(last + 1))
    return dataclasses.replace(
        config, duration=1.5, gait=dataclasses.replace(config.gait, times=times)
    )


def episodes(
    experiment: Experiment, config: RunConfig, *, seeds: int, terrains: int
) -> list[RunConfig]:
    """The episodes of an experiment: noise seeds 0 to n - 1, and what varies besides."""
    if experiment.vary == "terrain":
        return [
            dataclasses.replace(config, seed=i, terrain=dataclasses.replace(config.terrain, seed=i))
            for i in range(terrains)
        ]
    if experiment.vary == "noise":
        return [dataclasses.replace(config, seed=i) for i in range(seeds)]
    *before, last = config.gait.times
    left = _gait(config, config.gait.names[-2])
    if experiment.vary == "request":
        wanted = [last + cycle(config, left.name) * i / seeds for i in range(seeds)]
    else:
        wanted = mid_stances(left, config.gait.times[-2], last, seeds)
    return [
        dataclasses.replace(
            config, seed=i, gait=dataclasses.replace(config.gait, times=(*before, time))
        )
        for i, time in enumerate(wanted)
    ]


def mid_stances(gait: Gait, begin: float, after: float, count: int) -> list[float]:
    """Times in the middle half of the gait's next two stances after a time, in turn [s].

    Args:
      gait: entered at ``begin``; its flights grow as ``kjax.gait`` has it.
      begin: [s].
      after: [s].
      count: number of times.
    """
    stances: list[tuple[float, float]] = []
    time = begin
    for cycle in itertools.count():
        for phase, duration in zip(gait.phases, gait.durations(cycle), strict=True):
            if any(phase.stance) and time >= after:
                stances.append((time, duration))
            time += duration
        if len(stances) >= 2:
            break
    return [
        start + duration * (0.25 + 0.5 * i / count)
        for i in range(count)
        for start, duration in [stances[i % 2]]
    ]


def cycle(config: RunConfig, name: str) -> float:
    """Length of a gait's cycle at full flight length [s]."""
    return float(sum(phase.duration for phase in _gait(config, name).phases))


def _gait(config: RunConfig, name: str) -> Gait:
    (gait,) = (gait for gait in build_gaits(config) if gait.name == name)
    return gait
