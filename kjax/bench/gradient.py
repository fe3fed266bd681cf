"""Gradients through the closed loop: right, finite, at what price; for benchmark.py gradient."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from kjax.bench.options import BenchOptions
from kjax.bench.timing import interleaved, median_ratio
from kjax.config import RunConfig, load_config
from kjax.config.shipped import shipped_config
from kjax.tuning import loop
from kjax.tuning.optimise import build_objective
from kjax.tuning.space import Space, build_space
from kjax.viz.style import figure_style
from kjax.viz.tables import markdown_table

_FILES = {
    "trot": "trot_velocity",
    "trot, planted model, measured feet": "trot_velocity_long",
    "trot to bound": "bound_velocity_short",
    "bound, the paper's timing": "bound_velocity",
    "bound, friction as rows": "bound_velocity_short",
    "bound, horizon through flight": "bound_multiphase",
}
THROUGH_FLIGHT = "bound, horizon through flight"
CASES: dict[str, dict[str, Any]] = {name: {} for name in _FILES} | {
    "trot, planted model, measured feet": {
        "koopman.feet": "measured", "koopman.model": "planted", "lmpc.integral_gains": [1.0, 1.0],
        "lmpc.command_slew": 1.0,
    },
    "trot to bound": {"gait.names": ["trot", "bound"], "gait.times": [0.0, 0.45]},
    "bound, friction as rows": {"lmpc.friction": 0.6},
}  # fmt: skip
LMPC = ("lmpc.Q", "lmpc.R", "lmpc.grf_x_max", "lmpc.body_height")
BOUND = tuple(
    f"gaits.bound.{key}" for key in ("Q", "R", "foothold_front", "force_edge",
                                     "grf_z_max", "foothold_gain")
)  # fmt: skip
CYCLE = (
    *(f"gaits.bound_multiphase.{key}"
      for key in ("Q", "R", "foothold_front", "foothold_gain")),
    "multiphase.inertia_scale", "multiphase.velocity_time",
)  # fmt: skip
KEYS = {
    "trot": (*LMPC, "leg.foothold_gain"),
    "trot, planted model, measured feet": (
        *LMPC, "leg.foothold_gain", "lmpc.integral_gains", "srb.mass", "srb.inertia",
    ),
    "trot to bound": (*LMPC, *BOUND),
    "bound, the paper's timing": BOUND,
    "bound, friction as rows": BOUND,
    "bound, horizon through flight": CYCLE,
}  # fmt: skip
CHECKED = 6  # scenarios with differences
MANY = 256
STEPS = (1e-5, 1e-6)  # of the differences; the better one counts, on either side of a kink
ROUNDS = 5
SECONDS = 1.0


@dataclass(kw_only=True)
class GradientOptions(BenchOptions):
    """Options of this benchmark."""

    through_flight: bool = False
    """The horizon through flight as well, on 16 scenarios; minutes to compile."""


OPTIONS = GradientOptions


def run(folder: Path, args: GradientOptions) -> dict[str, Any]:
    """All measurements; leaves figure.png and table.md in the folder."""
    count = 16 if args.quick else MANY
    result: dict[str, Any] = {"seconds": SECONDS, "scenarios": count, "cases": {}}
    errors: dict[str, np.ndarray] = {}
    names = [name for name in _FILES if name != THROUGH_FLIGHT or args.through_flight]
    for name in names[:1] if args.quick else names:
        config, space = prepared(name)
        many = 16 if name == THROUGH_FLIGHT else count
        entry, errors[name] = checked(config, space, 2 if args.quick else CHECKED, many)
        entry |= priced(config, space, many, 2 if args.quick else ROUNDS) | {"scenarios": many}
        result["cases"][name] = entry
        print(f"{name}: gradient within {entry['rel_err_median']:.1e} of differences (median of "
              f"{entry['compared']}), finite in {entry['finite_fraction']:.0%} of {many}, "
              f"{entry['grad_over_value']:.2f} times the value's time", flush=True)  # fmt: skip
    every = np.concatenate(list(errors.values()))
    cases = list(result["cases"].values())
    result |= {
        "grad_rel_err_median": float(np.median(every)),
        "grad_rel_err_p90": float(np.quantile(every, 0.9)),
        "grad_finite_fraction": min(entry["finite_fraction"] for entry in cases),
        "grad_over_value": float(np.median([entry["grad_over_value"] for entry in cases])),
    }
    (folder / "table.md").write_text(table(result), encoding="utf-8")
    figure(errors, folder / "figure.png")
    return result


def prepared(name: str) -> tuple[RunConfig, Space]:
    """Config and variables of a case."""
    path = shipped_config(f"{_FILES[name]}.toml")
    config = load_config(RunConfig, path, {"duration": SECONDS, **CASES[name]})
    return config, build_space(config, KEYS[name])


def scenarios_of(config: RunConfig, count: int) -> loop.Scenario:
    """Random ones, with noise, other masses and starts."""
    top = 0.3 if config.gait.names[-1] == "trot" else 0.8
    return loop.draw_scenarios(config, 0, count, speeds=(0.0, top))


def checked(
    config: RunConfig, space: Space, count: int, many: int
) -> tuple[dict[str, Any], np.ndarray]:
    """Gradients against central differences in float64, and how many of a large batch are finite.

    Every parameter and scenario gives one relative error; differences that rounding drowns are left
    out.
    """
    objective = build_objective(config, space)
    value = jax.jit(jax.vmap(objective, (None, 0)))
    slopes = jax.jit(jax.vmap(jax.value_and_grad(objective), (None, 0)))
    scenarios = scenarios_of(config, many)
    costs, slope = slopes(space.start, scenarios)
    finite = np.isfinite(np.asarray(costs))
    norm = np.sqrt(sum(np.sum(np.asarray(g).reshape(many, -1) ** 2, 1) for g in slope.values()))
    for one in jax.tree.leaves(slope):
        finite &= np.isfinite(np.asarray(one).reshape(many, -1)).all(axis=1)
    few = jax.tree.map(lambda a: a[:count], scenarios)
    errors, drowned = [], 0
    for key, one in space.start.items():
        for index in np.ndindex(np.shape(one)):
            own = np.asarray(slope[key])[(slice(0, count), *index)]
            best = np.full(count, np.inf)
            size = np.abs(own)
            for step in STEPS:
                up, down = (
                    value({**space.start, key: jnp.asarray(one).at[index].add(s * step)}, few)
                    for s in (1.0, -1.0)
                )
                wanted = np.asarray(up - down) / (2.0 * step)
                best = np.minimum(best, np.abs(own - wanted))
                size = np.maximum(size, np.abs(wanted))
            heard = size > 1e-6 * np.abs(np.asarray(costs[:count]))
            drowned += int((~heard).sum())
            errors.append(best[heard] / size[heard])
    flat = np.concatenate(errors)
    entry = {
        "compared": len(flat),
        "drowned": drowned,
        "rel_err_median": float(np.median(flat)),
        "rel_err_p90": float(np.quantile(flat, 0.9)),
        "finite_fraction": float(finite.mean()),
        "grad_norm_median": float(np.median(norm)),
    }
    return entry, flat


def priced(config: RunConfig, space: Space, count: int, rounds: int) -> dict[str, float]:
    """Time of a batch's value, and of its value and gradient, in turn; medians."""
    objective, scenarios = build_objective(config, space), scenarios_of(config, count)

    def mean(variables: Any, scenarios: Any) -> Any:
        return jax.vmap(objective, (None, 0))(variables, scenarios).mean()

    value = jax.jit(mean).lower(space.start, scenarios).compile()
    begin = time.perf_counter()
    both = jax.jit(jax.value_and_grad(mean)).lower(space.start, scenarios).compile()
    compiled = time.perf_counter() - begin
    times = interleaved(
        {
            "value": lambda _: value(space.start, scenarios),
            "both": lambda _: both(space.start, scenarios),
        },
        rounds,
    )
    return {
        "value_s": float(np.median(times["value"])),
        "value_and_grad_s": float(np.median(times["both"])),
        "grad_over_value": median_ratio(times["both"], times["value"]),
        "compile_s": compiled,
        "value_MB": _temporary_memory(value),
        "value_and_grad_MB": _temporary_memory(both),
    }


