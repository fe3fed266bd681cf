"""What ``[koopman]`` of a config becomes, and how its mistakes are named."""

import pytest

from kjax import ConfigError, RunConfig, load_config
from kjax.config import DatasetConfig, KoopmanConfig
from kjax.controllers.resolve import resolve
from kjax.controllers.resolve_model import (
    dataset_spec,
    koopman_keys,
    model_choice,
    resolve_model,
)
from kjax.prediction.kind import ModelChoice


def test_the_defaults_of_a_config_are_those_of_the_specs():
    assert model_choice(KoopmanConfig()) == ModelChoice()


def test_every_key_reaches_the_choice():
    dataset = DatasetConfig(
        rollouts=7, duration=0.02, dt=0.002, hold=3, height=0.3, state_range=(1, 2, 3, 4, 5, 6),
        force_x=8.0, force_z=(9.0, 10.0), feet_range=(0.1, 0.2), seed=5,
    )  # fmt: skip
    choice = model_choice(
        KoopmanConfig(
            model="residual", file="a.npz", dictionary="fourier", order=2, fourier_count=3,
            fourier_scale=2.0, fourier_seed=4, constant_rotation=True, feet="measured",
            dataset=dataset,
        )
    )  # fmt: skip
    default = ModelChoice()
    for name in ("model", "file", "measured_feet"):
        assert getattr(choice, name) != getattr(default, name), name
    for part in ("dictionary", "dataset"):
        for name in vars(getattr(default, part)):
            new, old = (getattr(getattr(one, part), name) for one in (choice, default))
            assert new != old, name
    assert choice.dataset == dataset_spec(dataset)
    assert choice.dataset.steps == 10


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        ({"model": "linar"}, r"koopman\.model: got 'linar', .* did you mean 'linear'"),
        ({"model": "residual"}, r"koopman\.file: model = 'residual' needs a file"),
        ({"model": "exact", "file": "a.npz"}, r"koopman\.file: model = 'exact' takes no file"),
        ({"model": "learned", "file": "none.npz"}, r"koopman\.file: cannot read 'none\.npz'"),
        ({"model": "learned", "file": "."}, r"koopman\.file: '\.' is no file"),
    ],
)
def test_a_model_that_cannot_be_used_is_named_by_its_key(keys, text):
    with pytest.raises(ConfigError, match=text):
        resolve_model(KoopmanConfig(**keys))


@pytest.mark.parametrize(("model", "duration"), [("linear", 0.01), ("bilinear", 0.03)])
def test_a_config_with_too_few_samples_names_its_key(model, duration):
    keys = {"koopman.dataset.rollouts": 1, "koopman.dataset.duration": duration}
    with pytest.raises(ConfigError, match=rf"^koopman\.dataset: rollouts 1 of duration {duration}"):
        resolve(load_config(RunConfig, None, {"koopman.model": model, **keys}))


def test_an_error_that_is_not_of_the_model_stays_what_it_is():
    with pytest.raises(ValueError, match=r"^horizon: must") as caught, koopman_keys():
        raise ValueError("horizon: must be at least 1")
    assert type(caught.value) is ValueError
