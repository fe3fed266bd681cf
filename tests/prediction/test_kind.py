"""Kinds of prediction models: found by name, and one of one's own needs no change of kjax."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax import ConfigError, RunConfig, build_controller, condense, load_config, resolve
from kjax.controllers.resolve import controller_spec
from kjax.legs.posture import stand_pose, standing
from kjax.prediction import families
from kjax.prediction.build import build_family
from kjax.prediction.kind import ModelKind, get_kind, model_kinds
from kjax.robots import go1

# The rigid body again, under another name: its plans must be those of "srb".
OWN = ModelKind(
    family=lambda spec: families.rigid_body(spec.dt),
    params=lambda choice, bodies: (
        families.BodyModel(bodies.body, bodies.alpha), jnp.zeros((len(bodies.modes), 6))
    ),
    is_body=True,
)  # fmt: skip


def test_the_kinds_of_kjax():
    assert set(model_kinds()) >= {
        "linear", "bilinear", "srb_hover", "srb", "planted", "exact", "residual", "learned"
    }  # fmt: skip
    for name in model_kinds():
        if name in ("residual", "learned"):
            assert get_kind(name).takes_file
    assert not get_kind("linear").takes_file


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        ({"koopman.model": "linar"}, r"koopman\.model: got 'linar', .* did you mean 'linear'"),
        ({"koopman.model": "no_module:KIND"}, r"koopman\.model: 'no_module:KIND' cannot be loaded"),
        ({"koopman.model": "kjax.types:Mode"}, r"is a EnumType, wanted a ModelKind"),
        ({"koopman.model": "residual"}, r"koopman\.file: model = 'residual' needs a file"),
        ({"koopman.model": "srb", "koopman.file": "a.npz"}, r"model = 'srb' takes no file"),
    ],
)
def test_a_model_that_there_is_not_is_refused(keys, text):
    with pytest.raises(ConfigError, match=text):
        resolve(load_config(RunConfig, None, keys))


def test_a_kind_of_ones_own_plans_as_one_of_kjax(monkeypatch):
    plans = []
    for name in ("srb", own_kind(monkeypatch)):
        keys = {"koopman.model": name, "lmpc.model_dt": 0.02, "lmpc.horizon": 4}
        config = load_config(RunConfig, None, keys | {"sim.base": "planar"})
        assert get_kind(name).is_body
        assert build_family(controller_spec(config).model).name == "srb"
        spec, params = resolve(config)
        controller, tables = build_controller(spec), condense(spec, params)
        seen = standing(jnp.asarray(stand_pose(go1.PARAMS, 0.265)[1]))
        start = jax.jit(controller.init)(tables, seen)
        state, info = jax.jit(controller.plan)(tables, start, seen)
        assert int(info.status) == 0
        plans.append(np.asarray(state.force))
    assert np.abs(plans[0]).max() > 30.0
    np.testing.assert_array_equal(plans[0], plans[1])


def own_kind(monkeypatch, **changes):
    """The name of ``OWN`` with these fields changed."""
    import sys
    import types

    module = types.ModuleType("my_models")
    module.OWN = OWN._replace(**changes)
    monkeypatch.setitem(sys.modules, "my_models", module)
    return "my_models:OWN"


def faulty(leaf=None, spread=None):
    """``OWN.params`` with another leaf or spread, made from the number of modes."""

    def params(choice, bodies):
        made, own = OWN.params(choice, bodies)
        if leaf is not None:
            made = made._replace(alpha=leaf(len(bodies.modes)))
        return made, own if spread is None else spread(len(bodies.modes))

    return params


@pytest.mark.parametrize(
    ("params", "text"),
    [
        (faulty(lambda n: jnp.ones((n - 1, 2))), r"shape \(\d+, 2\), .* leading axis of \d+"),
        (faulty(lambda n: jnp.asarray(0.5)), r"shape \(\), .* leading axis of \d+"),
        (faulty(spread=lambda n: jnp.zeros((n, 5))), r"\(\d+, 6\), .* got .* shape \(\d+, 5\)"),
        (faulty(spread=lambda n: jnp.zeros((6,))), r"\(\d+, 6\), .* got .* shape \(6,\)"),
        (lambda choice, bodies: (OWN.params(choice, bodies)[0], None), r"spread .* got NoneType"),
    ],
)
def test_parameters_of_another_number_of_modes_are_refused(monkeypatch, params, text):
    name = own_kind(monkeypatch, params=params)
    with pytest.raises(ConfigError, match=rf"koopman\.model: my_models:OWN: .*{text}"):
        resolve(load_config(RunConfig, None, {"koopman.model": name}))


def test_a_model_loaded_again_is_fitted_again(monkeypatch):
    """In a notebook a module is edited and loaded again under its old name."""
    masses = []
    for factor in (1.0, 1.5):

        def params(choice, bodies, factor=factor):
            made, spread = OWN.params(choice, bodies)
            return made._replace(body=made.body._replace(mass=factor * made.body.mass)), spread

        name = own_kind(monkeypatch, params=params)
        keys = {"koopman.model": name, "lmpc.model_dt": 0.02, "lmpc.horizon": 4}
        fits = resolve(load_config(RunConfig, None, keys))[1].fits
        masses.append(np.asarray(fits.prediction.params.body.mass))
    np.testing.assert_allclose(masses[1], 1.5 * masses[0], rtol=1e-12)


@pytest.mark.parametrize(
    ("names", "told"), [(["bound_multiphase"], True), (["trot", "bound_multiphase"], False)]
)
def test_a_model_that_no_gait_predicts_with_is_said(names, told):
    keys = {
        "koopman.model": "srb",
        "gait.names": names,
        "gait.times": [float(i) for i in range(len(names))],
    }
    config = load_config(RunConfig, None, keys)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        resolve(config)
    text = [str(one.message) for one in said if "koopman.model" in str(one.message)]
    assert len(text) == told
    if told:
        assert "bound_multiphase" in text[0]
        assert "multiphase" in text[0]


def test_in_three_dimensions_none_of_them_is_fitted_and_that_is_said():
    keys = {"controller": "spatial", "sim.base": "free", "koopman.model": "srb"}
    with pytest.warns(UserWarning, match="koopman.model = 'srb' has no effect"):
        spec, params = resolve(load_config(RunConfig, None, keys))
    assert params.fits is None
    assert condense(spec, params).lmpc is None
