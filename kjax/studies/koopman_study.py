"""Which models predict the rigid body, how far, and how sure: every family beside the others.

Fits or builds every model of kjax.koopman on the same data, rolls it out from 50 random starts
under 50 random force profiles, and reports the error against the horizon, as the model itself and
as an LMPC uses it (linearised at the start). Leaves metrics.json, details.json (all statistics),
table.md and figure.png. With --whole-body, metrics.json holds the residual's two ratios as well.
"""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from kjax import cli
from kjax.config import SrbConfig
from kjax.controllers.rigid_body import own_body
from kjax.dynamics import srb_planar
from kjax.koopman import edmd, observables
from kjax.koopman.dataset import SampleRanges, sample
from kjax.options import File, Options, fail, parse
from kjax.prediction import evaluation, families, learned
from kjax.robots import get_robot
from kjax.types import GRAVITY, MODE_ALPHA, Mode
from kjax.viz.style import figure_style
from kjax.viz.tables import markdown_table

DT = 1e-3  # s
MODES = {"trot": Mode.TROT, "front": Mode.FRONT, "rear": Mode.REAR}
HORIZONS = (0.001, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)  # s
ROLLOUTS, STEPS = 100, 100  # of the training data, per mode
STARTS, PROFILES = 50, 50  # of the test
VELOCITY = slice(3, 5)
# Half-ranges (p_x, p_z, theta, v_x, v_z, omega; F_x, F_z about half the weight): a calm trot, and
# what a bound goes through.
RANGES = {
    "trot ranges": ((0.5, 0.1, 0.15, 0.5, 0.5, 1.0), (15.0, 20.0)),
    "bound ranges": ((0.5, 0.1, 0.4, 1.0, 1.0, 3.0), (40.0, 62.0)),
}
# Family, parameters, plant that it is judged on, whether linearised at the start.
Fitted = tuple[families.Family, Any, srb_planar.Plant, bool]


@dataclass(kw_only=True)
class KoopmanStudyOptions(Options):
    """Options of the study."""

    quick: bool = False
    """Less of it: to check the script."""

    draw: bool = False
    """Draw a finished study again."""

    no_learned: bool = False
    """Leave out the networks."""

    seed: int = 1
    """Of the training data."""

    whole_body: File = None
    """Folder with results of whole_body.py."""


def main(argv: Sequence[str] | None = None) -> int:
    """Parse the command line and run the study."""
    args = parse(KoopmanStudyOptions, argv, __doc__.splitlines()[0])
    residual = {} if args.whole_body is None else residual_ratios(args.whole_body)
    folder = cli.output_folder(args, "koopman_study")
    if args.draw:
        file = folder / "details.json"
        if not file.exists():
            fail(f"--draw: no study in {folder}")
        figure(json.loads(file.read_text(encoding="utf-8")), folder / "figure.png")
        return 0
    cli.configure_jax()
    jax.config.update("jax_enable_x64", True)
    clock = time.perf_counter()
    result = study(args)
    cli.save_json(folder / "details.json", result)
    record = {**summary(result), **residual, **compact(result)}
    cli.save_study(folder, record, table(result), lambda path: figure(result, path))
    print(f"{time.perf_counter() - clock:.0f} s in all")
    return 0


def residual_ratios(folder: Path) -> dict[str, float]:
    """What a residual leaves of the rigid body's error on the whole robot, from whole_body.py."""
    file = folder / "metrics.json"
    names = ("residual_velocity_ratio_50ms", "residual_pitch_rate_ratio_50ms")
    try:
        there = json.loads(file.read_text(encoding="utf-8"))
        return {name: float(there[name]) for name in names}
    except (OSError, ValueError, KeyError, TypeError) as error:
        fail(f"--whole-body: no results of whole_body.py in {file}: {error!r}")


def study(args: KoopmanStudyOptions) -> dict[str, Any]:
    """Errors of all models: ranges -> mode -> model -> statistics against the horizon."""
    body = edmd.srb_params(own_body(SrbConfig(), get_robot().params))
    states, profiles = (10, 10) if args.quick else (STARTS, PROFILES)
    out: dict[str, Any] = {"horizons_s": HORIZONS, "errors": {}, "spectrum": {}}
    chosen = {"trot": Mode.TROT} if args.quick else MODES
    for name, (state_half, force_half) in RANGES.items():
        out["errors"][name] = {}
        for gait, mode in chosen.items():
            here = jax.tree.map(lambda a, m=mode: a[m], body)
            alpha = jnp.asarray(MODE_ALPHA[mode], float)
            ranges = ranges_of(state_half, force_half, here)
            print(f"{name}, {gait}", flush=True)
            models = fit_all(args, here, alpha, ranges)
            if name == "bound ranges":
                A = models["linear EDMD, p = 4 (the paper)"][1].A
                rates = edmd.spectrum(np.asarray(A), DT)
                out["spectrum"][gait] = {"real": rates.real, "imaginary": rates.imag}
            key = jax.random.key(1000 + mode)
            draw = partial(sample, params=here, alpha=alpha, ranges=ranges, dt=DT)
            starts = draw(key, rollouts=states, steps=1).states[:, 0]
            forces = draw(
                jax.random.fold_in(key, 1), rollouts=profiles, steps=round(HORIZONS[-1] / DT)
            ).inputs
            out["errors"][name][gait] = {
                label: judge(model, here, alpha, starts, forces) for label, model in models.items()
            }
    return out


