"""From ``[koopman]`` of a config to what a prediction model is made from."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields

from kjax.config import ConfigError, DatasetConfig, KoopmanConfig
from kjax.koopman.dataset import DatasetSpec
from kjax.prediction.build import model_spec
from kjax.prediction.kind import ModelChoice
from kjax.spec import DictionarySpec, ModelSpec


def resolve_model(koopman: KoopmanConfig) -> ModelSpec:
    """What shapes the program of a config's model.

    Raises:
      ConfigError: for a model that there is not, or a file that cannot be used.
    """
    with koopman_keys():
        return model_spec(model_choice(koopman))


def model_choice(koopman: KoopmanConfig) -> ModelChoice:
    """The model of a config, and what its parameters come from."""
    names = [field.name for field in fields(DictionarySpec)]
    return ModelChoice(
        model=koopman.model,
        file=koopman.file,
        dictionary=DictionarySpec(**{name: getattr(koopman, name) for name in names}),
        dataset=dataset_spec(koopman.dataset),
        measured_feet=koopman.feet == "measured",
    )


def dataset_spec(dataset: DatasetConfig) -> DatasetSpec:
    """The training data of a config; its seed becomes the random key."""
    names = [field.name for field in fields(DatasetSpec)]
    return DatasetSpec(**{name: getattr(dataset, name) for name in names})


@contextmanager
def koopman_keys() -> Iterator[None]:
    """Turn the ValueError of a ``ModelChoice`` into a ConfigError that names the config's key.

    Its message begins with the name of the field, which ``[koopman]`` has too.
    """
    try:
        yield
    except ValueError as error:
        name = str(error).partition(":")[0]
        if name not in ("model", "file", "dataset"):
            raise
        raise ConfigError(f"koopman.{error}") from None
