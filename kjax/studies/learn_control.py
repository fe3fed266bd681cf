"""A lifting learned for control: prediction loss plus closed-loop cost through the QP.

One network, one start, one set of data, trained twice: on many-step prediction alone, and with the
cost of closed loops on the rigid body added, differentiated through every QP. Both then predict
held-out rollouts, and run held-out scenarios on the rigid body and in MuJoCo. Leaves
metrics.json, table.md, figure.png and both models (for koopman.file) in the output folder.
"""

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from kjax import cli
from kjax.config import CommandConfig, RunConfig, load_config
from kjax.config.shipped import shipped_config
from kjax.controllers.resolve import resolve
from kjax.controllers.resolve_model import dataset_spec
from kjax.controllers.rigid_body import own_body
from kjax.koopman.dataset import sample, sample_ranges
from kjax.options import Options, parse, require
from kjax.prediction import families, learned, storage
from kjax.robots import get_robot
from kjax.sim.closed_cost import recording_costs
from kjax.sim.engines.mujoco_batch import BatchEngine
from kjax.sim.intervals import bootstrap
from kjax.sim.resolve import batch_spec, resolve_episode
from kjax.sim.summary import summarise
from kjax.tuning import loop
from kjax.types import MODE_ALPHA, Mode
from kjax.viz.style import figure_style
from kjax.viz.tables import markdown_table

DT, STEPS, ROLLOUTS = 1e-3, 100, 100
TRAIN_SEED, HELD_OUT_SEED, HELD_OUT = 100, 200, 32
MEMORY = 0.1  # s, of the derivatives through the closed loop


