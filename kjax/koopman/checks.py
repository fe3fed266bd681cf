"""What a look at samples finds before they are fitted, on the host.

1. Shapes, finite values, enough of them.
2. Observables that are finite on all samples.
3. The step: displacements against velocities times dt.
4. Single samples of a velocity that their neighbours and the positions deny.
5. Displacements that no velocity explains.
6. What is no error, but leaves a part of the model undetermined.
"""

from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from kjax.koopman import regression
from kjax.koopman.dataset import DatasetSpec, Snapshots
from kjax.koopman.observables import Dictionary, lift_all
from kjax.types import INPUT_DIM, INPUT_NAMES, STATE_DIM, STATE_NAMES, STATE_UNITS

# A displacement is taken to speak of the step where the velocity explains this much of it (r^2);
# sensor noise alone explains nothing.
_EXPLAINED = 0.8
_STEP_ERROR = 1.3  # ratio of displacement to velocity times dt from which on the step is refused
_SPIKE = 10.0  # times the change of velocity that 90 % of the steps stay under,
_SPIKE_LEAST = 1.0  # and this much at least [m/s, rad/s]
_NOISE = 6.0  # times what three quarters of the displacements miss by: positions are noisy too
_OUTLIER = 100.0  # times what 90 % of the forces stay under


def check_snapshots(
    data: Snapshots, dictionary: Dictionary, *, dt: float, columns: int | None = None
) -> list[str]:
    """Look at the data before a fit, on the host.

    Args:
      data: snapshots of one mode.
      dictionary: observables.
      dt: step between the states [s].
      columns: number of regressors; that of the linear model if ``None``.

    Returns:
      Remarks that are no errors: observables and inputs that do not vary, regressors that follow
      from others, a force far beyond all others.

    Raises:
      ValueError: for wrong shapes, no or too few snapshots, values or observables that are not
        finite, a ``dt`` or units that displacements and velocities contradict, a single sample that
        its neighbours contradict, and a rollout whose positions do not follow from its velocities,
        as where two episodes were put into one.
    """
    if not (np.isfinite(dt) and dt > 0):
        raise ValueError(f"dt must be a positive time in seconds, got {dt}")
    states, inputs = (np.asarray(a) for a in (data.states, data.inputs))
    _check_shapes(states, inputs, np.asarray(data.feet))
    require_steps(states.shape, dictionary)
    for name, values in (("states", states), ("inputs", inputs), ("feet", np.asarray(data.feet))):
        bad = ~np.isfinite(values).reshape(len(values), -1).all(axis=1)
        if bad.any():
            raise ValueError(
                f"{name}: {int(bad.sum())} of {len(bad)} rollouts hold values that are not "
                f"finite, the first one is rollout {int(np.argmax(bad))}"
            )
    rows = states.shape[0] * (states.shape[1] - dictionary.window)
    require_rows(rows, dictionary.size + INPUT_DIM if columns is None else columns)
    lifted = np.asarray(lift_all(dictionary, jnp.asarray(states)))
    _check_lifted(lifted, dictionary)
    eps = max(float(np.finfo(a.dtype).eps) for a in (states, lifted) if a.dtype.kind == "f")
    # The differences of single precision are rounded again: compare in double.
    states = states.astype(float)
    displacement = np.diff(states[..., :3], axis=1)
    velocity = 0.5 * (states[:, 1:, 3:] + states[:, :-1, 3:])
    drift = np.abs(displacement - dt * velocity).max(axis=2)
    # Half a step's change of velocity is the largest difference that a smooth motion has.
    change = np.abs(np.diff(states[..., 3:], axis=1)).max(axis=2)
    noise = _NOISE * float(np.percentile(drift, 75))
    jump = drift > dt * (change + 1.0) + 1e-3 + noise
    few = jump.mean() < 0.5  # else it is rather the step that is wrong
    sound = ~jump if few else np.ones_like(jump)
    _check_step(displacement[sound], dt * velocity[sound], dt)
    _check_spikes(states, dt)
    if jump.any():
        rollout, step = np.argwhere(jump)[0]
        raise ValueError(
            f"states: rollout {rollout} jumps by {drift[rollout, step]:.3g} between steps {step} "
            f"and {step + 1}, which its velocity does not explain: are there two episodes in it, "
            f"or is dt {dt} s not its step?"
        )
    return list(_remarks(lifted, inputs, dictionary, eps))


