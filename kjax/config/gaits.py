"""Gaits as data: when each leg stands, and how the LMPC and the legs walk it.

``[gaits.NAME]`` of a config changes an entry of the library or adds one of its own. Any offset,
duty factor and period is a gait: no code knows one by its name.
"""

from collections.abc import Iterable, Iterator, Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, GetCoreSchemaHandler, TypeAdapter, model_validator
from pydantic.dataclasses import dataclass
from pydantic_core import core_schema

from kjax.config.checks import (
    COST,
    DURATION,
    FOOT_DISTANCE,
    FORCE,
    GAIN,
    GRF,
    HEIGHT,
    INPUT_COST,
    LENGTH,
    MIN_GRF,
    OMEGA_COST,
    POSITION_COST,
    STATE_COST,
    STRICT,
    VELOCITY_COST,
    Positive,
    Six,
    Three,
    Tunable,
)

Offset = Annotated[float, Field(ge=0, lt=1)]
Duty = Annotated[float, Field(gt=0, le=1)]
# Weights of the plan in three dimensions, of ``[spatial]`` and of each gait.
SPATIAL_WEIGHTS = ("attitude", "position", "omega", "velocity", "force")


@dataclass(frozen=True, kw_only=True, config=STRICT)
class GaitConfig:
    """A gait; the defaults are the trot's."""

    period: Positive = 0.5
    """Duration of a cycle, flights at full length [s]."""
    offset: tuple[Offset, Offset, Offset, Offset] = (0.0, 0.5, 0.5, 0.0)
    """Touchdown of FR, FL, RR, RL, part of the cycle [-]."""
    duty: tuple[Duty, Duty, Duty, Duty] = (0.5, 0.5, 0.5, 0.5)
    """Duty factor: part of the cycle in which each of them stands [-]."""
    ramp_start: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Length of the flights in the first cycle, as a fraction of the full one [-]."""
    ramp_cycles: Annotated[int, Field(ge=0)] = 0
    """Number of cycles over which the flights grow to their full length [-]."""
    switch_rule: Literal["anywhere", "first_flight", "cycle_end"] = "anywhere"
    """When it may be left: at once, as the first flight of its cycle begins (in a bound Raibert's
    rule: no foot is kicked into the ground that carries no weight), or at the cycle's end [-]."""
    transition_gait: str = ""
    """Name of a gait that is walked for a cycle when this one is left, such as a landing [-]."""
    horizon: Literal["stance", "multiphase"] = "stance"
    """What the prediction covers: the present stance (the paper), or a whole cycle, flights and
    next stances included ([multiphase]) [-]."""
    reference: Literal["constant", "periodic"] = "constant"
    """Reference of height and pitch: constant (the paper), or the cycle's own motion [-]."""
    force_edge: Annotated[float, Field(gt=0, le=0.5), Tunable(low=0.02, high=0.5)] = 0.25
    """Part of a stance in which the periodic reference's force rises, and again falls [-]."""
    body_height: Annotated[float | None, Field(gt=0), HEIGHT, LENGTH] = None
    """Reference height of the centre of mass above the ground, mean of the stances;
    lmpc.body_height if not given [L]."""
    Q: Annotated[Six | None, COST, STATE_COST] = None
    """Weights of the squared errors of (p_x, p_z, theta, v_x, v_z, omega), of a step, or with a
    multi-phase horizon per second; the lmpc's if not given [1/L^2, 1/L^2, 1/rad^2, 1/(g L),
    1/(g L), L/g]."""
    R: Annotated[float | None, Field(gt=0), COST, INPUT_COST] = None
    """Weight of every squared force, likewise [1/(m g)^2]."""
    grf_x_max: Annotated[float | None, Field(ge=0, allow_inf_nan=True), GRF, FORCE] = None
    """Bound of |F_x| per leg, body frame; world frame with a multi-phase horizon; the lmpc's if not
    given [m g]."""
    grf_z_min: Annotated[float | None, Field(allow_inf_nan=True), MIN_GRF, FORCE] = None
    """Lower bound of F_z per leg, likewise [m g]."""
    grf_z_max: Annotated[float | None, Field(allow_inf_nan=True), GRF, FORCE] = None
    """Upper bound of F_z per leg, likewise [m g]."""
    foothold_front: Annotated[float | None, Field(gt=0), FOOT_DISTANCE, LENGTH] = None
    """Distance of the front footholds ahead of the centre of mass, standing still; below the hips
    if not given [L]."""
    foothold_rear: Annotated[float | None, Field(gt=0), FOOT_DISTANCE, LENGTH] = None
    """Distance of the rear footholds behind the centre of mass, likewise [L]."""
    foothold_gain: Annotated[float | None, Field(ge=0), GAIN, DURATION] = None
    """Raibert gain on the velocity error in the foothold; leg.foothold_gain if not given
    [sqrt(L/g)]."""
    swing_height: Annotated[float | None, Field(gt=0), LENGTH] = None
    """Height of the swing's apex above the higher of lift-off and target; leg.swing_height if not
    given [L]."""
    attitude: Annotated[Three | None, COST] = None
    """Weights of the squared errors of roll, pitch and yaw of the plan in three dimensions, per
    second; spatial.attitude if not given, as the four below [1/rad^2]."""
    position: Annotated[Three | None, COST, POSITION_COST] = None
    """Of the centre of mass's place [1/L^2]."""
    omega: Annotated[Three | None, COST, OMEGA_COST] = None
    """Of the angular velocity [L/g]."""
    velocity: Annotated[Three | None, COST, VELOCITY_COST] = None
    """Of the centre of mass's velocity [1/(g L)]."""
    force: Annotated[float | None, Field(gt=0), COST, INPUT_COST] = None
    """Of every squared force's distance from the gait's mean force [1/(m g)^2]."""

    @model_validator(mode="after")
    def _check(self) -> "GaitConfig":
        if (self.foothold_front is None) != (self.foothold_rear is None):
            raise ValueError(
                "foothold_front and foothold_rear belong together: give both or neither"
            )
        if self.horizon == "multiphase":
            for key in ("foothold_front", "foothold_rear", "Q", "R"):
                if getattr(self, key) is None:  # the lmpc's weights are of a step, not per second
                    raise ValueError(f"horizon = 'multiphase' needs {key}")
        return self


