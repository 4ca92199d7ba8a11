"""Scenario files: TOML decoded once into frozen typed values; `placement.resolve` makes them concrete with a seed.

An unknown key, a wrong type or a value out of range is a `ScenarioError` of one line that names file and key.
A motion is placed either by its own origin or by ``cross_point`` and ``cross_at_s``: it then passes that point that
long after the obstacles' start (which is the vehicle's entry into offboard).
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import msgspec
from msgspec import Meta, Struct

from sim_bridge.errors import ScenarioError
from sim_bridge.physics import control_steps

Coordinate = Annotated[float, Meta(ge=-1e3, le=1e3)]
Point: TypeAlias = tuple[Coordinate, Coordinate, Coordinate]
Positive = Annotated[float, Meta(gt=0.0, le=1e4)]
NonNegative = Annotated[float, Meta(ge=0.0, le=1e4)]
Probability = Annotated[float, Meta(ge=0.0, le=1.0)]
Name = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_-]{1,32}$")]
Tick = Annotated[int, Meta(ge=0, le=10_000_000)]

BUILTIN = (Path(__file__).parent / "configs", Path(__file__).parent.parent / "configs")  # installed, checkout


class Vehicle(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    start: Point = (0.0, 0.0, 0.2)  # centre of the vehicle, local ENU [m]; 0.2 stands on the ground
    yaw_deg: Annotated[float, Meta(ge=-360.0, le=360.0)] = 0.0  # counter-clockwise from east
    takeoff_altitude_m: Annotated[float, Meta(ge=0.5, le=80.0)] = 1.5

    @property
    def yaw_rad(self) -> float:
        return math.radians(self.yaw_deg)


class Target(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    position: Point


class Jitter(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Half widths of the uniform draws of a seed."""

    position_m: tuple[NonNegative, NonNegative, NonNegative] = (0.0, 0.0, 0.0)  # of the origin or crossing point
    time_s: NonNegative = 0.0  # of cross_at_s
    yaw_deg: NonNegative = 0.0  # the whole motion about the vertical through its origin or crossing point


class _Placed(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="motion"):
    """What every obstacle states."""

    id: Name
    radius_m: Positive = 0.2
    origin: Point | None = None
    cross_point: Point | None = None
    cross_at_s: NonNegative | None = None
    jitter: Jitter = Jitter()


class StaticObstacle(_Placed, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="static"):
    pass


class LinearObstacle(_Placed, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="linear"):
    velocity: Point  # [m/s]


class AcceleratedObstacle(_Placed, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="accelerated"):
    velocity: Point  # at the start [m/s]
    acceleration: Point  # [m/s^2]


class EightObstacle(_Placed, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="figure_eight"):
    """A lemniscate whose ``origin`` is its centre; ``cross_phase_deg`` is its phase at the crossing, 0 the centre."""

    size_m: Positive  # reach along its axis; half of it across
    period_s: Positive
    phase_deg: float | None = None
    cross_phase_deg: float = 0.0
    axis_yaw_deg: float = 90.0
    tilt_deg: Annotated[float, Meta(ge=-180.0, le=180.0)] = 0.0


Obstacle: TypeAlias = StaticObstacle | LinearObstacle | AcceleratedObstacle | EightObstacle