def require_steps(shape: tuple[int, ...], dictionary: Dictionary) -> None:
    """Raise a ValueError for rollouts (rollouts, states, 6) without a step that can be fitted."""
    if shape[0] == 0:
        raise ValueError("states: got no rollouts, wanted at least one")
    if shape[1] <= dictionary.window:
        needs = f"{dictionary.window} before and one after" if dictionary.window > 1 else "two"
        raise ValueError(
            f"states: rollouts hold {shape[1]} state{'s' if shape[1] > 1 else ''} each, a step of "
            f"this dictionary needs {needs}"
        )


def require_rows(rows: int, columns: int) -> None:
    """Raise a ValueError for fewer snapshots than regressors."""
    if rows < columns:
        raise ValueError(f"{rows} snapshots are too few for {columns} regressors")


def require_dataset(dataset: DatasetSpec, columns: int) -> None:
    """Raise a ValueError for a dataset of fewer snapshots than a fit has regressors."""
    rows = dataset.rollouts * dataset.steps
    if rows < columns:
        raise ValueError(
            f"dataset: rollouts {dataset.rollouts} of duration {dataset.duration} s give "
            f"{rows} snapshots, too few for {columns} regressors"
        )


def _check_shapes(states: np.ndarray, inputs: np.ndarray, feet: np.ndarray) -> None:
    for name, values in (("states", states), ("inputs", inputs), ("feet", feet)):
        if values.dtype.kind not in "fiu":
            raise ValueError(f"{name}: got values of type {values.dtype}, wanted real values")
    if states.ndim != 3 or states.shape[-1] != STATE_DIM:
        raise ValueError(f"states: got shape {states.shape}, wanted (rollouts, steps + 1, 6)")
    wanted = (states.shape[0], states.shape[1] - 1, INPUT_DIM)
    if inputs.shape != wanted:
        raise ValueError(f"inputs: got shape {inputs.shape}, wanted {wanted} for these states")
    if feet.shape != (states.shape[0], 2, 2):
        raise ValueError(f"feet: got shape {feet.shape}, wanted ({len(states)}, 2, 2)")


def _check_lifted(lifted: Float[np.ndarray, "R T N"], dictionary: Dictionary) -> None:
    bad = ~np.isfinite(lifted)
    if bad.any():
        rollout, step, i = np.argwhere(bad)[0]
        raise ValueError(
            f"observable '{dictionary.names[i]}' is not finite at step "
            f"{step + dictionary.window - 1} of rollout {rollout}, nor in "
            f"{int(bad.any(axis=2).sum()) - 1} other samples of {bad[..., 0].size}"
        )


def _check_step(
    moved: Float[np.ndarray, "*M 3"], meant: Float[np.ndarray, "*M 3"], dt: float
) -> None:
    """Displacements (..., 3) against mean velocities times dt (..., 3), coordinate by coordinate.

    Noise in the velocities lowers the slope of one regression, noise in the positions raises that
    of the reverse one: the true ratio lies between the two. It is refused where neither is near 1.
    """
    moved, meant = moved.reshape(-1, 3), meant.reshape(-1, 3)
    yy, xx, xy = (moved**2).sum(axis=0), (meant**2).sum(axis=0), (moved * meant).sum(axis=0)
    told = (xy**2 > _EXPLAINED * xx * yy) & (xx > 0) & (yy > 0)
    ratio = np.full(3, np.nan)
    ratio[told] = np.sign(xy[told]) * np.sqrt(yy[told] / xx[told])
    low, high = np.full(3, np.nan), np.full(3, np.nan)
    low[told], high[told] = xy[told] / xx[told], yy[told] / xy[told]
    wrong = told & ((low > _STEP_ERROR) | (high < 1.0 / _STEP_ERROR))
    if not wrong.any():
        return
    common = float(np.median(ratio[told]))
    if wrong[told].all() and common > 0 and np.allclose(ratio[told], common, rtol=0.2):
        raise ValueError(
            f"dt is {dt:g} s, but the states move {common:.3g} times as far as their velocities "
            f"say: their step seems to be {common * dt:.3g} s"
        )
    i = int(np.argmax(wrong))
    raise ValueError(
        f"states: {STATE_NAMES[i]} moves {ratio[i]:.3g} times as far as {STATE_NAMES[i + 3]} says: "
        "is one of them in other units, or of the other sign?"
    )


