"""The paper's dictionary, entry by entry."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax.koopman.observables import STATE_ROWS, paper
from kjax.types import STATE_NAMES, STATE_UNITS

ORDER = 4


def literal_by_hand(x, order):
    """``[1, p, theta, v, omega, vec(R omega), ..., vec(R omega^p)]``, vec stacking columns."""
    theta, omega = x[2], x[5]
    R = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    powers = [(R * omega**k).flatten(order="F") for k in range(1, order + 1)]
    return np.concatenate([[1.0], x, *powers])


@pytest.mark.parametrize(
    ("options", "size"),
    [
        ({}, 7 + 2 * ORDER),
        ({"literal": True}, 7 + 4 * ORDER),
        ({"constant_rotation": True}, 7 + 2 * (ORDER + 1)),
        ({"literal": True, "constant_rotation": True}, 7 + 4 * (ORDER + 1)),
    ],
)
def test_every_dictionary_starts_with_one_and_the_state_and_names_all_columns(options, size):
    dictionary = paper(ORDER, **options)
    x = jnp.arange(1.0, 7.0)
    z = jax.jit(dictionary.lift)(x)
    assert z.shape == (size,)
    assert dictionary.size == len(dictionary.units) == size
    assert z[0] == 1.0
    np.testing.assert_array_equal(z[STATE_ROWS], x)
    assert dictionary.names[STATE_ROWS] == STATE_NAMES
    assert dictionary.units[STATE_ROWS] == STATE_UNITS


def test_the_literal_dictionary_is_the_papers(dtype):
    x = np.array([0.3, 0.27, -0.4, 0.5, -0.2, 1.7], dtype)
    z = jax.jit(paper(ORDER, literal=True).lift)(jnp.asarray(x))
    assert z.dtype == dtype
    # Two to five roundings on entries up to omega^4 = 8.4.
    tolerance = 40 * np.finfo(dtype).eps
    np.testing.assert_allclose(z, literal_by_hand(x.astype(float), ORDER), rtol=0, atol=tolerance)


@pytest.mark.parametrize("constant_rotation", [False, True])
def test_dropping_the_repeats_loses_no_information(constant_rotation):
    options = {"constant_rotation": constant_rotation}
    literal, short = paper(ORDER, literal=True, **options), paper(ORDER, **options)
    states = np.random.default_rng(0).normal(size=(60, 6))
    Z_literal = np.asarray(jax.jit(jax.vmap(literal.lift))(states))
    Z_short = np.asarray(jax.jit(jax.vmap(short.lift))(states))
    assert np.linalg.matrix_rank(Z_literal) == np.linalg.matrix_rank(Z_short) == short.size
    # Each literal column is one of the short ones, with a sign.
    signs = [Z_short.T, -Z_short.T]
    for column in Z_literal.T:
        assert any((column == known).all() for known in np.concatenate(signs))


def test_the_constant_rotation_adds_cosine_and_sine_of_the_pitch():
    x = jnp.array([0.0, 0.3, 0.7, 0.0, 0.0, 0.0])
    dictionary = paper(2, constant_rotation=True)
    z = dict(zip(dictionary.names, np.asarray(dictionary.lift(x)), strict=True))
    assert z["cos(theta) omega^0"] == jnp.cos(0.7)
    assert z["sin(theta) omega^0"] == jnp.sin(0.7)


def test_the_derivative_at_rest_is_finite_and_right():
    lift = jax.jit(paper(ORDER, constant_rotation=True).lift)
    x = jnp.zeros(6)
    jacobian = jax.jit(jax.jacfwd(lift))(x)
    h = 1e-6
    numeric = np.stack([(lift(x + h * e) - lift(x - h * e)) / (2 * h) for e in np.eye(6)], axis=-1)
    # Central differences: truncation h^2 = 1e-12, rounding eps / h = 2e-10.
    np.testing.assert_allclose(jacobian, numeric, rtol=0, atol=1e-9)


def test_order_zero_keeps_the_state_alone():
    assert paper(0).names == ("1", *STATE_NAMES)


def test_a_negative_order_is_refused_by_name():
    with pytest.raises(ValueError, match=r"order .*-1"):
        paper(-1)


def test_the_old_name_of_custom_dictionary_says_the_new_one():
    # An AttributeError would be swallowed by the import statement.
    with pytest.raises(ImportError, match="is now custom_dictionary"):
        from kjax.koopman.observables import own  # noqa: F401