_BOUND: dict[str, Any] = {
    "period": 0.35,
    "offset": (0.0, 0.0, 4 / 7, 4 / 7),  # the paper's: 100 ms, flight of 100, 50, flight of 100
    "duty": (2 / 7, 2 / 7, 1 / 7, 1 / 7),
    "ramp_start": 0.3,
    "ramp_cycles": 10,
    "switch_rule": "first_flight",
    "reference": "periodic",
    "body_height": 0.6338,
    "Q": (196.7, 219.8, 60.0, 12.79, 12.75, 2.303),
    "R": 0.008908,
    "grf_x_max": 0.412,
    "grf_z_min": 0.16,  # a foot that carries no weight slips
    "grf_z_max": 2.4,
    "foothold_front": 0.1761,
    "foothold_rear": 0.3474,
    "foothold_gain": 0.3599,
    "swing_height": 0.1502,
    # Pitch is the gait's own; a roll has only the time of a short stance to be stopped in.
    "attitude": (60.0, 4.0, 30.0),
    "position": (0.7, 0.1, 9.0),
    "omega": (2.3, 0.5, 2.3),
    "velocity": (15.0, 1.0, 2.0),
    "force": 0.0781,
}

LIBRARY: dict[str, GaitConfig] = {
    "trot": GaitConfig(),
    "flying_trot": GaitConfig(period=0.6, duty=(5 / 12,) * 4),
    "bound": GaitConfig(**_BOUND),
    "bound_multiphase": GaitConfig(
        **_BOUND
        | {
            "horizon": "multiphase",
            "Q": (11.54, 34.48, 10.4, 121.2, 6.561, 5.066),
            "R": 0.822,
            "grf_x_max": 0.7199,
            "grf_z_min": 0.07999,
            "grf_z_max": 2.72,
            "foothold_front": 0.1106,
            "foothold_rear": 0.435,
            "body_height": 0.7066,
            "foothold_gain": 0.4199,
            "swing_height": 0.1643,
        }
    ),
    "stand": GaitConfig(period=1.0, duty=(1.0,) * 4),
    "landing": GaitConfig(period=0.05, duty=(1.0,) * 4, switch_rule="cycle_end"),
    "pace": GaitConfig(period=0.2, offset=(0.0, 0.5, 0.0, 0.5)),
    "pronk": GaitConfig(
        period=0.25,
        offset=(0.0,) * 4,
        duty=(0.6,) * 4,
        ramp_start=0.3,
        ramp_cycles=6,
        reference="periodic",
    ),
    "walk": GaitConfig(period=0.8, offset=(0.5, 0.0, 0.25, 0.75), duty=(0.75,) * 4),
}


