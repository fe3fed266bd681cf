"""Configuration: frozen dataclasses filled from TOML; a wrong key or value is one clear line.

Every field's docstring ends with its unit in brackets; ``--help`` of the experiments shows them.
"""

from kjax.config.checks import Tunable
from kjax.config.control import (
    CommandConfig,
    GaitScheduleConfig,
    LateralConfig,
    LegConfig,
    LmpcConfig,
    MultiPhaseConfig,
    SpatialConfig,
)
from kjax.config.gaits import GaitConfig, Gaits
from kjax.config.loading import ConfigError, Overlay, fields, load_config, to_dict, tunable
from kjax.config.model import DatasetConfig, KoopmanConfig, SrbConfig
from kjax.config.run import FitStudyConfig, RunConfig
from kjax.config.simulation import NoiseConfig, PushConfig, SimConfig, TerrainConfig
from kjax.config.sweep import AxisConfig, FigureConfig, SweepConfig
from kjax.moved import moved_names

__all__ = [
    "AxisConfig",
    "CommandConfig",
    "ConfigError",
    "DatasetConfig",
    "FigureConfig",
    "FitStudyConfig",
    "GaitConfig",
    "GaitScheduleConfig",
    "Gaits",
    "KoopmanConfig",
    "LateralConfig",
    "LegConfig",
    "LmpcConfig",
    "MultiPhaseConfig",
    "NoiseConfig",
    "Overlay",
    "PushConfig",
    "RunConfig",
    "SimConfig",
    "SpatialConfig",
    "SrbConfig",
    "SweepConfig",
    "TerrainConfig",
    "Tunable",
    "fields",
    "load_config",
    "to_dict",
    "tunable",
]


__getattr__ = moved_names(__name__)
