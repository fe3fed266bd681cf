"""No product of matrices is left to a device's default: on a GPU that is TF32."""

from functools import partial

import jax
import jax.extend
import jax.numpy as jnp
import numpy as np
import pytest

from kjax import RunConfig, build_controller, condense, load_config, qp, resolve
from kjax.koopman import edmd, observables
from kjax.koopman.dataset import Snapshots
from kjax.legs.posture import stand_pose, standing
from kjax.qp.batching import CHUNK
from kjax.robots import go1

EXACT = (jax.lax.Precision.HIGHEST, jax.lax.Precision.HIGHEST)


@pytest.fixture(autouse=True)
def _the_default_of_a_reader():
    """Without what ``cli.configure_jax`` may have set in this process before."""
    before = jax.config.jax_default_matmul_precision
    jax.config.update("jax_default_matmul_precision", None)
    yield
    jax.config.update("jax_default_matmul_precision", before)


def products(jaxpr):
    """Precision of every dot_general of a jaxpr, inner ones included."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            yield equation.params["precision"]
        for inner in jax.extend.core.jaxprs_in_params(equation.params):
            yield from products(inner)


def assert_exact(function, *args):
    found = list(products(jax.make_jaxpr(function)(*args).jaxpr))
    assert found, "no product at all"
    assert all(precision == EXACT for precision in found)


def test_the_walk_finds_a_product_of_default_precision():
    with pytest.raises(AssertionError):
        assert_exact(jax.jit(lambda a: a @ a), jnp.eye(3))


@pytest.mark.parametrize("base", ["free", "planar"])
def test_controller(base):
    spec, params = resolve(load_config(RunConfig, None, {"sim.base": base}))
    controller, tables = build_controller(spec), condense(spec, params)
    height, joints = stand_pose(go1.PARAMS, 0.27)
    seen = standing(joints)._replace(base_pos=jnp.array([0.0, 0.0, height]))
    state = controller.init(tables, seen)
    assert_exact(controller.plan, tables, state, seen)
    assert_exact(controller.act, tables, state, seen)
    many = jax.tree.map(lambda a: jnp.stack([a] * (2 * CHUNK)), (state, seen))
    assert_exact(jax.vmap(jax.jit(controller.plan), (None, 0, 0)), tables, *many)
    assert_exact(jax.jit(partial(condense, spec)), params)


def problem(n=6):
    root = np.random.default_rng(0).normal(size=(n, n))
    return root @ root.T + np.eye(n), np.ones(n), -np.ones(n), np.ones(n)


@pytest.mark.parametrize("method", qp.METHODS)
def test_box_and_its_derivative(method):
    def value(H, q, lower, upper):
        return qp.solve(qp.prepare(H), q, lower, upper, method=method).x.sum()

    assert_exact(value, *problem())
    assert_exact(jax.grad(value), *problem())
    many = [np.stack([a] * (2 * CHUNK)) for a in problem()]
    assert_exact(jax.vmap(jax.jit(value)), *many)
    assert_exact(jax.vmap(jax.grad(jax.jit(value))), *many)


@pytest.mark.parametrize("method", qp.ROW_METHODS)
def test_rows_and_their_derivative(method):
    def value(H, q, lower, upper):
        C, side = jnp.ones((1, len(q))), jnp.ones(1)
        return qp.solve_rows(H, q, C, -side, side, lower, upper, method=method).x.sum()

    assert_exact(value, *problem())
    many = [np.stack([a] * (2 * CHUNK)) for a in problem()]
    assert_exact(jax.vmap(jax.grad(jax.jit(value))), *many)


def test_fit():
    rng = np.random.default_rng(0)
    data = Snapshots(rng.normal(size=(40, 6, 6)), rng.normal(size=(40, 5, 4)), np.zeros((40, 2, 2)))
    assert_exact(lambda data: edmd.fit(observables.paper(2), data)[0], data)