def _check_spikes(states: Float[np.ndarray, "R S 6"], dt: float) -> None:
    """Velocities that leave their neighbours for one sample, and positions that know nothing of it.

    At the ends of a rollout there is one neighbour only, and the bound is three times as high.
    """
    x, v = states[..., :3], states[..., 3:]
    moved, change = np.diff(x, axis=1), np.diff(v, axis=1)
    least = _SPIKE_LEAST + _SPIKE * np.percentile(np.abs(change), 90, axis=(0, 1))
    spike = np.zeros(v.shape, bool)
    up, down = change[:, :-1], -change[:, 1:]
    out = (up * down > 0) & (np.minimum(np.abs(up), np.abs(down)) > least)
    extra = moved[:, :-1] + moved[:, 1:] - dt * (v[:, :-2] + v[:, 2:])
    spike[:, 1:-1] = out & (np.abs(extra) < 0.25 * dt * np.abs(up + down))
    for end, near, step, jump in ((0, 1, 0, -change[:, 0]), (-1, -2, -1, change[:, -1])):
        extra = moved[:, step] - dt * v[:, near]
        spike[:, end] = (np.abs(jump) > 3.0 * least) & (np.abs(extra) < 0.25 * dt * np.abs(jump))
    if spike.any():
        rollout, step, i = np.argwhere(spike)[0]
        beside = [f"{v[rollout, k, i]:.4g}" for k in (step - 1, step + 1) if 0 <= k < v.shape[1]]
        raise ValueError(
            f"states: {STATE_NAMES[i + 3]} of rollout {rollout} is {v[rollout, step, i]:.4g} "
            f"{STATE_UNITS[i + 3]} at step {step}, beside {' and '.join(beside)}, and the "
            "positions do not follow it: take the faulty sample out"
        )


def _remarks(
    lifted: Float[np.ndarray, "R T N"],
    inputs: Float[np.ndarray, "R S 4"],
    dictionary: Dictionary,
    eps: float,
) -> Iterator[str]:
    N, names = dictionary.size, [*dictionary.names, *INPUT_NAMES]
    observed = lifted.reshape(-1, N)
    still = _still(observed)
    for i in np.flatnonzero(still):
        if i > 0:
            yield (
                f"observable '{dictionary.names[i]}' does not vary in the data: it counts as a "
                "constant"
            )
    used = inputs[:, dictionary.window - 1 :]
    forces = used.reshape(-1, INPUT_DIM).astype(float)
    fixed = _still(forces)
    if fixed.any():
        forced = ", ".join(
            f"{INPUT_NAMES[i]} ({forces[0, i] + 0.0:g} N)" for i in np.flatnonzero(fixed)
        )
        yield f"inputs {forced} do not vary in the data: their columns of B stay undetermined"
    size = np.abs(inputs.astype(float))
    typical = np.percentile(size, 90, axis=(0, 1))
    for i in np.flatnonzero((typical > 0) & (size.max(axis=(0, 1)) > _OUTLIER * typical)):
        rollout, step = np.unravel_index(np.argmax(size[..., i]), size.shape[:2])
        yield (
            f"input '{INPUT_NAMES[i]}' is {inputs[rollout, step, i]:.4g} N at step {step} of "
            f"rollout {rollout}, where 90 % of all lie within {typical[i]:.4g} N"
        )
    Z = np.concatenate([lifted[:, :-1].reshape(-1, N), forces], axis=1)
    keep = np.flatnonzero(np.concatenate([~still, ~fixed]) | (np.arange(N + INPUT_DIM) == 0))
    rank, follow = _rank(Z[:, keep].astype(float), eps)
    if rank < len(keep):
        some = ", ".join(names[keep[i]] for i in follow[:6]) + (", ..." if len(follow) > 6 else "")
        yield (
            f"rank {rank} of {len(keep)} regressors that vary: {some} follow"
            f"{'s' if len(follow) == 1 else ''} from the others in the data"
        )


def _still(values: Float[np.ndarray, "M n"]) -> Bool[np.ndarray, "n"]:
    """Columns that do not vary (n,)."""
    spread = np.ptp(values, axis=0)
    return np.asarray(spread <= 1e-9 * np.maximum(np.abs(values).max(axis=0), 1e-30))


def _rank(Z: Float[np.ndarray, "M c"], eps: float) -> tuple[int, np.ndarray]:
    """Numerical rank as ``regression.solve`` has it, and the columns that follow from others."""
    norm = np.linalg.norm(Z, axis=0)
    R = np.linalg.qr(Z / np.where(norm > 0, norm, 1.0), mode="r")
    sigma = np.linalg.svd(R, compute_uv=False)
    rank = int((sigma > sigma[0] * regression.ROUNDING * len(sigma) * eps).sum())
    # Without pivoting, what is left on the diagonal is what the columns before do not explain.
    left = np.argsort(np.abs(np.diagonal(R)), kind="stable")[: Z.shape[1] - rank]
    return rank, np.sort(left)
