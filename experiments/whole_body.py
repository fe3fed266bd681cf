"""Learn what a rigid body misses of the whole robot, from its own closed-loop episodes.

Records trots and bounds of the whole Go1 in C MuJoCo with perturbed forces (flat, pushed, rough),
fits a residual on the planted rigid body in each contact mode, and tests it on held-out episodes:
open-loop predictions of 25 and 50 ms under the recorded forces, inside a stance and over all start
points. Half of the episodes are fitted on, a fifth chooses between fits, and 30 % report.

Leaves metrics.json (ratios), table.md (every model that an LMPC can predict with), details.json,
figure.png and, for each gait, residual_<gait>.npz and
residual_<gait>_clock_history.npz (the affine residual and the one that knows the gait's phase
and the last force, for koopman.model = "residual" with koopman.dataset.dt = 0.005) and
weights_<gait>.npz (all models). The recordings stay there as well and are used again; a folder
with those of other configs or other code is refused.
"""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import whole_body_report as report
from prediction_models import MODELS as MODEL_KEYS
from prediction_models import residual
from whole_body_recordings import CONFIGS, DT, KINDS, kept, record

from kjax import cli
from kjax.config import Gaits, RunConfig, SrbConfig, load_config
from kjax.controllers.resolve import fit_models
from kjax.controllers.resolve_model import resolve_model
from kjax.controllers.rigid_body import own_body
from kjax.controllers.walkable import build_gaits, contact_problems
from kjax.dynamics import srb_planar
from kjax.prediction import storage
from kjax.prediction.build import build_family
from kjax.prediction.features import (
    Features,
    affine,
    clock,
    clock_history,
    history,
    touchdown,
)
from kjax.robots import get_robot
from kjax.sysid import open_loop, whole_body
from kjax.sysid.transitions import Episode, Transitions, split, transitions
from kjax.types import Mode

HORIZONS = {"25ms": 5, "50ms": 10}  # ticks
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


def main() -> None:
    """Parse the command line, then record, fit and test."""
    parser = cli.script_parser(__doc__.splitlines()[0])
    parser.add_argument("--robots", type=int, default=64, help="episodes of each kind")
    parser.add_argument("--duration", type=float, default=8.0, help="of an episode [s]")
    parser.add_argument("--force", type=float, default=15.0, help="noise.force [N]")
    parser.add_argument(
        "--quick", action="store_true", help="10 robots, 3 s, flat ground, fewer models"
    )
    args = parser.parse_args()
    if args.quick:
        args.robots, args.duration = 10, 3.0
    if args.robots < 10:
        cli.fail(f"--robots: got {args.robots}, wanted at least 10")
    if not args.duration >= 3.0:
        cli.fail(f"--duration: got {args.duration} s, wanted at least 3 s")
    if not args.force > 0.0:
        cli.fail(f"--force: got {args.force} N, wanted more than 0")
    cli.configure_jax()
    folder = cli.output_folder(args, "whole_body")
    for kinds in GAITS.values():
        for kind in kinds[:1] if args.quick else kinds:
            kept(kind, args, folder)  # before the first study begins
    metrics: dict[str, Any] = {}
    curves: dict[str, Any] = {}
    families: dict[str, Any] = {}
    for gait, kinds in GAITS.items():
        used = kinds[:1] if args.quick else kinds
        try:
            recordings = {kind: record(kind, args, folder) for kind in used}
            metrics[gait], curves[gait], fits, held = study(gait, recordings, args.quick)
        except KeyboardInterrupt:
            print(f"stopped; finished recordings are kept in {folder}/, run again to go on")
            raise SystemExit(130) from None
        for name in KEPT:
            fit, end = fits[name], "" if name == "affine" else f"_{name}"
            storage.save(
                folder / f"residual_{gait}{end}.npz",
                storage.Stored("residual", DT, fit.W, np.nan_to_num(fit.after), name),
            )
        families[gait] = compare(gait, held, folder, args.quick)
        weights = {name: fit.W for name, fit in fits.items()}
        np.savez(folder / f"weights_{gait}.npz", dt=DT, **weights)
    chosen = metrics["trot"]["chosen_inside"]
    trot = {name: metrics["trot"]["inside"][name]["50ms"]["all"] for name in (chosen, "affine")}
    result = {
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
        "provenance": cli.provenance(),
    }
    (folder / "table.md").write_text(report.table(families), encoding="utf-8")
    cli.save_json(folder / "metrics.json", result)
    cli.save_json(folder / "details.json", metrics)
    report.save_figure(curves, DT, folder / "figure.png")
    print(f"\n{report.table(families)}\nresults in {folder}/")


