"""Settings that may change in flight, as MAVLink parameters: their table, their ranges, and how one value changes.

Chosen are those that the next tick can simply use: margins, limits, the arena, time-outs. Whatever shapes state that
is carried from tick to tick (horizon, grids, filters' models, decay rates) and whatever names a peer or a file stays
as it was configured. Ranges are those of the configuration's own types, so they cannot drift apart. Every value
travels as a 32-bit float (MAV_PARAM_TYPE_REAL32).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from companion.config import Config, parse_config
from companion.errors import ConfigError

ID_CHARACTERS = 16  # of a MAVLink parameter name


@dataclass(frozen=True, slots=True)
class Bounds:
    """What the type of a setting admits; an open end is excluded."""

    low: float
    high: float
    low_open: bool = False
    high_open: bool = False

    def __contains__(self, value: float) -> bool:
        above = value > self.low if self.low_open else value >= self.low
        below = value < self.high if self.high_open else value <= self.high
        return above and below  # NaN is in no interval

    def __str__(self) -> str:
        left, right = "(" if self.low_open else "[", ")" if self.high_open else "]"
        return f"{left}{self.low:g}, {self.high:g}{right}"


@dataclass(frozen=True, slots=True)
class Tunable:
    """One parameter: ``section.key`` of the configuration, ``index`` where that is a point (x, y, z)."""

    name: str
    section: str
    key: str
    units: str
    description: str
    index: int | None = None

    @property
    def path(self) -> str:
        """The setting as the configuration file names it."""
        return f"{self.section}.{self.key}" + ("" if self.index is None else f"[{self.index}]")

    @property
    def bounds(self) -> Bounds:
        """Its range, from the configuration's types."""
        return _bounds(self)

    def of(self, config: Config) -> float:
        """Its value in ``config``."""
        value = getattr(getattr(config, self.section), self.key)
        return float(value if self.index is None else value[self.index])


TUNABLES: tuple[Tunable, ...] = (
    Tunable("CA_ACC_MAX", "limits", "acceleration_m_s2", "m/s^2", "largest net acceleration of each axis"),
    Tunable("CA_ARENA_E", "limits", "arena_max", "m", "eastern wall of the arena, local frame", 0),
    Tunable("CA_ARENA_N", "limits", "arena_max", "m", "northern wall", 1),
    Tunable("CA_ARENA_S", "limits", "arena_min", "m", "southern wall", 1),
    Tunable("CA_ARENA_W", "limits", "arena_min", "m", "western wall", 0),
    Tunable("CA_CEILING", "limits", "arena_max", "m", "ceiling, height above the local origin", 2),
    Tunable("CA_CUSHION", "safety", "cushion_m", "m", "distance kept from every obstacle beyond the radii"),
    Tunable("CA_ENG_STREAM", "engage", "stream_s", "s", "setpoints streamed before the external mode is asked for"),
    Tunable("CA_ENG_TIMEOUT", "engage", "timeout_s", "s", "the autopilot's time to enter its external mode"),
    Tunable("CA_FLOOR", "limits", "arena_min", "m", "floor, height above the local origin", 2),
    Tunable("CA_KAPPA", "safety", "kappa", "1", "predicted sigmas kept beyond the cushion"),
    Tunable("CA_KAPPA_NOW", "safety", "kappa_now", "1", "sigmas of the present position, on top"),
    Tunable("CA_OBS_MAX_AGE", "obstacles", "max_age_s", "s", "an older obstacle frame is rejected"),
    Tunable("CA_OBS_SILENT", "obstacles", "silent_s", "s", "a required source silent for longer leads to HOLD"),
    Tunable("CA_RADIUS", "safety", "drone_radius_m", "m", "radius of the vehicle itself"),
    Tunable("CA_SIG_CAP", "safety", "sigma_cap_m", "m", "the sigma part of the distance grows no further"),
    Tunable("CA_SIG_DELAY", "safety", "sigma_delay_s", "s", "1 sigma of the delay, times the relative speed"),
    Tunable("CA_SIG_GROWTH", "safety", "sigma_growth_s", "s", "predicted sigma counts up to this far ahead"),
    Tunable("CA_SPEED_MAX", "limits", "speed_m_s", "m/s", "speed limit"),
)
BY_NAME: Mapping[str, Tunable] = {tunable.name: tunable for tunable in TUNABLES}