class Gaits(Mapping[str, GaitConfig]):
    """The gaits of a config, by name; an immutable, hashable mapping. ``gaits.trot`` works too."""

    def __init__(self, entries: Mapping[str, GaitConfig] | None = None):
        """The library, with these entries in place of, or besides, its own."""
        self._entries = LIBRARY | dict(entries or {})

    def __getitem__(self, name: str) -> GaitConfig:
        """The gait of that name; ``KeyError`` if there is none."""
        return self._entries[name]

    def __getattr__(self, name: str) -> GaitConfig:
        """Likewise, ``AttributeError``."""
        try:
            return self.__dict__["_entries"][name]
        except KeyError:
            raise AttributeError(name) from None

    def __iter__(self) -> Iterator[str]:
        """Names."""
        return iter(self._entries)

    def __len__(self) -> int:
        """Number of gaits."""
        return len(self._entries)

    def __hash__(self) -> int:
        """Of names and entries."""
        return hash(tuple(self._entries.items()))

    def __eq__(self, other: object) -> bool:
        """Whether all entries are equal, in the same order."""
        if not isinstance(other, Gaits):
            return NotImplemented
        return list(self._entries.items()) == list(other._entries.items())

    def __repr__(self) -> str:
        """Only what differs from the library."""
        return f"Gaits({self.changed()!r})"

    def changed(self) -> dict[str, GaitConfig]:
        """Entries that are not the library's."""
        return {k: v for k, v in self._entries.items() if LIBRARY.get(k) != v}

    @classmethod
    def __get_pydantic_core_schema__(
        cls, source: Any, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        """Read from tables by name, which ``on_library`` has filled up; written likewise."""
        table = core_schema.dict_schema(
            core_schema.str_schema(), handler.generate_schema(GaitConfig)
        )
        read = core_schema.no_info_after_validator_function(cls, table)
        return core_schema.json_or_python_schema(
            json_schema=read,
            python_schema=core_schema.union_schema([core_schema.is_instance_schema(cls), read]),
            serialization=core_schema.plain_serializer_function_ser_schema(
                lambda gaits: {name: _dump(own) for name, own in gaits.changed().items()}
            ),
        )


def on_library(tables: Any) -> Any:
    """``[gaits]`` of a file, each table on top of the library's entry of that name."""
    if not isinstance(tables, Mapping):
        return tables
    return {
        name: _dump(LIBRARY[name]) | dict(own)
        if name in LIBRARY and isinstance(own, Mapping)
        else own
        for name, own in tables.items()
    }


def gait_setting(config: Any, name: str, key: str) -> Any:
    """A gait's own value, or that of ``[lmpc]``, ``[leg]`` or ``[spatial]`` where it gives none.

    Args:
      config: of a run, or an ``Overlay``.
      name: of the gait.
      key: of ``GaitConfig``.
    """
    own = getattr(config.gaits[name], key)
    return getattr(getattr(config, _fallback(key)), key) if own is None else own


def setting_key(config: Any, name: str, key: str) -> str:
    """The dotted key that ``gait_setting`` reads, for errors."""
    own = getattr(config.gaits[name], key)
    return f"{_fallback(key)}.{key}" if own is None else f"gaits.{name}.{key}"


def _fallback(key: str) -> str:
    if key in ("swing_height", "foothold_gain"):
        return "leg"
    return "spatial" if key in SPATIAL_WEIGHTS else "lmpc"


def reachable_gaits(gaits: Gaits, names: Iterable[str]) -> list[str]:
    """Names of gaits, and of those that they are left through, each once, in order."""
    out = list(dict.fromkeys(names))
    for name in out:  # which grows on the way
        through = gaits[name].transition_gait
        if through and through not in out:
            out.append(through)
    return out


def dump_used(gaits: Gaits, names: Iterable[str]) -> dict[str, Any]:
    """Plain data of the gaits that are used, or are not the library's."""
    return {name: _dump(gaits[name]) for name in dict.fromkeys([*names, *gaits.changed()])}


def _dump(gait: GaitConfig) -> dict[str, Any]:
    return TypeAdapter(GaitConfig).dump_python(gait, mode="json")
