"""Scenario files: TOML decoded once into frozen typed values; `placement.resolve` makes them concrete with a seed.

An unknown key, a wrong type or a value out of range is a `ScenarioError` of one line that names file and key.
The tables live in modules of their own: `scenario_obstacles`, `scenario_world` ([physics]) and `scenario_faults`
([[faults]] and [expect]); `scenario_checks` holds what one table demands of another.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import msgspec
from msgspec import Meta

from sim_bridge.errors import ScenarioError
from sim_bridge.physics import control_steps
from sim_bridge.scenario_checks import check
from sim_bridge.scenario_errors import pointed
from sim_bridge.scenario_faults import Expectation, Fault
from sim_bridge.scenario_obstacles import (
    AcceleratedObstacle,
    CircleObstacle,
    EightObstacle,
    Jitter,
    LinearObstacle,
    Obstacle,
    PursuitObstacle,
    SplineObstacle,
    StaticObstacle,
    TrackObstacle,
    WaypointsObstacle,
)
from sim_bridge.scenario_types import (
    Coordinate,
    Degrees,
    Name,
    NonNegative,
    Point,
    Positive,
    Probability,
    Table,
    Tick,
)
from sim_bridge.scenario_world import Physics

__all__ = [
    "BUILTIN",
    "AcceleratedObstacle",
    "CircleObstacle",
    "Coordinate",
    "EightObstacle",
    "End",
    "Expectation",
    "Fault",
    "Jitter",
    "LinearObstacle",
    "Obstacle",
    "OperatorStep",
    "Physics",
    "Point",
    "PursuitObstacle",
    "Scenario",
    "SensorSpec",
    "SplineObstacle",
    "StaticObstacle",
    "Target",
    "TrackObstacle",
    "Vehicle",
    "WaypointsObstacle",
    "load_scenario",
    "parse_scenario",
    "scenario_names",
]

BUILTIN = (Path(__file__).parent / "configs", Path(__file__).parent.parent / "configs")  # installed, checkout
_FOLDERS = ("", "scenarios")  # of each, in which scenarios are found by name

ParameterName = Annotated[str, Meta(pattern=r"^[A-Z][A-Z0-9_]{0,15}$")]
ConfigKey = Annotated[str, Meta(pattern=r"^[a-z0-9_]+(\.[a-z0-9_]+)*$")]
ConfigScalar: TypeAlias = bool | int | float | str
Port = Annotated[int, Meta(ge=1, le=65535)]


class Vehicle(Table, frozen=True, kw_only=True):
    """One vehicle. Of several, the n-th is by default ``uav<n>`` with system id n."""

    name: Name = "uav1"  # its Zenoh prefix is uav/<name>
    system_id: Annotated[int, Meta(ge=1, le=250)] = 1  # MAVLink
    personality: Literal["px4", "ardupilot"] = "px4"  # whose behaviour the autopilot has
    start: Point = (0.0, 0.0, 0.2)  # centre of the vehicle, local ENU [m]; 0.2 stands on the ground
    yaw_deg: Degrees = 0.0  # counter-clockwise from east
    takeoff_altitude_m: Annotated[float, Meta(ge=0.5, le=80.0)] = 1.5  # above the start
    target: Point | None = None  # of this vehicle; None: that of [target]
    onboard_port: Port | None = None  # None: the command line's plus the vehicle's index
    gcs_port: Port | None = None  # the same, of the ground station
    parameters: dict[ParameterName, bool | int | float] = msgspec.field(default_factory=dict)  # the autopilot's
    daemon: dict[ConfigKey, ConfigScalar | list[ConfigScalar]] = msgspec.field(default_factory=dict)  # its `--set`

    @property
    def yaw_rad(self) -> float:
        return math.radians(self.yaw_deg)


class Target(Table, frozen=True, kw_only=True):
    position: Point  # ENU [m]


class SensorSpec(Table, frozen=True, kw_only=True):
    """An external sensor; by default it sees every obstacle and, from each vehicle, the other vehicles."""

    source: Name = "sim"  # its name in the Zenoh key
    rate_hz: Annotated[float, Meta(gt=0.0, le=1000.0)] = 20.0  # frames a second
    sigma_m: NonNegative = 0.05  # of each axis
    latency_s: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.05  # from measurement to publication
    dropout: Probability = 0.05  # of one obstacle of one frame
    frame_dropout: Probability = 0.0  # of a whole frame
    range_m: Positive | None = None  # from the vehicle's centre; None: unlimited
    fov_deg: Annotated[float, Meta(gt=0.0, le=360.0)] = 360.0  # full horizontal angle about the body x axis
    fov_up_deg: Annotated[float, Meta(gt=0.0, le=180.0)] = 180.0  # full vertical angle about the body xy plane
    clutter: Annotated[float, Meta(ge=0.0, le=100.0)] = 0.0  # mean number of false detections a frame (Poisson)
    clutter_box: tuple[Point, Point] | None = None  # opposite corners, ENU; None: within the range and field of view
    clutter_radius_m: Positive = 0.2  # of a false detection
    anonymous: bool = False  # detections without ids
    vehicles: tuple[Name, ...] | None = None  # names of those that carry it; None: all


class OperatorStep(Table, frozen=True, kw_only=True):
    """What the operator does, and when in lockstep: at a tick, or at the first tick at which a condition holds."""

    do: Literal["arm", "takeoff", "engage", "release", "hold", "land", "disarm"]  # the command
    at_tick: Tick | None = None  # control period
    after: Literal["airborne_hover", "on_ground", "end"] | None = None  # condition
    vehicle: Name | None = None  # None: every vehicle


class End(Table, frozen=True, kw_only=True):
    """The run ends when the target is reached (passed within ``reach_m``, then within ``hold_m`` for ``hold_s``),
    ``collision_s`` after a touch, or ``timeout_s`` after the vehicle entered offboard. ``stop`` false: never."""

    reach_m: Positive = 0.1  # passed within this
    hold_m: Positive = 0.3  # then within this
    hold_s: Positive = 3.0  # for this long
    timeout_s: Positive = 60.0  # after the entry into external control
    collision_s: NonNegative = 1.0  # after a touch
    stop: bool = True  # false: fly on until a signal


_STEPS = (
    OperatorStep(do="arm", at_tick=0),
    OperatorStep(do="takeoff", at_tick=1),
    OperatorStep(do="engage", after="airborne_hover"),
)


class Scenario(Table, frozen=True, kw_only=True):
    """A file; without [[vehicles]] it flies the one of [vehicle]."""

    description: str = ""  # one line
    physics_hz: Annotated[int, Meta(ge=1, le=10_000)] = 240  # physics steps a second
    control_hz: Annotated[int, Meta(ge=1, le=1000)] = 20  # control periods a second
    vehicle: Vehicle = Vehicle()
    vehicles: tuple[Vehicle, ...] = ()
    target: Target | None = None
    obstacles: tuple[Obstacle, ...] = ()
    sensors: tuple[SensorSpec, ...] = (SensorSpec(),)
    physics: Physics = Physics()
    operator: tuple[OperatorStep, ...] = _STEPS
    faults: tuple[Fault, ...] = ()
    expect: Expectation = Expectation()
    end: End = End()

    @property
    def fleet(self) -> tuple[Vehicle, ...]:
        """The vehicles, in the file's order."""
        return self.vehicles or (self.vehicle,)

    def target_of(self, vehicle: Vehicle) -> Point | None:
        """Where ``vehicle`` is to fly, ENU [m]."""
        if vehicle.target is not None:
            return vehicle.target
        return None if self.target is None else self.target.position

    def carried(self, name: str) -> tuple[tuple[int, SensorSpec], ...]:
        """The sensors of the vehicle ``name``, each with its index in the file."""
        return tuple((i, s) for i, s in enumerate(self.sensors) if s.vehicles is None or name in s.vehicles)


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
    """A scenario from decoded TOML; ``source`` names the file in errors, and its folder that of recorded tracks."""
    if "vehicle" in raw and "vehicles" in raw:
        raise ScenarioError(f"{source}: vehicles: expected [vehicle] or [[vehicles]], not both")
    try:
        scenario = msgspec.convert(_numbered(raw), Scenario)
    except msgspec.ValidationError as error:
        raise ScenarioError(f"{source}: {pointed(str(error), Scenario)}") from None
    for key, value in _numbers(raw, ""):
        if not math.isfinite(value):
            raise ScenarioError(f"{source}: {key}: expected a finite number, got {value}")
    try:
        control_steps(scenario.physics_hz, scenario.control_hz)
        check(scenario)
    except ScenarioError as error:
        raise ScenarioError(f"{source}: {error}") from None
    if scenario.vehicles:
        scenario = msgspec.structs.replace(scenario, vehicle=scenario.vehicles[0])
    return _with_files_beside(scenario, Path(source).parent)


