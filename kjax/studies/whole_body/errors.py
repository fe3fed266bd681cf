"""Errors of open-loop predictions on held-out episodes, beside the nominal rigid body's."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from kjax.config import Gaits, RunConfig, SrbConfig, load_config
from kjax.config.shipped import shipped_config
from kjax.controllers.resolve_fits import fit_models
from kjax.controllers.resolve_model import resolve_model
from kjax.controllers.rigid_body import own_body
from kjax.controllers.walkable import build_gaits, contact_problems
from kjax.dynamics import srb_planar
from kjax.prediction.build import build_family
from kjax.prediction.features import Features, affine
from kjax.robots import get_robot
from kjax.studies.prediction_models import MODELS, residual
from kjax.studies.whole_body.recordings import DT, KINDS
from kjax.sysid import open_loop, whole_body
from kjax.sysid.transitions import Transitions
from kjax.types import Mode

HORIZONS = {"25ms": 5, "50ms": 10}  # ticks
# Where and scheme with model -> rms errors over time.
Curves = dict[tuple[str, str], dict[str, np.ndarray]]


def errors_of(
    where: str,
    held: Transitions,
    subset: dict[int, str],
    models: dict[str, tuple[whole_body.Fit, Features]],
    landing: open_loop.Landing | None,
) -> tuple[dict[str, Any], Curves]:
    """Errors of all models inside a stance, or over all start points by two schemes.

    Args:
      where: "inside", or "all_starts".
      held: transitions held out.
      subset: of each episode, "flat", "pushed" or "rough".
      models: fits and their features by name.
      landing: where feet land, for the scheme that follows the schedule.

    Returns:
      Scheme and model -> horizon -> errors over groups of windows; and rms errors over time.
    """
    body = nominal_body()
    out: dict[str, Any] = {}
    curves: Curves = {}
    schemes = ("",) if where == "inside" else ("frozen", "scheduled")
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
            base = predicted_errors(views, body, None, None, down)
            reference = base if reference is None else reference
            for name in ("nominal", *models):
                errors = base
                if name in models:
                    errors = predicted_errors(views, body, *models[name], down)
                full_name = f"{scheme} {name}".strip()
                entry: dict[str, Any] = {"windows": int(calm.sum())}
                for group, rows in groups.items():
                    if rows.any():
                        entry[group] = _ratios(errors, base, views.episode, rows)
                if scheme == "scheduled":
                    entry["all, against the frozen nominal"] = _ratios(
                        errors, reference, views.episode, calm
                    )
                out.setdefault(full_name, {})[horizon] = entry
                if length == max(HORIZONS.values()):
                    curves[where, full_name] = {
                        key: np.sqrt(value[calm].mean(axis=0)) for key, value in errors.items()
                    }
    return out, curves


def compare(gait: str, held: Transitions, folder: Path, quick: bool) -> dict[str, Any]:
    """Every model that an LMPC can predict with, as it would, inside a stance.

    Returns:
      Model -> horizon -> rms error of velocity and pitch rate, and its ratio to that of the
      planted rigid body (not linearised) with the interval.
    """
    unlike = "linear, cautious"  # the paper's, weighed otherwise
    names = list(MODELS)[:1] if quick else [name for name in MODELS if name != unlike]
    chosen = {name: MODELS[name] for name in names}
    for end, name in (("", "affine"), ("_clock_history", "clock, last force")):
        file = folder / f"residual_{gait}{end}.npz"
        chosen[f"planted SRB + residual ({name})"] = residual(str(file))
    out: dict[str, Any] = {}
    views = {
        name: open_loop.windows(held, n, inside=True, stride=2) for name, n in HORIZONS.items()
    }
    nominal = {
        name: predicted_errors(view, nominal_body(), None, None, None)
        for name, view in views.items()
    }
    for label, keys in chosen.items():
        # The LMPC's own step plays no part, but must suit the model's.
        config = load_config(
            RunConfig, shipped_config(KINDS[gait].config), {**keys, "lmpc.model_dt": 0.02}
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


def nominal_body() -> srb_planar.SrbParams:
    """The robot's rigid body; where the feet are comes from the recordings."""
    body = own_body(SrbConfig(), get_robot().params)
    return jax.tree.map(jnp.asarray, body._replace(feet=jnp.zeros((2, 2))))


def predicted_errors(
    views: open_loop.Windows,
    body: srb_planar.SrbParams,
    fit: whole_body.Fit | None,
    features: Features | None,
    landing: open_loop.Landing | None,
) -> dict[str, np.ndarray]:
    """Squared errors of the predictions over windows, each (windows, steps).

    Args:
      views: windows of recorded episodes.
      body: nominal rigid body.
      fit: of a residual on it; ``None`` for none.
      features: that the residual takes.
      landing: where feet land, to follow the schedule; ``None`` keeps the feet that are there.
    """
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


def at_end(squared: np.ndarray, rows: np.ndarray) -> float:
    """Mean over some windows of the squared error at their end."""
    return float(squared[rows, -1].mean())
