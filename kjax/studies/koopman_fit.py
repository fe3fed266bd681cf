"""Fit the Koopman models of every contact mode and show how well they predict (Fig. 3).

Prints mean, variance, standard deviation and largest absolute error of each state after the test
rollout, and, in a scan of the sampling ranges, the largest range for which each statistic stays
within the tolerance. Leaves metrics.json, config.toml and figure.png in the output folder.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from kjax import cli
from kjax.config import FitStudyConfig
from kjax.controllers.resolve_model import koopman_keys, model_choice
from kjax.controllers.rigid_body import own_body
from kjax.koopman.dataset import SampleRanges, sample_ranges, shrink
from kjax.koopman.edmd import build_dictionary, fit_modes, srb_params
from kjax.options import ConfigName, Options, fail, parse_config
from kjax.prediction.evaluation import ErrorStatistics, prediction_errors, summarise
from kjax.robots import get_robot
from kjax.types import MODE_ALPHA, STATE_NAMES, STATE_UNITS, Mode

MODES = {"trot": Mode.TROT, "front": Mode.FRONT, "rear": Mode.REAR}
STATISTICS = ErrorStatistics._fields


@dataclass(kw_only=True)
class FitOptions(Options):
    """Options of the study."""

    config_type = FitStudyConfig

    config: ConfigName = None
    """A shipped config's name, such as koopman_fit, or a TOML file; the defaults without it."""


def main(argv: Sequence[str] | None = None) -> int:
    """Parse the command line and run the study."""
    config, args = parse_config(FitOptions, argv, __doc__.splitlines()[0])
    cli.configure_jax()
    folder = cli.output_folder(args, "koopman_fit")
    try:
        with koopman_keys():
            result, curves = fit_study(config)
    except ValueError as error:
        fail(str(error))
    _print(config, result)

    save_figure(config, curves, folder / "figure.png")
    cli.save_json(folder / "metrics.json", result)
    cli.save_config(folder / "config.toml", config)
    print(f"\nresults in {folder}/")
    return 0


def fit_study(config: FitStudyConfig) -> tuple[dict[str, Any], dict[str, Any]]:
    """Fit on the config's ranges and test; then again on each of its smaller ranges.

    In one piece of 65 lines, since what is compiled closes over what is set up before it.

    Returns:
      ``fit`` per mode, ``error_at_end`` per mode, statistic and state, and
      ``largest_scale_within_tolerance`` per mode and statistic; and per mode the statistics over
      time, each (steps, 6).

    Raises:
      ValueError: if the fit is not finite.
    """
    choice = model_choice(config.koopman)
    data = choice.dataset
    dictionary, body = (
        build_dictionary(choice.dictionary),
        srb_params(own_body(config.srb, get_robot(config.robot).params)),
    )
    steps = round(config.test_duration / data.dt)
    chosen = jnp.asarray(list(MODES.values()))

    @jax.jit
    def study(key: jax.Array, scale: jax.Array) -> tuple[Any, ErrorStatistics]:
        """Fit and test on ranges shrunk by ``scale``."""
        ranges = shrink(sample_ranges(data, vary_feet=choice.measured_feet), scale)
        model, report = fit_modes(
            body,
            key,
            dictionary=choice.dictionary,
            dataset=data,
            measured_feet=choice.measured_feet,
            ranges=ranges,
        )

        def test(mode: jax.Array, alpha: jax.Array) -> ErrorStatistics:
            here = jax.tree.map(lambda leaf: leaf[mode], body)
            still: SampleRanges = ranges._replace(feet_half=jnp.zeros(2))
            return summarise(
                prediction_errors(
                    jax.random.fold_in(jax.random.key(config.test_seed), mode),
                    jax.tree.map(lambda leaf: leaf[mode], model),
                    dictionary,
                    here,
                    alpha,
                    still,
                    states=config.test_states,
                    profiles=config.test_profiles,
                    steps=steps,
                    dt=data.dt,
                    hold=data.hold,
                )
            )

        return report, jax.vmap(test)(chosen, jnp.asarray(MODE_ALPHA, float)[chosen])

    key = jax.random.key(config.koopman.dataset.seed)
    report, statistics = jax.device_get(study(key, jnp.asarray(1.0)))
    if not report.finite.all():
        raise ValueError("dataset: the fit is not finite, check its ranges and srb")
    result: dict[str, Any] = {"fit": {}, "error_at_end": {}, "largest_scale_within_tolerance": {}}
    for mode in MODES.values():
        result["fit"][mode.name.lower()] = {
            "rank": int(report.rank[mode]),
            "columns": int(report.columns[mode]),
            "condition": float(report.condition[mode]),
            "condition_full": float(report.condition_full[mode]),
            "one_step_residual_rms": report.residual_rms[mode],
        }
    curves = {
        name: {key: getattr(statistics, key)[i] for key in STATISTICS}
        for i, name in enumerate(MODES)
    }
    scan = {s: jax.device_get(study(key, jnp.asarray(s)))[1] for s in sorted(config.scales)}
    for i, (name, here) in enumerate(curves.items()):
        result["error_at_end"][name] = {
            key: dict(zip(STATE_NAMES, values[-1], strict=True)) for key, values in here.items()
        }
        result["largest_scale_within_tolerance"][name] = {
            key: _largest_scale(scan, key, i, config.tolerance) for key in STATISTICS
        }
    return result, curves


def save_figure(config: FitStudyConfig, curves: dict[str, Any], path: Path) -> None:
    """Draw the statistics over time that ``fit_study`` returned."""
    from kjax.viz.plots import fit_figure

    steps = len(next(iter(curves.values()))["mean"])
    time = config.koopman.dataset.dt * np.arange(1, steps + 1)
    fit_figure(curves, time, path, STATE_NAMES)


def _print(config: FitStudyConfig, result: dict[str, Any]) -> None:
    koopman = config.koopman
    size = build_dictionary(model_choice(koopman).dictionary).size
    print(f"dictionary '{koopman.dictionary}', p = {koopman.order}: {size} observables")
    for name, fit in result["fit"].items():
        print(
            f"  {name:6} rank {fit['rank']} of {fit['columns']}, condition of the "
            f"scaled regressor {fit['condition']:.1e} (all columns: {fit['condition_full']:.1e})"
        )
    print(f"\nprediction error after {1e3 * config.test_duration:g} ms, "
          f"{config.test_states} x {config.test_profiles} rollouts")  # fmt: skip
    for name, here in result["error_at_end"].items():
        print(f"  {name:10}" + "".join(f"{key:>12}" for key in STATISTICS))
        for label, unit in zip(STATE_NAMES, STATE_UNITS, strict=True):
            values = "".join(f"{here[key][label]:12.1e}" for key in STATISTICS)
            print(f"    {label:5} {unit:6}{values[2:]}")
    print(f"\nlargest fraction of those ranges for which the statistic stays within "
          f"{config.tolerance:g} in all six states")  # fmt: skip
    print("  " + " " * 10 + "".join(f"{key:>12}" for key in STATISTICS))
    for name, best in result["largest_scale_within_tolerance"].items():
        shown = "".join(f"{'none' if v is None else format(v, 'g'):>12}" for v in best.values())
        print(f"  {name:10}{shown}")


def _largest_scale(
    scan: dict[float, ErrorStatistics], key: str, mode: int, tolerance: float
) -> float | None:
    """Largest scale up to which the statistic holds at every smaller scale as well."""
    best = None
    for scale, statistics in scan.items():
        if np.abs(getattr(statistics, key)[mode]).max() > tolerance:
            break
        best = scale
    return best
