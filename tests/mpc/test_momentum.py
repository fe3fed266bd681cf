"""The spatial LMPC against the nonlinear roll-out: exact, first order, and optimal."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from spatial_problem import BODY, nodes, problem, rollout, targets

from kjax import qp
from kjax.dynamics import rotations
from kjax.dynamics.srb_spatial import Contacts
from kjax.mpc import grid, momentum

linearise = jax.jit(momentum.linearise)
list_feet = jax.jit(grid.list_feet, static_argnums=1)
log = jax.jit(rotations.log)


def test_nodes_end_where_phases_do():
    found = nodes(elapsed=0.05)
    node_end = found.end
    used = found.length > 0
    assert used.sum() == 10
    np.testing.assert_allclose(found.length[:6], 0.025)  # 0.15 s of the present phase
    np.testing.assert_allclose(node_end[[5, 9]], [0.15, 0.25])
    assert found.stance[:6, 0].all()
    assert found.stance[6:10, 1].all()
    assert not found.stance[10:].any()
    np.testing.assert_allclose(found.begin[[0, 6]], [-0.05, 0.15])


def test_a_flight_is_one_node_without_feet():
    found = nodes(which=1, elapsed=0.05)
    standing = found.stance.any(axis=1)
    np.testing.assert_allclose(found.length[:9], [0.025] * 2 + [0.06] + [0.025] * 4 + [0.04, 0])
    np.testing.assert_array_equal(standing[:9], [1, 1, 0, 1, 1, 1, 1, 0, 0])


def test_the_list_of_feet_is_that_of_the_stances():
    _, found, *_ = problem()
    listed = list_feet(found.stance, 24)
    used = np.asarray(listed.used)
    assert used.sum() == found.stance.sum() == 20
    pairs = set(zip(np.asarray(listed.node)[used], np.asarray(listed.leg)[used], strict=True))
    assert pairs == set(zip(*np.nonzero(found.stance), strict=True))


@pytest.mark.parametrize("which", [0, 1])
def test_place_and_momentum_about_the_path_are_exact_for_any_change_of_the_forces(which):
    start, found, feet, nominal = problem(1, which)
    rng = np.random.default_rng(2)
    change = 40.0 * rng.normal(size=nominal.shape) * found.stance[..., None]
    response = jax.tree.map(np.asarray, linearise(BODY, start, found.length, feet, nominal))
    changed = rollout(BODY, start, Contacts(feet, nominal + change), found.length)
    changed = jax.tree.map(np.asarray, changed)
    x = np.zeros(12)
    for k, (A, B) in enumerate(zip(response.A, response.B, strict=True)):
        x = A @ x + np.einsum("lsf,lf->s", B, change[k])
        dp, dv = (
            a[k + 1] - b[k + 1]
            for a, b in zip(
                (changed.p, changed.v), (response.states.p, response.states.v), strict=True
            )
        )
        lam = changed.L[k + 1] + 12.743 * np.cross(dp, dv)
        np.testing.assert_allclose(x[3:6], dp, atol=1e-13)
        np.testing.assert_allclose(x[9:], dv, atol=1e-13)
        np.testing.assert_allclose(x[6:9], lam - response.states.L[k + 1], atol=1e-11)


def test_the_attitude_is_first_order_in_the_change_of_the_forces():
    start, found, feet, nominal = problem(3)
    direction = np.random.default_rng(4).normal(size=nominal.shape)
    direction *= found.stance[..., None]
    # Fine nodes: the midpoint rule's own error is not the subject.
    length = found.length / 8

    def missed(size):
        response = linearise(BODY, start, length, feet, nominal)
        change = size * direction
        changed = rollout(BODY, start, Contacts(feet, nominal + change), length)
        x = np.zeros(12)
        for A, B, u in zip(np.asarray(response.A), np.asarray(response.B), change, strict=True):
            x = A @ x + np.einsum("lsf,lf->s", B, u)
        d = np.asarray(log(np.asarray(changed.R)[-1] @ np.asarray(response.states.R)[-1].T))
        return np.linalg.norm(d - x[:3]), np.linalg.norm(d)

    (large, turned), (small, _) = missed(40.0), missed(10.0)
    assert large < 0.02 * turned
    assert 10 < large / small < 22  # second order: 16


WEIGHTS = momentum.Weights(
    *(50 * np.array(w) for w in ((50, 50, 30.0), (10, 10, 100.0), (0.2,) * 3, (2, 2, 1.0))),
    force=np.asarray(5e-4),
)
foot_rows = jax.jit(momentum.foot_rows)


def rows(friction, force_z, nodes, torques=None, most=np.inf):
    limits = momentum.Limits(np.asarray(friction), np.array(force_z), np.full(3, most))
    torques = np.zeros((nodes, 4, 3, 3)) if torques is None else torques
    return foot_rows(limits, np.eye(3), torques)


@partial(jax.jit, static_argnames="tolerance")
def plan(start, found, feet, force, wanted, limits, listed, tolerance):
    response = momentum.linearise(BODY, start, found.length, feet, force)
    return momentum.solve(
        response, found, force, wanted, WEIGHTS, limits, listed, tolerance=tolerance
    )


@jax.jit
@jax.value_and_grad
def cost_and_slope(force, start, found, feet, wanted):
    response = momentum.linearise(BODY, start, found.length, feet, force)
    error = momentum.errors(response, wanted)[0]
    weight = jnp.concatenate([w for w in WEIGHTS[:4]])
    away = ((force - wanted.force) ** 2).sum(axis=(1, 2))
    return found.length @ (error**2 @ weight + WEIGHTS.force * away)


@pytest.mark.parametrize("which", [0, 1])
def test_plans_about_plans_end_at_a_minimum_of_the_nonlinear_cost(which):
    start, found, feet, nominal = problem(5, which)
    listed = list_feet(found.stance, 24)
    wanted = targets(found, nominal)
    loose = rows(100.0, [-1e4, 1e4], len(found.length))

    def judge(force):
        cost, slope = cost_and_slope(force, start, found, feet, wanted)
        return float(cost), np.abs(np.asarray(slope) * standing).max()

    force, standing = nominal, found.stance[..., None]
    for _ in range(4):
        solved = plan(start, found, feet, force, wanted, loose, listed, tolerance=1e-9)
        assert int(solved.status) == qp.Status.SOLVED
        force = np.asarray(solved.force)
    (cost_before, before), (cost_after, after) = map(judge, (nominal, force))
    assert after < 0.03 * before
    assert cost_after < 0.5 * cost_before
    assert not (force * ~standing).any()


def test_forces_keep_to_cone_and_bounds():
    start, found, feet, nominal = problem(6)
    start = start._replace(v=np.array([-1.2, 1.2, 0.0]))
    listed = list_feet(found.stance, 24)
    rng = np.random.default_rng(7)
    torques = 0.2 * rng.normal(size=(len(found.length), 4, 3, 3))
    limits = rows(0.4, [5.0, 90.0], len(found.length), torques, 13.0)

    wanted = targets(found, nominal)
    solved = plan(start, found, feet, nominal, wanted, limits, listed, tolerance=1e-6)
    assert int(solved.status) == qp.Status.SOLVED
    x, y, z = np.moveaxis(np.asarray(solved.force)[found.stance], -1, 0)
    assert z.min() >= 5.0 - 1e-6
    assert z.max() <= 90.0 + 1e-6
    # Eight sides about the circle, whatever the direction: a pyramid of four allows 1.41.
    part = np.hypot(x, y) / (0.4 * z)
    assert part.max() <= 1.0 / np.cos(np.pi / 8) + 1e-6
    assert part.max() >= 1.0 - 1e-6  # it brakes as hard as it may
    torque = np.abs(np.einsum("klij,klj->kli", torques, solved.force))
    assert torque.max() == pytest.approx(13.0, abs=1e-5)
