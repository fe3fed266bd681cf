"""EDMD beside pykoopman, pykoop and NumPy: fits, their data, a stream; run by benchmark.py edmd.

The peers need an interpreter of their own, which ``peers.py`` runs in: three rounds of it with
rounds of ours in between. Everything runs on one core with one thread.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from kjax.bench.edmd import report
from kjax.bench.edmd.data import (
    DICTIONARIES,
    LOOP,
    PAPER,
    SEEDS,
    VELOCITIES,
    Setting,
    numpy_draw,
    numpy_loop,
    numpy_rollouts,
    sampler,
    setting,
)
from kjax.bench.edmd.stream import STREAM, stream
from kjax.bench.options import BenchOptions
from kjax.bench.timing import Call, elapsed, interleaved
from kjax.config import KoopmanConfig
from kjax.koopman import edmd, models, observables, regression
from kjax.koopman.dataset import Snapshots
from kjax.options import Text, fail

PEERS = ("pykoopman", "pykoop")
SCRIPT = Path(__file__).with_name("peers.py")
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")

ROUNDS = 3  # of every timing, in turn with those beside it; medians over all calls are reported
CALLS = 30  # timed fits in a round
LARGEST = observables.paper(4, constant_rotation=True)

KEYS = ("fit_ms", "regression_ms", "many_s", "many_lifted_s")

TEST_ROLLOUTS, TEST_STEPS = 100, 50  # held out

ROLLOUTS = 10_000  # whose generation is timed


@dataclass(kw_only=True)
class EdmdOptions(BenchOptions):
    """Options of this benchmark."""

    peers: Text = None
    """Interpreter of an environment with pykoopman and pykoop; without it, none of them."""


OPTIONS = EdmdOptions


def run(folder: Path, args: EdmdOptions) -> dict[str, Any]:
    """All measurements; leaves figure.png and table.md in the folder."""
    versions = peer_versions(args.peers) if args.peers else {}
    _one_thread()
    missing = [name for name in PEERS if name not in versions]
    if missing:
        print(f"left out: {', '.join(missing)} (--peers names the Python that has them)")
    quick, here = args.quick, setting()
    result: dict[str, Any] = {"peers": versions, "missing": missing}
    # First, while the largest memory that this process ever had is still that of its imports.
    print("stream of snapshots")
    result["stream"] = stream(here, STREAM // 100 if quick else STREAM)
    print("fits")
    result["fits"] = fits(here, args.peers, versions, 5 if quick else CALLS)
    print("rollouts")
    result["rollouts"] = rollouts(here, ROLLOUTS // 10 if quick else ROLLOUTS, LOOP)
    result |= summary(result)
    (folder / "table.md").write_text(report.table(result), encoding="utf-8")
    report.figure(result, folder / "figure.png")
    return result


def summary(result: dict[str, Any]) -> dict[str, Any]:
    """The figures that matter; None where a peer is absent."""
    found, data = result["fits"], result["rollouts"]

    def ratio(peer: str) -> float | None:
        return found["fit_ms"]["kjax"] / found["fit_ms"][peer] if peer in found["fit_ms"] else None

    def speedup(key: str) -> float | None:
        rivals = [seconds for name, seconds in found[key].items() if name != "kjax"]
        return min(rivals) / found[key]["kjax"] if rivals else None

    return {
        "fit_over_pykoopman": ratio("pykoopman"),
        "fit_over_pykoop": ratio("pykoop"),
        "fits100_speedup": speedup("many_s"),
        "fits100_speedup_lifted_once": speedup("many_lifted_s"),
        "rollouts_speedup": data["kjax"] / data["numpy_loop"],
        "rollouts_over_vectorised_numpy": data["kjax"] / data["numpy_vectorised"],
        "streaming_snapshots_per_s": result["stream"]["snapshots_per_s"],
    }


def _one_thread() -> None:
    """Restart this program with one thread for linear algebra, unless it was started so.

    OpenBLAS reads the number when it is loaded, which is before the first line of ours.
    """
    if any(os.environ.get(name) != "1" for name in THREADS):
        sys.stdout.flush()
        environment = {**os.environ, **dict.fromkeys(THREADS, "1")}
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], environment)


# ---------------------------------------------------------------- fits


def fits(here: Setting, python: str | None, versions: Any, calls: int) -> dict[str, Any]:
    """One fit and a hundred of them, in time and error; one median per solver and quantity.

    Returns:
      ``fit_ms`` from states and ``regression_ms`` from lifted states; ``many_s`` for all data sets
      with all dictionaries, ``many_lifted_s`` the same where each data set is lifted once, in the
      largest dictionary; ``error`` with the largest and the root-mean-square error of each velocity
      after the test rollouts [m/s, rad/s]; ``many_timed``, how many of a peer's fits were timed.
    """
    keys = jax.random.split(jax.random.key(KoopmanConfig().dataset.seed), SEEDS + 1)
    data = jax.lax.map(sampler(here, here.rollouts, here.steps), keys[1:])
    test = sampler(here, TEST_ROLLOUTS, TEST_STEPS)(keys[0])
    first = jax.tree.map(lambda leaf: leaf[0], data)
    fit, regress = jax.jit(partial(edmd.fit, PAPER)), jax.jit(_regress)
    rows = jax.jit(partial(edmd.regressors, PAPER))(first)
    ours: dict[str, tuple[Callable[[], Any], int, float]] = {
        "fit_ms": (lambda: fit(first), calls, 1e3),
        "regression_ms": (lambda: regress(*rows), calls, 1e3),
        "many_s": (lambda: many(data), 3, 1.0),
    }
    for call, _, _ in ours.values():
        jax.block_until_ready(call())
    times: dict[str, dict[str, list[float]]] = {key: {"kjax": []} for key in KEYS}
    predicted = {"kjax": np.asarray(predict(fit(first)[0], test))}
    done: dict[str, int] = {}
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "data.npz"
        np.savez(path, states=data.states, inputs=data.inputs, test_states=test.states,
                 test_inputs=test.inputs, dictionaries=DICTIONARIES, calls=calls)  # fmt: skip
        for _ in tqdm(range(ROUNDS), desc="rounds", leave=False, disable=None):
            for key, (call, count, unit) in ours.items():
                times[key]["kjax"] += [unit * elapsed(call) for _ in range(count)]
            times["many_lifted_s"]["kjax"] = times["many_s"]["kjax"]  # it lifts once as it is
            for name, entry in (_peers(python, path) if versions else {}).items():
                for key in KEYS:
                    values = entry[key] if isinstance(entry[key], list) else [entry[key]]
                    times[key].setdefault(name, []).extend(values)
                predicted[name] = np.asarray(entry["end"])
                done[name] = min(entry["many_done"], done.get(name, len(DICTIONARIES) * SEEDS))
    result: dict[str, Any] = {
        key: {name: float(np.median(values)) for name, values in entry.items()}
        for key, entry in times.items()
    }
    truth = np.asarray(test.states[:, -1])
    result["error"] = {
        name: {
            "max": np.abs(end - truth).max(axis=0)[VELOCITIES],
            "rms": np.sqrt(((end - truth) ** 2).mean(axis=0))[VELOCITIES],
        }
        for name, end in predicted.items()
    }
    result["many_timed"] = done
    return result


def cuts() -> np.ndarray:
    """Observables (dictionaries, N) of the largest dictionary that each of the others uses."""
    smaller = (observables.paper(order, constant_rotation=c) for order, c in DICTIONARIES)
    return np.array([[name in one.names for name in LARGEST.names] for one in smaller])


@jax.jit
def many(data: Snapshots) -> Any:
    """Models and reports of all data sets (leading axis) in all dictionaries."""
    use = jnp.asarray(cuts())

    def one(data: Snapshots) -> Any:
        return jax.vmap(lambda use: edmd.fit(LARGEST, data, use=use))(use)

    return jax.lax.map(one, data)  # one after the other: ten data sets at once leave the cache


def _regress(Z: jax.Array, Y: jax.Array) -> regression.Weights:
    return regression.solve(regression.of_rows(Z, Y), Z.shape[1])


@jax.jit
def predict(model: models.LinearModel, test: Snapshots) -> jax.Array:
    """States (rollouts, 6) at the end of the test rollouts, lifted once at their start."""

    def one(states: jax.Array, inputs: jax.Array, feet: jax.Array) -> jax.Array:
        return models.rollout(model, PAPER.lift(states[0]), inputs, feet)[-1]

    return jax.vmap(one)(*test)


def peer_versions(python: str) -> dict[str, str]:
    """Versions of the peers that an interpreter has; ends the program where it has none."""
    try:
        done = subprocess.run([python, str(SCRIPT)], capture_output=True, text=True, check=False)
        versions = json.loads(done.stdout)
    except OSError as error:
        fail(f"--peers {python}: {error.strerror}")
    except json.JSONDecodeError:
        fail(f"--peers {python}: this is no Python that can run {SCRIPT.name}")
    if not versions:
        fail(f"--peers {python}: it has neither of {', '.join(PEERS)}")
    return versions


def _peers(python: str | None, data: Path) -> dict[str, Any]:
    """One round of the peers, on the core that this process is bound to."""
    out = data.with_name("out.json")
    command = [str(python), str(SCRIPT), str(data), str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        fail(f"--peers {python}: {(done.stderr.strip() or 'it failed').splitlines()[-1]}")
    return json.loads(out.read_text(encoding="utf-8"))


# ---------------------------------------------------------------- rollouts


def rollouts(here: Setting, count: int, looped: int) -> dict[str, float]:
    """Rollouts per second, random draws included: kjax, a NumPy loop, vectorised NumPy."""
    draw, key, rng = sampler(here, count, here.steps), jax.random.key(0), np.random.default_rng(0)
    body, alpha = jax.tree.map(np.asarray, here.body), np.asarray(here.alpha)
    calls: dict[str, Call] = {
        "kjax": lambda _: draw(key),
        "numpy_vectorised": lambda _: numpy_rollouts(
            body, alpha, *numpy_draw(rng, here, count), here.dt
        ),
        "numpy_loop": lambda _: numpy_loop(body, alpha, *numpy_draw(rng, here, looped), here.dt),
    }
    drawn = {"kjax": count, "numpy_vectorised": count, "numpy_loop": looped}
    times = interleaved(calls, 2 * ROUNDS)
    return {name: drawn[name] / float(np.median(times[name])) for name in calls}
