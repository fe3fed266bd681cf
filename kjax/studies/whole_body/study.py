"""Learn what a rigid body misses of the whole robot, from its own closed-loop episodes.

Records trots and bounds of the whole Go1 in C MuJoCo with perturbed forces (flat, pushed, rough),
fits a residual on the planted rigid body in each contact mode, and tests it on held-out episodes:
open-loop predictions of 25 and 50 ms under the recorded forces, inside a stance and over all start
points. Half of the episodes are fitted on, a fifth chooses between fits, and 30 % report.

Leaves metrics.json (ratios), table.md (every model that an LMPC can predict with), details.json,
figure.png and, for each gait, residual_<gait>.npz and
residual_<gait>_clock_history.npz (the affine residual and the one that knows the gait's phase
and the last force, for koopman.model = "residual" with koopman.dataset.dt = 0.005) and
weights_<gait>.npz (all models). The recordings stay there as well and are used again, but for
those of other configs or other code.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kjax import cli
from kjax.dynamics import srb_planar
from kjax.options import Options, parse, require
from kjax.prediction import storage
from kjax.prediction.features import (
    Features,
    affine,
    clock,
    clock_history,
    history,
    touchdown,
)
from kjax.robots import get_robot
from kjax.studies.whole_body import report
from kjax.studies.whole_body.errors import (
    HORIZONS,
    Curves,
    at_end,
    compare,
    errors_of,
    nominal_body,
    predicted_errors,
)
from kjax.studies.whole_body.recordings import DT, kept, record
from kjax.sysid import open_loop, whole_body
from kjax.sysid.transitions import Episode, Transitions, split, transitions
from kjax.types import Mode

HELD_OUT, TUNE = 0.3, 0.2 / 0.7  # of all episodes, of those left
STEPS = (1, 5, 10)  # ticks that a row of the fit sums over, to choose from

GAITS = {"trot": ("trot", "trot_rough"), "bound": ("bound", "bound_rough")}
MODELS: dict[str, Features] = {
    "affine": affine,
    "history": history,
    "clock": clock,
    "clock_history": clock_history,
    "touchdown": touchdown(DT),
}
KEPT = ("affine", "clock_history")  # for koopman.file


def main(argv: Sequence[str] | None = None) -> int:
    """Parse the command line, then record, fit and test; exit code 0 if all was done."""
    args = _parse(argv)
    cli.configure_jax()
    folder = cli.output_folder(args, "whole_body")
    for kinds in GAITS.values():
        for kind in kinds[:1] if args.quick else kinds:
            kept(kind, args, folder)  # before the first study begins
    metrics: dict[str, Any] = {}
    curves: dict[str, Curves] = {}
    families: dict[str, Any] = {}
    for gait, kinds in GAITS.items():
        used = kinds[:1] if args.quick else kinds
        try:
            recordings = {kind: record(kind, args, folder) for kind in used}
            metrics[gait], curves[gait], fits, held = study(gait, recordings, args.quick)
        except KeyboardInterrupt:
            print(f"stopped; finished recordings are kept in {folder}/, run again to go on")
            return 130
        _save_models(gait, fits, folder)
        families[gait] = compare(gait, held, folder, args.quick)
    cli.save_json(folder / "details.json", metrics)
    cli.save_study(
        folder,
        _summary(args, metrics, families),
        report.table(families),
        lambda path: report.save_figure(curves, DT, path),
    )
    return 0


@dataclass(kw_only=True)
class WholeBodyOptions(Options):
    """Options of the study."""

    robots: int = 64
    """Episodes of each kind."""

    duration: float = 8.0
    """Of an episode [s]."""

    force: float = 15.0
    """noise.force [N]."""

    quick: bool = False
    """10 robots, 3 s, flat ground, fewer models: to check the script."""


def _parse(argv: Sequence[str] | None) -> WholeBodyOptions:
    args = parse(WholeBodyOptions, argv, __doc__.splitlines()[0])
    if args.quick:
        args.robots, args.duration = 10, 3.0
    require(args, "robots", least=10)
    require(args, "duration", least=3)
    require(args, "force", above=0)
    return args


def _save_models(gait: str, fits: dict[str, whole_body.Fit], folder: Path) -> None:
    """Write the residuals for ``koopman.file``, and the weights of all."""
    for name in KEPT:
        fit, suffix = fits[name], "" if name == "affine" else f"_{name}"
        storage.save(
            folder / f"residual_{gait}{suffix}.npz",
            storage.Stored("residual", DT, fit.W, np.nan_to_num(fit.after), name),
        )
    weights: dict[str, Any] = {name: fit.W for name, fit in fits.items()}
    np.savez(folder / f"weights_{gait}.npz", dt=DT, **weights)


def _summary(
    args: WholeBodyOptions, metrics: dict[str, Any], families: dict[str, Any]
) -> dict[str, Any]:
    """What metrics.json holds."""
    chosen = metrics["trot"]["chosen_inside"]
    trot = {name: metrics["trot"]["inside"][name]["50ms"]["all"] for name in (chosen, "affine")}
    return {
        "residual_model": chosen,
        "residual_velocity_ratio_50ms": trot[chosen]["velocity"]["ratio"],
        "residual_pitch_rate_ratio_50ms": trot[chosen]["omega"]["ratio"],
        "affine_residual_velocity_ratio_50ms": trot["affine"]["velocity"]["ratio"],
        "affine_residual_pitch_rate_ratio_50ms": trot["affine"]["omega"]["ratio"],
        "robots_per_kind": args.robots,
        "duration_s": args.duration,
        "force_noise_n": args.force,
        **{gait: report.compact(entry) for gait, entry in metrics.items()},
        "families": families,
    }


def study(
    gait: str, recordings: dict[str, list[Episode]], quick: bool
) -> tuple[dict[str, Any], Curves, dict[str, whole_body.Fit], Transitions]:
    """Fit and test the models of a gait.

    Returns:
      Metrics; error curves over time; the fits; transitions of the episodes held out.
    """
    body = nominal_body()
    subset: dict[int, str] = {}
    episodes: list[Episode] = []
    for kind, those in recordings.items():
        for episode in those:
            flat = "pushed" if episode.disturbed.any() else "flat"
            subset[len(subset)] = "rough" if kind.endswith("rough") else flat
            episodes.append(episode)
    rest, told = split(np.arange(len(episodes)), share=HELD_OUT)
    train, tune = split(rest, share=TUNE, seed=1)
    data = transitions(episodes, dt=DT, sole=float(get_robot().params.foot_radius))
    fitted, tuned, held = (data.rows(np.isin(data.episode, own)) for own in (train, tune, told))
    print(f"{gait}: {len(train)}, {len(tune)} and {len(told)} episodes to fit, choose and "
          f"report, {len(fitted.x)} rows to fit", flush=True)  # fmt: skip
    landing = open_loop.fit_landing(fitted)
    out: dict[str, Any] = {
        "episodes": {"fit": train, "choose": tune, "report": told},
        "fit": {},
        "inside": {},
        "all_starts": {},
    }
    fits: dict[str, whole_body.Fit] = {}
    scores: dict[str, float] = {}
    chosen = {n: f for n, f in MODELS.items() if n in ("touchdown", *KEPT) or not quick}
    for name, features in chosen.items():
        everywhere = name == "touchdown"
        fits[name], steps, score = _choose(
            fitted, tuned, body, features, landing if everywhere else None, everywhere
        )
        if not everywhere:
            scores[name] = score
        gains = whole_body.force_gains(fits[name], fitted, body, dt=DT, features=features)
        out["fit"][name] = {"steps": steps, **_fit_report(fits[name], gains)}
    out["chosen_inside"] = min(scores, key=scores.__getitem__)
    curves: Curves = {}
    for where in ("inside", "all_starts"):
        models = {name: (fits[name], features) for name, features in chosen.items()}
        out[where], one = errors_of(where, held, subset, models, landing)
        curves |= one
        report.show(gait, where, out[where])
    return out, curves, fits, held


def _choose(
    fitted: Transitions,
    tuned: Transitions,
    body: srb_planar.SrbParams,
    features: Features,
    landing: open_loop.Landing | None,
    everywhere: bool,
) -> tuple[whole_body.Fit, int, float]:
    """The fit, of those over 1, 5 and 10 ticks, that predicts the tuning episodes best.

    Returns:
      The fit, its ticks, and its score: the product of the ratios of squared errors to the nominal
      at the longest horizon.
    """
    length = max(HORIZONS.values())
    views = open_loop.windows(tuned, length, inside=not everywhere, stride=3)
    calm = ~views.disturbed
    base = predicted_errors(views, body, None, None, landing)
    best: tuple[float, whole_body.Fit, int] | None = None
    for steps in STEPS:
        fit = whole_body.fit(
            fitted,
            body,
            dt=DT,
            features=features,
            rows=~fitted.disturbed if everywhere else None,
            steps=steps,
        )
        errors = predicted_errors(views, body, fit, features, landing)
        ratios = [at_end(errors[k], calm) / at_end(base[k], calm) for k in ("velocity", "omega")]
        score = ratios[0] * ratios[1]
        if best is None or score < best[0]:
            best = score, fit, steps
    assert best is not None
    return best[1], best[2], best[0]


def _fit_report(fit: whole_body.Fit, gains: np.ndarray) -> dict[str, Any]:
    """How well each contact mode's weights were determined."""
    return {
        mode.name.lower(): {
            "rows": fit.rows[mode],
            "rank": fit.rank[mode],
            "columns": fit.columns[mode],
            "condition": fit.condition[mode],
            "force_gain_x_z": gains[mode],
            "one_step_residual_rms_before": fit.before[mode],
            "one_step_residual_rms_after": fit.after[mode],
        }
        for mode in Mode
        if fit.rows[mode] > 0
    }