def study(
    gait: str, recordings: dict[str, list[Episode]], quick: bool
) -> tuple[dict[str, Any], dict[str, Any], dict[str, whole_body.Fit], Transitions]:
    """Fit and test the models of a gait.

    Returns:
      Metrics; error curves over time; the fits; transitions of the episodes held out.
    """
    body = _body()
    subset: dict[int, str] = {}
    episodes: list[Episode] = []
    for kind, those in recordings.items():
        for episode in those:
            flat = "pushed" if episode.disturbed.any() else "flat"
            subset[len(subset)] = "rough" if kind.endswith("rough") else flat
            episodes.append(episode)
    numbers = np.arange(len(episodes))
    rest, told = split(numbers, share=HELD_OUT)
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
    curves: dict[str, Any] = {}
    for where, schemes in (("inside", ("",)), ("all_starts", ("frozen", "scheduled"))):
        for horizon, length in HORIZONS.items():
            views = open_loop.windows(held, length, inside=where == "inside", stride=2)
            kinds, calm = np.array([subset[n] for n in views.episode]), ~views.disturbed
            groups = {"all": calm}
            groups |= {kind: calm & (kinds == kind) for kind in sorted(set(subset.values()))}
            groups["all, no foot slips"] = calm & views.still
            groups["all, during pushes as well"] = calm | True
            reference = None
            for scheme in schemes:
                down = landing if scheme == "scheduled" else None
                base = _errors(views, body, None, None, down)
                reference = base if reference is None else reference
                for name in ("nominal", *chosen):
                    fit = fits.get(name)
                    errors = base if fit is None else _errors(views, body, fit, chosen[name], down)
                    full_name = f"{scheme} {name}".strip()
                    entry: dict[str, Any] = {"windows": int(calm.sum())}
                    for group, rows in groups.items():
                        if rows.any():
                            entry[group] = _ratios(errors, base, views.episode, rows)
                    if scheme == "scheduled":
                        entry["all, against the frozen nominal"] = _ratios(
                            errors, reference, views.episode, calm
                        )
                    out[where].setdefault(full_name, {})[horizon] = entry
                    if length == max(HORIZONS.values()):
                        curves[where, full_name] = {
                            key: np.sqrt(value[calm].mean(axis=0)) for key, value in errors.items()
                        }
        report.show(gait, where, out[where])
    return out, curves, fits, held


