"""The paper's comparison: five methods on three cases, PyBullet at 0.05 s (its Table 3 and figures 5 to 13).

RL+ACBF and PID+ACBF fly the daemon's own pilot (tracker, filter, delay, disturbance estimate) on what a noisy sensor
sees, and once on exact positions; Pure RL flies its network alone on the true obstacle, as it was trained. Nobody gets
by for being early or late: the obstacle's crossing is timed to each method's own unobstructed flight. Two presets:
``paper`` takes the paper's literal parameters (N = 5, its tracker, k_ma = 1 m/s^2, a reward that never asks to stop, no
hold law), ``default`` ours.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from companion.config import Config, parse_config
from companion.pilot import Pilot, PilotInput, ReferenceLaw
from companion.types import Detection, DetectionFrame, DetectionKind, Vec3, VehicleState, Verdict, frozen
from policies.env import PRESETS, FloatArray
from policies.evaluation.bullet import PERIOD_S, Arrival, BulletVehicle
from sim_bridge.placement import resolve
from sim_bridge.scenario import BUILTIN, Scenario, load_scenario
from sim_bridge.sensors import Frame, Sensor, Sighting

PresetName = Literal["paper", "default"]
PRESET_NAMES: tuple[PresetName, ...] = ("paper", "default")
CASE_NAMES = ("case1", "case2", "case3")
METHODS = ("Pure RL (Case 1)", "Pure RL (Case 2)", "Pure RL (Case 3)", "PID+ACBF", "RL+ACBF")
PAPERS_TABLE: dict[str, tuple[str, tuple[float, float, float]]] = {  # training time, minimum distance [m]
    "Pure RL (Case 1)": ("142 s", (0.6, 0.0, 0.0)),
    "Pure RL (Case 2)": ("160 s", (0.84, 0.93, 0.0)),
    "Pure RL (Case 3)": ("187 s", (0.0, 0.0, 0.99)),
    "PID+ACBF": ("N/A", (0.37, 1.15, 0.0)),
    "RL+ACBF": ("136 s", (0.32, 0.44, 0.16)),
}
TIMEOUT_S = 25.0
FAR_M = np.array([12.0, -12.0, 6.0])  # where a network without an obstacle believes one
EndToEndLaw = Callable[[Vec3, Vec3, Vec3, Vec3], Vec3]  # (v, e, p_o - p, v_o) -> net acceleration


@dataclass(frozen=True, slots=True)
class Preset:
    """What the two presets differ in."""

    name: PresetName
    config: Config
    k_ma_m_s2: float
    stay_s: float  # for which an arrival must last; 0: flying through counts

    def with_policy(self, artifact: Path | str) -> Config:
        return msgspec.structs.replace(
            self.config, policy=msgspec.structs.replace(self.config.policy, artifact=str(artifact))
        )


def preset(name: PresetName) -> Preset:
    """The daemon's configuration and the task's numbers."""
    env = PRESETS[name]
    if name == "default":
        return Preset(name, Config(), env.k_ma_m_s2, 1.0)
    literal = {"safety": {"preset": "paper"}, "tracking": {"preset": "paper"}, "policy": {"capture_radius_m": 0.0}}
    return Preset(name, parse_config(literal, source="preset paper"), env.k_ma_m_s2, 0.0)


@dataclass(slots=True)
class Flown:
    """One flight, tick by tick."""

    t_s: FloatArray  # (T,)
    p_enu: FloatArray  # (T, 3) [m]
    v_enu: FloatArray  # (T, 3) [m/s]
    a_enu: FloatArray  # (T, 3) commanded, net [m/s^2]
    obstacle_enu: FloatArray  # (T, 3) [m]
    distance_m: FloatArray  # (T,) surface to surface
    clearance_m: float  # least of every physics step, 0 where touched
    collided: bool
    arrival_s: float | None
    verdicts: dict[str, int]
    effort_m2_s3: float  # integral of |a|^2 up to the arrival


@dataclass(frozen=True, slots=True)
class Method:
    """A reference behind the daemon's pilot, or a network end to end; ``reference`` makes one for each flight."""

    name: str
    config: Config
    reference: Callable[[], ReferenceLaw] | None = None
    end_to_end: EndToEndLaw | None = None


@dataclass(frozen=True, slots=True)
class Cell:
    """One method in one case: the flight on exact positions, and those on noisy ones, a seed each."""

    exact: Flown
    noisy: tuple[Flown, ...]  # none of a method without a sensor

    @property
    def collisions(self) -> int:
        return sum(flight.collided for flight in self.noisy)

    def to_json(self) -> dict[str, Any]:
        flights = {"exact": [self.exact], "noisy": list(self.noisy)}
        return {
            kind: [
                {
                    "min_distance_m": flight.clearance_m,
                    "collided": flight.collided,
                    "arrival_s": flight.arrival_s,
                    "verdicts": flight.verdicts,
                    "effort_m2_s3": flight.effort_m2_s3,
                }
                for flight in flown
            ]
            for kind, flown in flights.items()
        }


def load_case(name: str) -> Scenario:
    """A shipped case's scenario, configs/paper/NAME.toml; `companion demo --scenario` flies the same files."""
    (path, *_) = (path for folder in BUILTIN if (path := folder / "paper" / f"{name}.toml").is_file())
    return load_scenario(str(path))[1]


