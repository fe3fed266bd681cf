"""Snapshots that stream through the incremental QR; for benchmark.py edmd."""

import time
from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from kjax.bench.edmd.data import PAPER, Setting, sampler
from kjax.bench.machine import peak_memory
from kjax.koopman import edmd, regression
from kjax.koopman.dataset import Snapshots

STREAM = 10_000_000  # snapshots
BLOCK = 500  # of them in one QR


def stream(here: Setting, total: int) -> dict[str, float]:
    """Snapshots through the QR factor, drawn as they are needed and forgotten; none is kept.

    Returns:
      Snapshots per second into the QR factor (lifting included), and with their drawing; peak
      memory over that before the first one [MB], compiled programs included, and growth after the
      first hundredth [MB]; what all rows would take [MB]; the largest difference between the
      coefficients of the first blocks and of one factorisation of the same rows, relative to the
      largest coefficient, in scaled columns.
    """
    before = peak_memory()
    draw, size = sampler(here, here.rollouts, here.steps), here.rollouts * here.steps
    pushes = max(1, total // size)
    kept: list[Snapshots] = []
    factor, part = empty_factor(), empty_factor()
    jax.block_until_ready(push(factor, draw(jax.random.key(1))))
    pushing, drawing, early = 0.0, 0.0, 0.0
    for i in tqdm(range(pushes), desc="stream", leave=False, disable=None):
        clock = time.perf_counter()
        data = jax.block_until_ready(draw(jax.random.fold_in(jax.random.key(0), i)))
        middle = time.perf_counter()
        factor = jax.block_until_ready(push(factor, data))
        pushing += time.perf_counter() - middle
        drawing += middle - clock
        if i < 10:
            kept.append(data)
            part = factor
        if i == max(9, pushes // 100):
            early = peak_memory()
    peak = peak_memory()
    columns = factor.R.shape[0]
    return {
        "snapshots": pushes * size,
        "snapshots_per_s": pushes * size / pushing,
        "snapshots_per_s_with_drawing": pushes * size / (pushing + drawing),
        "peak_MB": peak - before,
        "growth_MB": peak - early,
        "all_rows_MB": pushes * size * columns * factor.R.dtype.itemsize / 1e6,
        "coefficients_difference": difference_from_one_shot(part, kept),
    }


def empty_factor() -> regression.QrFactor:
    """The QR factor of the paper's dictionary and four forces, of no rows."""
    return regression.empty(PAPER.size + 4, PAPER.size)


@jax.jit
def push(factor: regression.QrFactor, data: Snapshots) -> regression.QrFactor:
    """The QR factor with the snapshots more, in blocks of ``BLOCK`` rows."""
    Z, Y = edmd.regressors(PAPER, data)
    whole = len(Z) // BLOCK * BLOCK
    blocks = (a[:whole].reshape(-1, BLOCK, a.shape[1]) for a in (Z, Y))
    factor = regression.block_rows(factor, *blocks)
    return regression.accumulate(factor, Z[whole:], Y[whole:]) if whole < len(Z) else factor


def difference_from_one_shot(factor: regression.QrFactor, data: Sequence[Snapshots]) -> float:
    """Largest difference of the coefficients, relative to the largest, in scaled columns."""
    together = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *data)
    columns = PAPER.size + 4
    rows = jax.jit(lambda data: regression.of_rows(*edmd.regressors(PAPER, data)))(together)
    solve = jax.jit(partial(regression.solve, columns=columns))
    scale = np.linalg.norm(np.asarray(rows.R)[:, :columns], axis=0)[:, None]
    wanted, found = (scale * np.asarray(solve(one).W) for one in (rows, factor))
    return float(np.abs(found - wanted).max() / np.abs(wanted).max())
