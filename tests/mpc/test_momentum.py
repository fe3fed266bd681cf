"""The spatial LMPC against the nonlinear roll-out: exact, first order, and optimal."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from spatial_problem import BODY, nodes, problem, targets

from kjax import qp
from kjax.dynamics import rotations, srb_spatial
from kjax.dynamics.srb_spatial import Contacts
from kjax.mpc import grid, momentum


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


WEIGHTS = momentum.Weights(
    *(jnp.asarray(50 * np.array(w)) for w in ((50, 50, 30), (10, 10, 100), (0.2,) * 3, (2, 2, 1))),
    force=jnp.asarray(5e-4),
)


def rows(friction, force_z, nodes, torques=None, most=np.inf):
    limits = momentum.Limits(jnp.asarray(friction), jnp.array(force_z), jnp.full(3, most))
    torques = jnp.zeros((nodes, 4, 3, 3)) if torques is None else torques
    return momentum.foot_rows(limits, jnp.eye(3), torques)


@pytest.mark.parametrize("which", [0, 1])
def test_plans_about_plans_end_at_a_minimum_of_the_nonlinear_cost(which):
    start, found, feet, nominal = problem(5, which)
    listed = grid.list_feet(found.stance, 24)
    wanted = targets(found, nominal)
    loose = rows(100.0, [-1e4, 1e4], len(found.length))

    @jax.jit
    def plan(force):
        response = momentum.linearise(BODY, start, found.length, feet, force)
        return momentum.solve(
            response, found, force, wanted, WEIGHTS, loose, listed, tolerance=1e-9
        )

    def cost(force):
        response = momentum.linearise(BODY, start, found.length, feet, force)
        error = momentum.errors(response, wanted)[0]
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
    start = start._replace(v=jnp.array([-1.2, 1.2, 0.0]))
    listed = grid.list_feet(found.stance, 24)
    rng = np.random.default_rng(7)
    torques = jnp.asarray(0.2 * rng.normal(size=(len(found.length), 4, 3, 3)))
    limits = rows(0.4, [5.0, 90.0], len(found.length), torques, 13.0)

    @jax.jit
    def plan(force):
        response = momentum.linearise(BODY, start, found.length, feet, force)
        return momentum.solve(
            response, found, force, targets(found, nominal), WEIGHTS, limits, listed
        )

    solved = plan(nominal)
    assert int(solved.status) == qp.Status.SOLVED
    x, y, z = np.moveaxis(np.asarray(solved.force)[np.asarray(found.stance)], -1, 0)
    assert z.min() >= 5.0 - 1e-6
    assert z.max() <= 90.0 + 1e-6
    # Eight sides about the circle, whatever the direction: a pyramid of four allows 1.41.
    part = np.hypot(x, y) / (0.4 * z)
    assert part.max() <= 1.0 / np.cos(np.pi / 8) + 1e-6
    assert part.max() >= 1.0 - 1e-6  # it brakes as hard as it may
    torque = np.abs(np.einsum("klij,klj->kli", torques, solved.force))
    assert torque.max() == pytest.approx(13.0, abs=1e-5)