def _temporary_memory(compiled: Any) -> float:
    """What a compiled program needs besides its arguments and results [MB]."""
    return float(compiled.memory_analysis().temp_size_in_bytes / 1e6)


def table(result: dict[str, Any]) -> str:
    """Markdown."""
    header = (
        "closed loop, 1 s", "parameters x scenarios", "error of the gradient, median (90 %)",
        "size, median", "finite", "value [s]", "value and gradient [s]", "ratio", "memory [MB]",
    )  # fmt: skip
    return markdown_table(header, (
        (
            name,
            str(e["compared"]),
            f"{e['rel_err_median']:.1e} ({e['rel_err_p90']:.1e})",
            f"{e['grad_norm_median']:.1e}",
            f"{e['finite_fraction']:.0%} of {e['scenarios']}",
            f"{e['value_s']:.2f}",
            f"{e['value_and_grad_s']:.2f}",
            f"{e['grad_over_value']:.2f}",
            f"{e['value_and_grad_MB']:.0f}",
        )
        for name, e in result["cases"].items()
    ))  # fmt: skip


@figure_style
def figure(errors: dict[str, np.ndarray], path: Path) -> None:
    """Distribution of the relative errors."""
    fig, ax = plt.subplots(figsize=(5.5, 3.2), layout="constrained")
    for name, values in errors.items():
        ordered = np.sort(np.maximum(values, 1e-14))
        ax.step(ordered, np.arange(1, len(ordered) + 1) / len(ordered), where="post", label=name)
    ax.axvline(1e-5, color="k", ls=":", lw=0.8)
    ax.set(xscale="log", xlabel="relative error of the gradient against differences",
           ylabel="part of parameters and scenarios")  # fmt: skip
    ax.legend()
    ax.grid(alpha=0.3)
    fig.savefig(path)
    plt.close(fig)