class _PilotLaw:
    """The daemon's brain behind one sensor."""

    def __init__(self, config: Config, reference: ReferenceLaw, target_enu: Vec3) -> None:
        self._pilot, self._target_enu = Pilot(config, reference), target_enu
        self._sequence = 0
        self.verdicts: dict[str, int] = {verdict.value: 0 for verdict in Verdict}

    def act(self, state: VehicleState, frames: list[Frame]) -> Vec3:
        seen = tuple(self._frame(stamp_ns, sightings) for stamp_ns, sightings in frames)
        out = self._pilot.step(PilotInput(state, seen, target_enu=self._target_enu))
        self.verdicts[out.result.verdict.value] += 1
        return out.wire

    def _frame(self, stamp_ns: int, sightings: list[Sighting]) -> DetectionFrame:
        self._sequence += 1
        detections = tuple(Detection(id=name, p_enu=frozen(p), radius_m=radius_m) for name, p, radius_m in sightings)
        return DetectionFrame(stamp_ns, "sim", self._sequence, DetectionKind.DETECTION, detections)


def fly_case(
    scenario: Scenario, chosen: Preset, method: Method, *, seed: int = 0, exact: bool = False, obstacles: bool = True
) -> Flown:
    """One flight of a case; ``exact`` leaves out the sensor's noise, ``obstacles`` false the obstacle."""
    resolved = resolve("case", scenario, seed, obstacles=obstacles)
    radii_m = [obstacle.radius_m for obstacle in resolved.obstacles]
    ids = [obstacle.id for obstacle in resolved.obstacles]
    (spec,) = scenario.sensors
    sensor = Sensor(
        ids,
        radii_m,
        rate_hz=spec.rate_hz,
        sigma_m=0.0 if exact else spec.sigma_m,
        latency_s=spec.latency_s,
        dropout=spec.dropout,
        frame_dropout=spec.frame_dropout,
        rng=resolved.sensor_rng(0),
    )
    assert scenario.target is not None, "checked by the tests of the shipped cases"
    target = frozen(np.array(scenario.target.position))
    law = None if method.reference is None else _PilotLaw(method.config, method.reference(), target)
    arrival = Arrival(target, PRESETS[chosen.name].threshold_m, chosen.stay_s)
    ticks: list[tuple[FloatArray, ...]] = []
    effort = 0.0
    with BulletVehicle(np.array(scenario.vehicle.start), [o.motion for o in resolved.obstacles], radii_m) as vehicle:
        for step in range(round(TIMEOUT_S / PERIOD_S)):
            state, (centres, velocities) = vehicle.state, vehicle.obstacles()
            if law is not None:
                sensor.sample(state.stamp_ns, [tuple(p) for p in centres.tolist()])
                a = law.act(state, sensor.due(state.stamp_ns))
            else:
                assert method.end_to_end is not None
                r, v_o = (centres[0] - state.p_enu, velocities[0]) if len(centres) else (FAR_M, np.zeros(3))
                a = method.end_to_end(state.v_enu, target - state.p_enu, r, v_o)
            centre = centres[0] if len(centres) else np.full(3, np.nan)
            ticks.append((state.p_enu, state.v_enu, a, centre, np.array(vehicle.world.clearances_m[0])))
            effort += float(a @ a) * PERIOD_S if arrival.arrived_s is None else 0.0
            vehicle.advance(a)
            arrival.note((step + 1) * PERIOD_S, vehicle.state.p_enu)
            if vehicle.world.min_clearances_m[0] <= 0.0 or vehicle.world.touched_ground[0] or arrival.reached:
                break
        clearance_m = vehicle.world.min_clearances_m[0]
        collided = clearance_m <= 0.0 or vehicle.world.touched_ground[0]
    p, v, a, centre, distance = (np.array(column, dtype=np.float64) for column in zip(*ticks, strict=True))
    return Flown(
        np.arange(len(p), dtype=np.float64) * PERIOD_S,
        p,
        v,
        a,
        centre,
        distance,
        max(clearance_m, 0.0),
        collided,
        None if collided or not arrival.reached else arrival.arrived_s,
        {} if law is None else {name: count for name, count in law.verdicts.items() if count},
        effort,
    )


def retimed(scenario: Scenario, chosen: Preset, method: Method) -> Scenario:
    """The case with its crossing at the instant at which the unobstructed vehicle is nearest to the point.

    A figure eight keeps its phase at the crossing, a straight or accelerated obstacle its velocity at the start.
    """
    free = fly_case(scenario, chosen, method, obstacles=False)
    (obstacle,) = scenario.obstacles
    nearest = np.linalg.norm(free.p_enu - np.array(obstacle.cross_point), axis=1).argmin()
    timed = msgspec.structs.replace(obstacle, cross_at_s=float(free.t_s[nearest]))
    return msgspec.structs.replace(scenario, obstacles=(timed,))


def table(name: PresetName, cases: dict[str, dict[str, Cell]], seconds: dict[str, float | None]) -> str:
    """Our Table 3 beside the paper's, as Markdown."""
    lines = [
        "| method | training | min distance, case 1 / 2 / 3 | noisy sensor: least | noisy: touched | paper: training "
        "| paper: min distance |",
        "|---|---|---|---|---|---|---|",
    ]
    for method in METHODS:
        cells = [cases[case][method] for case in CASE_NAMES]
        taken = seconds.get(method)
        theirs, distances = PAPERS_TABLE[method]
        least = " / ".join(f"{min(f.clearance_m for f in cell.noisy):.2f} m" for cell in cells if cell.noisy)
        touched = " / ".join(f"{cell.collisions} of {len(cell.noisy)}" for cell in cells if cell.noisy)
        lines.append(
            f"| {method} | {'N/A' if taken is None else f'{taken:.0f} s'} | "
            + " / ".join(f"{cell.exact.clearance_m:.2f} m" for cell in cells)
            + f" | {least or '-'} | {touched or '-'} | {theirs} | "
            + " / ".join(f"{distance:g} m" for distance in distances)
            + " |"
        )
    return f"Preset {name}\n\n" + "\n".join(lines) + "\n"