class SensorSpec(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An external sensor that sees every obstacle."""

    source: Name = "sim"
    rate_hz: Annotated[float, Meta(gt=0.0, le=1000.0)] = 20.0
    sigma_m: NonNegative = 0.05  # of each axis
    latency_s: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.05
    dropout: Probability = 0.05  # of one obstacle of one frame
    frame_dropout: Probability = 0.0  # of a whole frame


class OperatorStep(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the operator does, and when in lockstep: at a tick, or at the first tick at which a condition holds."""

    do: Literal["arm", "takeoff", "engage", "release", "hold", "land", "disarm"]
    at_tick: Tick | None = None
    after: Literal["airborne_hover", "on_ground", "end"] | None = None


class End(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The run ends when the target is reached (passed within ``reach_m``, then within ``hold_m`` for ``hold_s``),
    ``collision_s`` after a touch, or ``timeout_s`` after the vehicle entered offboard. ``stop`` false: never."""

    reach_m: Positive = 0.1
    hold_m: Positive = 0.3
    hold_s: Positive = 3.0
    timeout_s: Positive = 60.0
    collision_s: NonNegative = 1.0
    stop: bool = True


_STEPS = (
    OperatorStep(do="arm", at_tick=0),
    OperatorStep(do="takeoff", at_tick=1),
    OperatorStep(do="engage", after="airborne_hover"),
)


class Scenario(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    description: str = ""
    physics_hz: Annotated[int, Meta(ge=1, le=10_000)] = 240
    control_hz: Annotated[int, Meta(ge=1, le=1000)] = 20
    vehicle: Vehicle = Vehicle()
    target: Target | None = None
    obstacles: tuple[Obstacle, ...] = ()
    sensors: tuple[SensorSpec, ...] = (SensorSpec(),)
    operator: tuple[OperatorStep, ...] = _STEPS
    end: End = End()


def load_scenario(name_or_path: str) -> tuple[str, Scenario]:
    """A shipped scenario by name, or any TOML file by path; returns its name and content.

    Raises:
        ScenarioError: one line ``file: key: expectation``.
    """
    path = _find(name_or_path)
    try:
        raw = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read ({error.strerror}), expected a TOML file") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{path}: not TOML: {error}") from None
    return path.stem, parse_scenario(raw, source=str(path))


def parse_scenario(raw: Mapping[str, Any], *, source: str) -> Scenario:
    """A scenario from decoded TOML; ``source`` names the file in errors."""
    try:
        scenario = msgspec.convert(raw, Scenario)
    except msgspec.ValidationError as error:
        raise ScenarioError(f"{source}: {_pointed(str(error))}") from None
    for key, value in _numbers(raw, ""):
        if not math.isfinite(value):
            raise ScenarioError(f"{source}: {key}: expected a finite number, got {value}")
    try:
        control_steps(scenario.physics_hz, scenario.control_hz)
    except ScenarioError as error:
        raise ScenarioError(f"{source}: {error}") from None
    _check_names(scenario, source)
    for index, obstacle in enumerate(scenario.obstacles):
        _check_placing(obstacle, f"{source}: obstacles[{index}]")
    for index, step in enumerate(scenario.operator):
        if (step.at_tick is None) == (step.after is None):
            raise ScenarioError(f"{source}: operator[{index}]: expected exactly one of at_tick and after")
    return scenario


def _find(name_or_path: str) -> Path:
    if "/" in name_or_path or name_or_path.endswith(".toml"):
        return Path(name_or_path)
    known = {path.stem: path for folder in BUILTIN if folder.is_dir() for path in sorted(folder.glob("*.toml"))}
    known.pop("default", None)  # the daemon's configuration
    if name_or_path not in known:
        raise ScenarioError(f"scenario {name_or_path}: expected a TOML file or one of {', '.join(sorted(known))}")
    return known[name_or_path]


def _pointed(message: str) -> str:
    """``Expected `float`... - at `$.end.reach_m` `` -> ``end.reach_m: Expected `float`...``."""
    text, _, path = message.rpartition(" - at `$")
    key = path.rstrip("`").lstrip(".")
    return f"{key}: {text}" if text and key else text or message


def _numbers(value: Any, key: str) -> list[tuple[str, float]]:
    if isinstance(value, Mapping):
        return [pair for k, item in value.items() for pair in _numbers(item, f"{key}.{k}" if key else str(k))]
    if isinstance(value, list | tuple):
        return [pair for i, item in enumerate(value) for pair in _numbers(item, f"{key}[{i}]")]
    return [(key, value)] if isinstance(value, float) else []


def _check_names(scenario: Scenario, source: str) -> None:
    for key, names in (
        ("obstacles", [o.id for o in scenario.obstacles]),
        ("sensors", [s.source for s in scenario.sensors]),
    ):
        twice = next((name for i, name in enumerate(names) if name in names[:i]), None)
        if twice is not None:
            raise ScenarioError(f"{source}: {key}: expected different names, got {twice} twice")


def _check_placing(obstacle: Obstacle, at: str) -> None:
    crossing = obstacle.cross_point is not None
    if crossing == (obstacle.origin is not None):
        raise ScenarioError(f"{at}: expected exactly one of origin and cross_point")
    if crossing != (obstacle.cross_at_s is not None):
        raise ScenarioError(f"{at}: expected cross_at_s with cross_point, and only with it")
    if crossing and isinstance(obstacle, EightObstacle) and obstacle.phase_deg is not None:
        raise ScenarioError(f"{at}: expected cross_phase_deg instead of phase_deg with cross_point")
