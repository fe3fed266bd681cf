"""Kinds of prediction models: found by name, and one of one's own needs no change of kjax."""

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
    import sys
    import types

    module = types.ModuleType("my_models")
    module.OWN = OWN
    monkeypatch.setitem(sys.modules, "my_models", module)
    plans = []
    for name in ("srb", "my_models:OWN"):
        keys = {"koopman.model": name, "lmpc.model_dt": 0.02, "lmpc.horizon": 4}
        config = load_config(RunConfig, None, keys | {"sim.base": "planar"})
        assert get_kind(name).is_body
        assert build_family(controller_spec(config).model).name == "srb"
        spec, params = resolve(config)
        controller, tables = build_controller(spec), condense(spec, params)
        seen = standing(jnp.asarray(stand_pose(go1.PARAMS, 0.265)[1]))
        state, info = controller.plan(tables, controller.init(tables, seen), seen)
        assert int(info.status) == 0
        plans.append(np.asarray(state.force))
    assert np.abs(plans[0]).max() > 30.0
    np.testing.assert_array_equal(plans[0], plans[1])
