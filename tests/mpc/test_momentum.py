"""The spatial LMPC against the nonlinear roll-out: exact, first order, and optimal."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax import qp
from kjax.dynamics import rotations, srb_spatial
from kjax.dynamics.srb_spatial import BodyState, Contacts, SpatialBody
from kjax.gait import Clock, Gait, Phase, build_schedule
from kjax.mpc import grid, momentum

INERTIA = [[0.1273, -0.0004, -0.0144], [-0.0004, 0.3944, -0.0001], [-0.0144, -0.0001, 0.4228]]
BODY = SpatialBody(mass=jnp.asarray(12.743), inertia=jnp.asarray(INERTIA))
WEIGHT = 12.743 * 9.81
HIPS = np.array(
    [[0.19, -0.127, 0.0], [0.19, 0.127, 0.0], [-0.19, -0.127, 0.0], [-0.19, 0.127, 0.0]]
)
TROT = Gait("trot", (Phase((1, 0, 0, 1), 0.2), Phase((0, 1, 1, 0), 0.2)))
BOUND = Gait(
    "bound",
    (Phase((1, 1, 0, 0), 0.1), Phase((0,) * 4, 0.06), Phase((0, 0, 1, 1), 0.1),
     Phase((0,) * 4, 0.05)),
)  # fmt: skip
SCHEDULE = build_schedule([TROT, BOUND])


def clock(which, elapsed):
    return Clock(*map(jnp.asarray, (which, 0, 0)), elapsed=jnp.asarray(elapsed))


def nodes(which=0, elapsed=0.05, count=12, horizon=0.25):
    return grid.build_grid(
        SCHEDULE, clock(which, elapsed), count, node_dt=0.025, horizon=horizon, shortest=0.0025
    )


def problem(seed=0, which=0):
    """A tilted, turning body, its grid, feet and forces that share the weight."""
    rng = np.random.default_rng(seed)
    found = nodes(which)
    R = rotations.exp(jnp.asarray(rng.uniform(-0.2, 0.2, 3)))
    omega = rng.uniform(-1, 1, 3)
    start = BodyState(
        jnp.array([0.0, 0.0, 0.27]),
        R,
        jnp.asarray(rng.uniform(-0.4, 0.4, 3)),
        srb_spatial.momentum(BODY, R, jnp.asarray(omega)),
    )
    K = len(found.length)
    feet = jnp.broadcast_to(jnp.asarray(HIPS + rng.uniform(-0.03, 0.03, (4, 3))), (K, 4, 3))
    count = np.maximum(np.asarray(found.stance).sum(1), 1)[:, None, None]
    share = np.asarray(found.stance)[..., None] * np.array([0.0, 0.0, WEIGHT]) / count
    return start, found, feet, jnp.asarray(share)


def test_nodes_end_where_phases_do():
    found = nodes(elapsed=0.05)
    ends = np.asarray(found.end)
    used = np.asarray(found.length) > 0
    assert used.sum() == 10
    np.testing.assert_allclose(found.length[:6], 0.025)  # 0.15 s of the present phase
    np.testing.assert_allclose(ends[[5, 9]], [0.15, 0.25])
    assert np.asarray(found.stance)[:6, 0].all()
    assert np.asarray(found.stance)[6:10, 1].all()
    assert not np.asarray(found.stance)[10:].any()
    np.testing.assert_allclose(np.asarray(found.begin)[[0, 6]], [-0.05, 0.15])


def test_a_flight_is_one_node_without_feet():
    found = nodes(which=1, elapsed=0.05)
    standing = np.asarray(found.stance).any(axis=1)
    np.testing.assert_allclose(
        np.asarray(found.length)[:9], [0.025] * 2 + [0.06] + [0.025] * 4 + [0.04, 0]
    )
    np.testing.assert_array_equal(standing[:9], [1, 1, 0, 1, 1, 1, 1, 0, 0])


def test_the_list_of_feet_is_that_of_the_stances():
    _, found, *_ = problem()
    listed = grid.list_feet(found.stance, 24)
    used = np.asarray(listed.used)
    assert used.sum() == np.asarray(found.stance).sum() == 20
    pairs = set(zip(np.asarray(listed.node)[used], np.asarray(listed.leg)[used], strict=True))
    assert pairs == set(zip(*np.nonzero(np.asarray(found.stance)), strict=True))


@pytest.mark.parametrize("which", [0, 1])
def test_place_and_momentum_about_the_path_are_exact_for_any_change_of_the_forces(which):
    start, found, feet, nominal = problem(1, which)
    rng = np.random.default_rng(2)
    change = 40.0 * rng.normal(size=nominal.shape) * np.asarray(found.stance)[..., None]
    response = momentum.linearise(BODY, start, found.length, feet, nominal)
    moved = srb_spatial.rollout(BODY, start, Contacts(feet, nominal + change), found.length)
    x = np.zeros(12)
    for k, (A, B) in enumerate(zip(np.asarray(response.A), np.asarray(response.B), strict=True)):
        x = A @ x + np.einsum("lsf,lf->s", B, change[k])
        dp, dv = (
            np.asarray(a[k + 1] - b[k + 1])
            for a, b in zip((moved.p, moved.v), (response.states.p, response.states.v), strict=True)
        )
        lam = np.asarray(moved.L[k + 1]) + 12.743 * np.cross(dp, dv)
        np.testing.assert_allclose(x[3:6], dp, atol=1e-13)
        np.testing.assert_allclose(x[9:], dv, atol=1e-13)
        np.testing.assert_allclose(x[6:9], lam - np.asarray(response.states.L[k + 1]), atol=1e-11)


def test_the_attitude_is_first_order_in_the_change_of_the_forces():
    start, found, feet, nominal = problem(3)
    direction = np.random.default_rng(4).normal(size=nominal.shape)
    direction *= np.asarray(found.stance)[..., None]
    # Fine nodes: the midpoint rule's own error is not the subject.
    length = found.length / 8

    def missed(size):
        response = momentum.linearise(BODY, start, length, feet, nominal)
        change = size * direction
        moved = srb_spatial.rollout(BODY, start, Contacts(feet, nominal + change), length)
        x = np.zeros(12)
        for A, B, u in zip(np.asarray(response.A), np.asarray(response.B), change, strict=True):
            x = A @ x + np.einsum("lsf,lf->s", B, u)
        d = rotations.log(moved.R[-1] @ response.states.R[-1].T)
        return np.linalg.norm(np.asarray(d) - x[:3]), np.linalg.norm(d)

    (large, turned), (small, _) = missed(40.0), missed(10.0)
    assert large < 0.02 * turned
    assert 10 < large / small < 22  # second order: 16


def targets(found, force):
    K = len(found.length)
    return momentum.Targets(
        R=jnp.broadcast_to(jnp.eye(3), (K, 3, 3)),
        p=jnp.stack([0.3 * found.end, 0.0 * found.end, 0.27 + 0.0 * found.end], axis=-1),
        omega=jnp.zeros((K, 3)),
        v=jnp.broadcast_to(jnp.array([0.3, 0.0, 0.0]), (K, 3)),
        heading=jnp.broadcast_to(jnp.array([0.8, 0.6]), (K, 2)),
        force=force,
    )


WEIGHTS = momentum.Weights(
    *(jnp.asarray(50 * np.array(w)) for w in ((50, 50, 30), (10, 10, 100), (0.2,) * 3, (2, 2, 1))),
    force=jnp.asarray(5e-4),
)


@pytest.mark.parametrize("which", [0, 1])
def test_plans_about_plans_end_at_a_minimum_of_the_nonlinear_cost(which):
    start, found, feet, nominal = problem(5, which)
    listed = grid.list_feet(found.stance, 24)
    wanted = targets(found, nominal)
    loose = momentum.Limits(jnp.asarray(100.0), jnp.array([-1e4, 1e4]))

    @jax.jit
    def plan(force):
        return momentum.solve(
            BODY, start, found, feet, force, wanted, WEIGHTS, loose, listed, tolerance=1e-9
        )

    def cost(force):
        states = srb_spatial.rollout(BODY, start, Contacts(feet, force), found.length)
        ends = jax.tree.map(lambda a: a[1:], states)
        error = momentum.errors(BODY, ends, wanted)[0]
        weight = jnp.concatenate([w for w in WEIGHTS[:4]])
        away = ((force - wanted.force) ** 2).sum(axis=(1, 2))
        return found.length @ (error**2 @ weight + WEIGHTS.force * away)

    slope = jax.jit(jax.grad(cost))
    force = nominal
    for _ in range(4):
        solved = plan(force)
        assert int(solved.status) == qp.Status.SOLVED
        force = solved.force
    standing = np.asarray(found.stance)[..., None]
    before, after = (np.abs(np.asarray(slope(f)) * standing).max() for f in (nominal, force))
    assert after < 0.03 * before
    assert cost(force) < 0.5 * cost(nominal)
    assert not np.asarray(force * ~standing).any()


def test_forces_keep_to_cone_and_bounds():
    start, found, feet, nominal = problem(6)
    start = start._replace(v=jnp.array([-1.5, 0.8, 0.0]))
    listed = grid.list_feet(found.stance, 24)
    limits = momentum.Limits(jnp.asarray(0.4), jnp.array([5.0, 90.0]))
    solved = jax.jit(
        lambda force: momentum.solve(
            BODY, start, found, feet, force, targets(found, nominal), WEIGHTS, limits, listed
        )
    )(nominal)
    assert int(solved.status) == qp.Status.SOLVED
    x, y, z = np.moveaxis(np.asarray(solved.force)[np.asarray(found.stance)], -1, 0)
    assert z.min() >= 5.0 - 1e-6
    assert z.max() <= 90.0 + 1e-6
    assert (np.abs(x) <= 0.4 * z + 1e-6).all()
    assert (np.abs(y) <= 0.4 * z + 1e-6).all()
    assert (np.abs(x) > 0.4 * z - 1e-6).any()  # it brakes as hard as it may
