"""NumPy for what is known, JAX for what is traced; what is known compiles next to nothing."""

import jax
import jax.numpy as jnp
import numpy as np

from kjax import RunConfig
from kjax.concrete import array_library, is_concrete, stacked
from kjax.controllers.resolve import gather
from kjax.controllers.resolve_fits import fit_models
from kjax.robots import go1


def test_the_library_follows_the_values():
    assert array_library(1.0, [np.ones(2)], None) is np
    assert array_library(1.0, {"a": jnp.ones(2)}) is jnp
    assert jax.jit(lambda x: float(array_library(x) is jnp) * x)(2.0) == 2.0


def test_traced_values_are_not_concrete():
    assert is_concrete((1.0, jnp.ones(2)))
    assert jax.jit(lambda x: x * is_concrete(x))(1.0) == 0.0


def test_stacked_nests_and_has_derivatives():
    made = stacked([[1, 2.0], [3, (4.0)]])
    np.testing.assert_array_equal(made, [[1.0, 2.0], [3.0, 4.0]])
    assert made.dtype == float
    slope = jax.grad(lambda x: stacked([[x, 2.0], [x, x]]).sum())(1.0)
    assert slope == 3.0


def test_parameters_of_a_known_config_compile_nothing():
    config = RunConfig()
    with jax.enable_x64(True):
        fits = fit_models(config, go1.PARAMS)
    compiled = []

    def count(name, seconds, **more):
        if name.endswith("backend_compile_duration"):
            compiled.append(more.get("fun_name"))

    jax.monitoring.register_event_duration_secs_listener(count)
    try:
        gather(config, go1.PARAMS, fits)
    finally:
        jax.monitoring.unregister_event_duration_listener(count)
    assert compiled == []