def scenario_names() -> dict[str, Path]:
    """The shipped scenarios by name."""
    folders = [base / sub for base in BUILTIN for sub in _FOLDERS if (base / sub).is_dir()]
    known = {path.stem: path for folder in folders for path in sorted(folder.glob("*.toml"))}
    known.pop("default", None)  # the daemon's configuration
    return known


def _find(name_or_path: str) -> Path:
    if "/" in name_or_path or name_or_path.endswith(".toml"):
        return Path(name_or_path)
    known = scenario_names()
    if name_or_path not in known:
        raise ScenarioError(f"scenario {name_or_path}: expected a TOML file or one of {', '.join(sorted(known))}")
    return known[name_or_path]


def _numbered(raw: Mapping[str, Any]) -> Mapping[str, Any]:
    """``raw`` with the default name and system id of each of several vehicles."""
    vehicles = raw.get("vehicles")
    if not isinstance(vehicles, list | tuple) or not all(isinstance(v, Mapping) for v in vehicles):
        return raw
    named = [{"name": f"uav{i}", "system_id": i, **vehicle} for i, vehicle in enumerate(vehicles, 1)]
    return {**raw, "vehicles": named}


def _with_files_beside(scenario: Scenario, folder: Path) -> Scenario:
    """The paths of recorded tracks count from the scenario's folder."""
    obstacles = tuple(
        msgspec.structs.replace(o, file=str(folder / o.file)) if isinstance(o, TrackObstacle) else o
        for o in scenario.obstacles
    )
    return scenario if obstacles == scenario.obstacles else msgspec.structs.replace(scenario, obstacles=obstacles)


def _numbers(value: Any, key: str) -> list[tuple[str, float]]:
    if isinstance(value, Mapping):
        return [pair for k, item in value.items() for pair in _numbers(item, f"{key}.{k}" if key else str(k))]
    if isinstance(value, list | tuple):
        return [pair for i, item in enumerate(value) for pair in _numbers(item, f"{key}[{i}]")]
    return [(key, value)] if isinstance(value, float) else []