def main(argv: Sequence[str] | None = None) -> int:
    """Parse the command line and run."""
    args = _parse(argv)
    folder = cli.output_folder(args, "learn_control")
    cli.configure_jax()
    clock = time.perf_counter()
    data, test = draw(1, ROLLOUTS), draw(2, ROLLOUTS)
    path = folder / "prediction.npz"
    plain, how = train(args, data, None)
    save(path, plain)
    print(f"trained for prediction ({time.perf_counter() - clock:.0f} s)", flush=True)
    config = short(args, path)
    params = jax.tree.map(jnp.asarray, resolve(config)[1])  # indexed by what is traced
    train_on = loop.draw_scenarios(config, TRAIN_SEED, args.scenarios)
    costs = costs_of(params, loop.build_loop(config, memory=MEMORY))
    both, how_both = train(args, data, lambda model: args.weight * costs(model, train_on).mean())
    save(folder / "control.npz", both)
    print(f"trained for control as well ({time.perf_counter() - clock:.0f} s)", flush=True)
    held_out = loop.draw_scenarios(config, HELD_OUT_SEED, HELD_OUT)
    value, error = jax.jit(costs), jax.jit(prediction_errors)
    models = {"prediction": (plain, how), "prediction and control": (both, how_both)}
    result: dict[str, Any] = {"options": {k: v for k, v in vars(args).items() if k != "out"}}
    for (name, (model, training)), file in zip(models.items(), (path, folder / "control.npz"),
                                               strict=True):  # fmt: skip
        each = np.asarray(value(model, held_out))
        errors = np.asarray(error(model, test))
        result[name] = {
            "velocity_error_50ms_rms": float(np.sqrt((errors[:, 49, 3:5] ** 2).sum(-1).mean())),
            "velocity_error_50ms_max": float(np.abs(errors[:, 49, 3:5]).max()),
            "held_out_cost": float(each.mean()),
            "held_out_cost_each": each,
            "diverged": bool(training.diverged),
            "loss": np.asarray(training.loss)[:: max(1, args.updates // 200)],
            "mujoco": verdict_of(args, file),
        }
        print(f"{name}: velocity 50 ms ahead {result[name]['velocity_error_50ms_rms']:.3g} m/s, "
              f"held-out cost {result[name]['held_out_cost']:.3f}", flush=True)  # fmt: skip
    result["own_linear_model"] = {"mujoco": verdict_of(args, None)}
    first, second = (np.asarray(result[n]["held_out_cost_each"]) for n in models)
    result["cost_ratio"] = float(second.mean() / first.mean())
    result["cost_ratio_low"], result["cost_ratio_high"] = bootstrap(
        lambda a, b: b.mean(axis=1) / a.mean(axis=1), first, second
    )
    cli.save_study(folder, result, table(result), lambda path: figure(result, path))
    print(f"{time.perf_counter() - clock:.0f} s in all")
    return 0


@dataclass(kw_only=True)
class LearnOptions(Options):
    """Options of the study."""

    head: Literal["linear", "bilinear"] = "linear"
    """Form of the model in its observables."""

    updates: int = 600
    """Of Adam."""

    rate: float = 3e-3
    """Of Adam, in what each parameter moves by itself."""

    scenarios: int = 4
    """Closed loops per update."""

    seconds: float = 0.6
    """Length of each."""

    weight: float = 0.1
    """Of the closed loops' cost."""

    walks: int = 16
    """Seeds in MuJoCo."""


def _parse(argv: Sequence[str] | None) -> LearnOptions:
    args = parse(LearnOptions, argv, __doc__.splitlines()[0])
    names = ("updates", "rate", "scenarios", "seconds", "weight", "walks")
    require(args, *names, above=0)
    return args


def run_config(path: Path | None) -> RunConfig:
    """The trot over ten steps of 20 ms, with a learned model or the paper's."""
    own = {} if path is None else {"koopman.model": "learned", "koopman.file": str(path.resolve())}
    return load_config(RunConfig, shipped_config("trot_velocity_long.toml"), own)


def short(args: LearnOptions, path: Path) -> RunConfig:
    """That of a scenario."""
    command = CommandConfig(times=(0.0,), v_x=(0.0,))
    return dataclasses.replace(run_config(path), duration=args.seconds, command=command)


def draw(seed: int, rollouts: int) -> Any:
    """Rollouts of the trot's rigid body on the ranges of the config."""
    config = RunConfig()
    body = jax.tree.map(jnp.asarray, own_body(config.srb, get_robot(config.robot).params))
    alpha = jnp.asarray(MODE_ALPHA[Mode.TROT], float)
    ranges = sample_ranges(dataset_spec(config.koopman.dataset))
    one = partial(sample, rollouts=rollouts, steps=STEPS, dt=DT)
    return jax.jit(one)(jax.random.key(seed), body, alpha, ranges)


def train(args: LearnOptions, data: Any, extra: Any) -> tuple[Any, learned.Training]:
    """A model and how its training went; the same random draws with and without ``extra``."""
    fit = partial(
        learned.train,
        head=args.head,
        updates=args.updates,
        rate=args.rate,
        window=50,
        extra_loss=extra,
    )
    return jax.device_get(jax.jit(fit)(jax.random.key(3), data))


def stacked(model: Any) -> Any:
    """The trot's model for every contact mode: a trot meets no other."""
    return jax.tree.map(lambda a: jnp.broadcast_to(a, (len(Mode), *jnp.shape(a))), model)


def save(path: Path, model: Any) -> None:
    """Write a model for koopman.file."""
    spread = np.zeros((len(Mode), 6))
    params = jax.device_get(stacked(model))
    storage.save(path, storage.Stored("learned", DT, params, spread))


def costs_of(params: Any, run: loop.Loop) -> Any:
    """Function (model, scenarios) -> cost of every scenario."""

    def costs(model: Any, scenarios: loop.Scenario) -> jax.Array:
        fits = params.fits
        fits = fits._replace(prediction=fits.prediction._replace(params=stacked(model)))
        own = params._replace(fits=fits)
        return jax.vmap(lambda s: loop.cost(get_robot().params, run(own, s)))(scenarios)

    return costs


def prediction_errors(model: Any, data: Any) -> jax.Array:
    """Errors (rollouts, steps, 6) of predictions from the start."""
    family = learned.learned(DT, model.head.A.shape[-1] - 7)

    def one(states: jax.Array, inputs: jax.Array, feet: jax.Array) -> jax.Array:
        start = families.Start(states[0], feet)
        return (families.rollout(family, model, start, inputs) - states)[1:]

    return jax.vmap(one)(*data)


def verdict_of(args: LearnOptions, path: Path | None) -> dict[str, Any]:
    """The config's command in MuJoCo."""
    config = run_config(path)
    engine = BatchEngine(batch_spec(config))
    recording = engine.run([resolve_episode(config, seed=seed) for seed in range(args.walks)])
    if recording.interrupted:
        raise KeyboardInterrupt
    rows = summarise(recording.metrics())
    keep = ("velocity_rmse_mps", "pitch_p95_deg")
    return {
        "runs": rows["runs"],
        "falls": rows["falls"],
        "cost_median": float(np.median(recording_costs(recording))),
        **{key: rows[key] for key in keep if key in rows},
    }


def table(result: dict[str, Any]) -> str:
    """Markdown."""
    rows = []
    for name in ("prediction", "prediction and control", "own_linear_model"):
        entry = result[name]
        verdict = entry["mujoco"]
        rmse = verdict.get("velocity_rmse_mps")
        ahead = ("-", "-")
        if "held_out_cost" in entry:
            ahead = (f"{entry['velocity_error_50ms_rms']:.3g}", f"{entry['held_out_cost']:.3f}")
        rows.append(
            (name.replace("_", " "), *ahead, f"{verdict['falls']} of {verdict['runs']}",
             f"{rmse['median']:.4f} ({rmse['worst']:.4f})" if rmse else "-",
             f"{verdict['cost_median']:.3f}")
        )  # fmt: skip
    header = ("trained for", "velocity error, 50 ms, rms [m/s]", "held-out cost", "MuJoCo: fell",
              "RMSE of v_x [m/s]", "cost")  # fmt: skip
    return markdown_table(header, rows) + (
        f"\nHeld-out cost with control over without: {result['cost_ratio']:.3f} "
        f"({result['cost_ratio_low']:.3f} to {result['cost_ratio_high']:.3f})\n"
    )


@figure_style
def figure(result: dict[str, Any], path: Path) -> None:
    """Losses; cost of every held-out scenario, with control against without."""
    fig, (curve, pairs) = plt.subplots(1, 2, figsize=(8, 3.2), layout="constrained")
    names = ("prediction", "prediction and control")
    for name in names:
        loss = np.asarray(result[name]["loss"], float)
        every = result["options"]["updates"] / len(loss)
        curve.plot(np.arange(len(loss)) * every, loss, lw=0.8, label=name)
    curve.set(xlabel="update", ylabel="training loss", yscale="log")
    curve.legend(fontsize=7, title="trained for", title_fontsize=7)
    first, second = (np.asarray(result[n]["held_out_cost_each"]) for n in names)
    top = max(first.max(), second.max())
    pairs.plot([0, top], [0, top], "k--", lw=0.8)
    pairs.plot(first, second, "o", ms=3)
    pairs.set(xlabel=f"cost, trained for {names[0]}", ylabel=f"cost, for {names[1]}",
              title="held-out scenarios", aspect="equal")  # fmt: skip
    fig.savefig(path)
    plt.close(fig)