def ranges_of(
    state_half: tuple[float, ...], force_half: tuple[float, float], body: srb_planar.SrbParams
) -> SampleRanges:
    """Sampling ranges about standing, forces about half the weight per leg."""
    middle = jnp.array([0.0, float(body.mass) * GRAVITY / 2] * 2)
    half = jnp.array([*force_half] * 2)
    return SampleRanges(
        state_centre=jnp.array([0.0, 0.27, 0.0, 0.0, 0.0, 0.0]),
        state_half=jnp.array(state_half),
        input_low=middle - half,
        input_high=middle + half,
        feet_half=jnp.zeros(2),
    )


def fit_all(
    args: KoopmanStudyOptions, body: srb_planar.SrbParams, alpha: Any, ranges: SampleRanges
) -> dict[str, Fitted]:
    """Every model of a contact mode."""
    data = sample(
        jax.random.key(args.seed), body, alpha, ranges, rollouts=ROLLOUTS, steps=STEPS, dt=DT
    )
    known = families.BodyModel(body, alpha)
    out: dict[str, Fitted] = {
        "SRB linearised at hover": (
            families.linear(observables.states_only(), DT),
            families.linearised_srb(body, alpha, 0.27, DT), "body", False,
        ),
        "SRB linearised at the start": (families.rigid_body(DT), known, "body", True),
    }  # fmt: skip
    dictionaries = {
        "affine fit, no lifting": observables.states_only(),
        "linear EDMD, p = 4 (the paper)": observables.paper(4),
        "linear EDMD, p = 4, with R": observables.paper(4, constant_rotation=True),
        "linear EDMD, monomials to 3": observables.monomials(3),
        "linear EDMD, 40 Fourier features": observables.fourier(40, scale=0.5),
    }
    for label, dictionary in dictionaries.items():
        model, _ = jax.jit(partial(edmd.fit, dictionary))(data)
        out[label] = (families.linear(dictionary, DT), model, "body", False)
    for label, with_rotation in (
        ("bilinear EDMD, p = 4, without R", False),
        ("bilinear EDMD, p = 4, with R", True),
    ):
        dictionary = observables.paper(4, constant_rotation=with_rotation)
        model, _ = jax.jit(partial(edmd.fit_bilinear, dictionary))(data)
        family = families.bilinear(dictionary, DT)
        out[label] = (family, model, "body", False)
        if with_rotation:
            out[f"{label}, linearised at the start"] = (family, model, "body", True)
    if not args.no_learned:
        heads: tuple[learned.Head, ...] = ("linear", "bilinear")
        for head in heads:
            fit = jax.jit(
                partial(learned.train, head=head, updates=100 if args.quick else 4000, window=50)
            )
            model, how = fit(jax.random.key(7), data)
            if bool(how.diverged):
                print(f"  learned, {head}: the training diverged; its best model is used")
            family = learned.learned(DT, model.head.A.shape[-1] - 7)
            out[f"learned lifting, {head}"] = (family, model, "body", False)
    exact = families.exact(DT)
    out["exact bilinear (forces fixed in space)"] = (exact, known, "space", False)
    out["exact bilinear, linearised at the start"] = (exact, known, "space", True)
    return out


def judge(
    model: Fitted, body: srb_planar.SrbParams, alpha: Any, starts: Any, forces: Any
) -> dict[str, Any]:
    """Statistics of the error at the horizons, each with its bootstrap interval over the starts."""
    family, params, plant, frozen = model
    at = np.round(np.array(HORIZONS) / DT).astype(int) - 1

    @jax.jit
    def errors(starts: Any, forces: Any) -> Any:
        found = evaluation.model_errors(
            family, params, plant, body, alpha, starts, forces, frozen=frozen
        )
        return found[:, :, at]

    found = errors(starts, forces)
    statistics = jax.device_get(evaluation.summarise(found))
    key = jax.random.key(0)

    def rms(rows: Any) -> Any:
        return jnp.sqrt(jnp.mean(rows**2, axis=(0, 1)))

    low, high = jax.device_get(jax.jit(lambda e: evaluation.bootstrap(key, e, rms))(found))
    return {
        **{name: value for name, value in statistics._asdict().items()},
        "rms": np.asarray(rms(found)),
        "rms_low": low,
        "rms_high": high,
        "quantiles": np.asarray(evaluation.quantiles(found)),
        "max_velocity": statistics.max[:, VELOCITY].max(axis=1),
        "observables": family.size,
    }