def values(config: Config) -> dict[str, float]:
    """Every parameter's value in ``config``."""
    return {tunable.name: tunable.of(config) for tunable in TUNABLES}


def changed(config: Config, new: Mapping[str, float], *, source: str = "parameters") -> Config:
    """``config`` with the parameters of ``new``, all at once, checked as a configuration file is.

    Raises:
        ConfigError: an unknown name, a value out of range or not finite, or a combination that cannot be flown;
            one line that names ``source`` and the parameter or setting.
    """
    raw: dict[str, Any] = msgspec.to_builtins(config)
    for name, value in new.items():
        tunable = BY_NAME.get(name)
        if tunable is None:
            raise ConfigError(f"{source}: {name}: expected one of the parameters {', '.join(BY_NAME)}")
        if isinstance(value, bool) or not isinstance(value, int | float) or value not in tunable.bounds:
            raise ConfigError(f"{source}: {name}: expected a number in {tunable.bounds}, got {value!r}")
        table = raw[tunable.section]
        if tunable.index is None:
            table[tunable.key] = float(value)
        else:
            point = list(table[tunable.key])
            point[tunable.index] = float(value)
            table[tunable.key] = point
    return parse_config(raw, source=source)


def only_tunables_differ(one: Config, other: Config) -> bool:
    """Whether the two agree in everything that may not change in flight."""
    return _with(one, values(other)) == other


def as_float32(value: float) -> float:
    """The number that a parameter message can carry for ``value``."""
    return float(np.float32(value))


def from_float32(value: float) -> float:
    """The shortest decimal that a float32 stands for: 0.1, not 0.10000000149011612.

    >>> from_float32(0.10000000149011612)
    0.1
    """
    return float(str(np.float32(value))) if math.isfinite(value) else value


def reference() -> str:
    """The table as Markdown, for docs/reference/parameters.md."""
    default = Config()
    lines = [
        "| parameter | setting | range | default | units | meaning |",
        "|---|---|---|---|---|---|",
    ]
    lines += [
        f"| `{t.name}` | `{t.path}` | {t.bounds} | {t.of(default):g} | {t.units} | {t.description} |" for t in TUNABLES
    ]
    return "\n".join(lines) + "\n"


def _with(config: Config, new: Mapping[str, float]) -> Config:
    """``config`` with other values, unchecked."""
    sections: dict[str, Any] = {}
    for name, value in new.items():
        tunable = BY_NAME[name]
        section = sections.get(tunable.section, getattr(config, tunable.section))
        held: Any = value
        if tunable.index is not None:
            point = list(getattr(section, tunable.key))
            point[tunable.index] = value
            held = tuple(point)
        sections[tunable.section] = msgspec.structs.replace(section, **{tunable.key: held})
    return msgspec.structs.replace(config, **sections)


def _bounds(tunable: Tunable) -> Bounds:
    section = type(getattr(Config(), tunable.section))
    info = msgspec.inspect.type_info(section)
    assert isinstance(info, msgspec.inspect.StructType)
    kind = next(field.type for field in info.fields if field.name == tunable.key)
    if isinstance(kind, msgspec.inspect.TupleType):
        kind = kind.item_types[tunable.index or 0]
    assert isinstance(kind, msgspec.inspect.FloatType)
    low, high = (kind.gt if kind.ge is None else kind.ge), (kind.lt if kind.le is None else kind.le)
    assert low is not None
    assert high is not None
    return Bounds(float(low), float(high), kind.ge is None, kind.le is None)