def compare(gait: str, held: Transitions, folder: Path, quick: bool) -> dict[str, Any]:
    """Every model that an LMPC can predict with, as it would, inside a stance.

    Returns:
      Model -> horizon -> rms error of velocity and pitch rate, and its ratio to that of the
      planted rigid body (not linearised) with the interval.
    """
    unlike = "linear, cautious"  # the paper's, weighed otherwise
    names = list(MODEL_KEYS)[:1] if quick else [name for name in MODEL_KEYS if name != unlike]
    chosen = {name: MODEL_KEYS[name] for name in names}
    for end, name in (("", "affine"), ("_clock_history", "clock, last force")):
        file = folder / f"residual_{gait}{end}.npz"
        chosen[f"planted SRB + residual ({name})"] = residual(str(file))
    out: dict[str, Any] = {}
    views = {
        name: open_loop.windows(held, n, inside=True, stride=2) for name, n in HORIZONS.items()
    }
    nominal = {name: _errors(view, _body(), None, None, None) for name, view in views.items()}
    for label, keys in chosen.items():
        # The LMPC's own step plays no part, but must suit the model's.
        config = load_config(
            RunConfig, CONFIGS / KINDS[gait].config, {**keys, "lmpc.model_dt": 0.02}
        )
        config, problem = _within_stance(config)
        with jax.enable_x64(True):
            fits = fit_models(config, get_robot(config.robot).params)
            family = build_family(resolve_model(config.koopman))
            fits = jax.tree.map(lambda a, at=problem: a[at], fits)
            own = fits.model if fits.prediction is None else fits.prediction.params
            force = np.zeros((len(Mode), 4)) if fits.prediction is None else fits.prediction.force
            feet = fits.feet if config.koopman.feet == "fixed" else None
            for name, view in views.items():
                predicted = open_loop.predict_as_lmpc(
                    view, family, jax.tree.map(jnp.asarray, own), jnp.asarray(force),
                    steps=round(DT / config.koopman.dataset.dt),
                    feet=None if feet is None else jnp.asarray(feet),
                )  # fmt: skip
                errors = open_loop.squared_errors(view, predicted)
                calm = ~view.disturbed
                ratios = _ratios(errors, nominal[name], view.episode, calm)
                out.setdefault(label, {})[name] = {
                    key: ratios[key] for key in ("velocity", "omega")
                }
    return out


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
    base = _errors(views, body, None, None, landing)
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
        errors = _errors(views, body, fit, features, landing)
        ratios = [_at_end(errors[k], calm) / _at_end(base[k], calm) for k in ("velocity", "omega")]
        score = ratios[0] * ratios[1]
        if best is None or score < best[0]:
            best = score, fit, steps
    assert best is not None
    return best[1], best[2], best[0]


def _body() -> srb_planar.SrbParams:
    body = own_body(SrbConfig(), get_robot().params)
    return jax.tree.map(jnp.asarray, body._replace(feet=np.zeros((2, 2))))


def _at_end(squared: np.ndarray, rows: np.ndarray) -> float:
    return float(squared[rows, -1].mean())


def _within_stance(config: RunConfig) -> tuple[RunConfig, np.ndarray]:
    """A config whose gait alone is fitted, within its stances; and where each mode's fit lies."""
    name = config.gait.names[0]
    own = dataclasses.replace(config.gaits[name], horizon="stance")
    config = dataclasses.replace(
        config,
        gait=dataclasses.replace(config.gait, also=()),
        gaits=Gaits({**config.gaits, name: own}),
    )
    problems, _ = contact_problems(build_gaits(config), config)
    modes = [problem.mode for problem in problems]
    # No window is of a mode that the gait has not.
    return config, np.array([modes.index(mode) if mode in modes else 0 for mode in Mode])


def _errors(
    views: open_loop.Windows,
    body: srb_planar.SrbParams,
    fit: whole_body.Fit | None,
    features: Features | None,
    landing: open_loop.Landing | None,
) -> dict[str, np.ndarray]:
    W = None if fit is None else fit.W
    own = affine if features is None else features
    predicted = open_loop.predict(views, body, dt=DT, W=W, features=own, landing=landing)
    return open_loop.squared_errors(views, predicted)


def _ratios(
    errors: dict[str, np.ndarray],
    base: dict[str, np.ndarray],
    episode: np.ndarray,
    rows: np.ndarray,
) -> dict[str, Any]:
    """Root-mean-square errors at the end, and their ratio to the nominal's with its interval."""
    out: dict[str, Any] = {}
    for name, squared in errors.items():
        ratio, low, high = open_loop.rms_ratio(
            squared[rows, -1:], base[name][rows, -1:], episode[rows]
        )[:, 0]
        rms = np.sqrt(squared[rows, -1].mean())
        out[name] = {"ratio": ratio, "interval": [low, high], "rms": rms}
    return out


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


if __name__ == "__main__":
    cli.run(main)