def summary(result: dict[str, Any]) -> dict[str, float]:
    """The figures that the README argues with: the worst contact mode on the bound's ranges."""
    modes = result["errors"]["bound ranges"].values()
    fifty, last = HORIZONS.index(0.05), -1

    def worst(label: str, at: int) -> float:
        return float(max(mode[label]["max_velocity"][at] for mode in modes))

    return {
        "linear_max_velocity_error_50ms": worst("linear EDMD, p = 4 (the paper)", fifty),
        "bilinear_max_velocity_error_50ms": worst("bilinear EDMD, p = 4, with R", fifty),
        "exact_max_error_500ms": float(
            max(mode["exact bilinear (forces fixed in space)"]["max"][last].max() for mode in modes)
        ),
    }


def compact(result: dict[str, Any]) -> dict[str, Any]:
    """Largest error of the velocity at every horizon, two digits [m/s]."""
    return {
        "horizons_s": list(result["horizons_s"]),
        "max_velocity_error_mps": {
            ranges: {
                gait: {
                    label: [float(f"{value:.2g}") for value in entry["max_velocity"]]
                    for label, entry in models.items()
                }
                for gait, models in modes.items()
            }
            for ranges, modes in result["errors"].items()
        },
    }


def table(result: dict[str, Any]) -> str:
    """Largest velocity error after 50 ms and rms after 0.5 s, as Markdown."""
    tables = []
    fifty, last = HORIZONS.index(0.05), -1
    for name, modes in result["errors"].items():
        heads = [f"{gait}, {when}" for gait in modes for when in ("50 ms", "0.5 s")]
        rows = []
        for label, entry in next(iter(modes.values())).items():
            cells = [label, str(entry["observables"])]
            for mode in modes.values():
                here = mode[label]
                cells.append(f"{here['max_velocity'][fifty]:.1e}")
                rms, low, high = (
                    np.linalg.norm(here[k][last][VELOCITY]) for k in ("rms", "rms_low", "rms_high")
                )
                cells.append(f"{rms:.1e} ({low:.1e} to {high:.1e})")
            rows.append(cells)
        header = [f"{name}: error of the velocity [m/s]", "observables", *heads]
        tables.append(markdown_table(header, rows))
    note = "50 ms: largest error of the test; 0.5 s: rms and its 95 % interval over starts.\n"
    return "\n".join([*tables, note])


# Drawn alike: (beginning of the label, colour); the more specific first.
COLOURS = (
    ("SRB linearised at hover", "#9aa5b1"), ("SRB linearised at the start", "#3e4c59"),
    ("affine", "#90cdf4"), ("linear EDMD, p = 4 (", "#1a56db"),
    ("linear EDMD, p = 4, with", "#63b3ed"), ("linear EDMD, monomials", "#0e7490"),
    ("linear EDMD, 40", "#67e8f9"),
    ("bilinear EDMD, p = 4, without", "#a3e635"), ("bilinear EDMD, p = 4, with R", "#15803d"),
    ("learned lifting, linear", "#fdba74"), ("learned lifting, bilinear", "#ea580c"),
)  # fmt: skip
FLOOR = 1e-9  # m/s, end of the axis


@figure_style
def figure(result: dict[str, Any], path: Path) -> None:
    """Error of the velocity against the horizon, bound ranges.

    The pitch rate is left out: with feet fixed in the body it is affine in the forces, and every
    model but the learned ones has it to rounding.
    """
    modes = result["errors"]["bound ranges"]
    fig, axes = plt.subplots(
        1, len(modes), figsize=(3.6 * len(modes) + 3.2, 4.2), sharey=True, layout="constrained",
        squeeze=False,
    )  # fmt: skip
    for ax, (gait, models) in zip(axes[0], modes.items(), strict=True):
        exact = 0.0
        for name, entry in models.items():
            if name.startswith("exact"):
                rms = np.array(entry["rms"])[:, VELOCITY]
                exact = max(exact, float(np.linalg.norm(rms, axis=1).max()))
                continue
            value, low, high = (
                np.linalg.norm(np.array(entry[k])[:, VELOCITY], axis=1)
                for k in ("rms", "rms_low", "rms_high")
            )
            colour = next(c for begin, c in COLOURS if name.startswith(begin))
            style = "--" if name.endswith("at the start") else "-"
            wide = 2.6 if "paper" in name else 1.4
            ax.loglog(HORIZONS, value, style, color=colour, lw=wide, label=name)
            ax.fill_between(HORIZONS, low, high, color=colour, alpha=0.2, lw=0)
        ax.text(0.97, 0.02, f"exact bilinear form: up to {exact:.0e}", transform=ax.transAxes,
                ha="right", va="bottom", fontsize=8, color="#6b21a8")  # fmt: skip
        ax.grid(alpha=0.3)
        ax.set(ylim=(FLOOR, 10.0), title=f"{gait} stance", xlabel="horizon [s]")
    axes[0][0].set_ylabel("rms error of the velocity [m/s]")
    handles, labels = axes[0][0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside right center", fontsize=8)
    fig.savefig(path)
    plt.close(fig)
