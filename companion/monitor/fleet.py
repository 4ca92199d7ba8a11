"""Every vehicle that was heard, and the newest of each of its keys. Payloads are decoded when they are looked at."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass, field
from typing import TypeVar

import msgspec

from companion.errors import FrameRejected
from companion.link import wire
from companion.monitor.essentials import Sight
from companion.types import NS_PER_S

MAX_VEHICLES = 64
RATE_WINDOW_NS = 2 * NS_PER_S
STALE_NS = NS_PER_S  # a tick's record, vehicle or tracks older than this are shown no more

KINDS: dict[str, type[msgspec.Struct]] = {
    "status": wire.Status,
    "setpoint": wire.SetpointRecord,
    "vehicle": wire.VehicleOut,
    "tracks": wire.TracksOut,
}

T = TypeVar("T", bound=msgspec.Struct)


@dataclass(slots=True)
class _Vehicle:
    payloads: dict[str, bytes] = field(default_factory=dict)  # not looked at yet
    decoded: dict[str, msgspec.Struct] = field(default_factory=dict)
    arrived_ns: dict[str, int] = field(default_factory=dict)
    ticks_ns: deque[int] = field(default_factory=deque)  # arrivals of the setpoint records
    token: bool | None = None
    drone_radius_m: float | None = None
    asked: bool = False  # for its configuration
    malformed: int = 0


class Fleet:
    """Thread-safe: Zenoh's threads ``take``, the terminal's ``looks``. At most `MAX_VEHICLES`, others are ignored."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._vehicles: dict[str, _Vehicle] = {}

    def take(self, key: str, payload: bytes, now_ns: int) -> None:
        """One message as it came: ``uav/NAME/companion/KIND``; anything else is ignored."""
        name, kind = _parts(key)
        if kind not in KINDS:
            return
        with self._lock:
            vehicle = self._vehicle(name)
            if vehicle is None:
                return
            vehicle.payloads[kind] = payload
            vehicle.arrived_ns[kind] = now_ns
            if kind == "setpoint":
                vehicle.ticks_ns.append(now_ns)
                while now_ns - vehicle.ticks_ns[0] > RATE_WINDOW_NS:
                    vehicle.ticks_ns.popleft()

    def token(self, key: str, alive: bool) -> None:
        """A liveliness token, ``uav/NAME/companion/alive``, appeared or was dropped."""
        name, kind = _parts(key)
        if kind != "alive":
            return
        with self._lock:
            vehicle = self._vehicle(name)
            if vehicle is not None:
                vehicle.token = alive
                vehicle.asked = vehicle.asked and alive  # the next daemon of this name may be configured otherwise

    def configured(self, key: str, payload: bytes) -> None:
        """The answer to the query of ``uav/NAME/companion/config``."""
        name, kind = _parts(key)
        try:
            radius_m = float(msgspec.json.decode(payload)["config"]["safety"]["drone_radius_m"])
        except (msgspec.DecodeError, KeyError, TypeError, ValueError):
            return  # the default is shown with
        with self._lock:
            if kind == "config" and (vehicle := self._vehicles.get(name)) is not None:
                vehicle.drone_radius_m = radius_m

    def unasked(self) -> list[str]:
        """Vehicles whose configuration was not asked for yet; from now on it was."""
        with self._lock:
            names = [name for name, vehicle in self._vehicles.items() if not vehicle.asked and vehicle.arrived_ns]
            for name in names:
                self._vehicles[name].asked = True
        return sorted(names)

    def look(self, now_ns: int) -> list[Sight]:
        """Every vehicle as it is known now, by name."""
        with self._lock:
            return [self._sight(name, self._vehicles[name], now_ns) for name in sorted(self._vehicles)]

    def _vehicle(self, name: str) -> _Vehicle | None:
        vehicle = self._vehicles.get(name)
        if vehicle is None and len(self._vehicles) < MAX_VEHICLES:
            vehicle = self._vehicles[name] = _Vehicle()
        return vehicle

    def _sight(self, name: str, vehicle: _Vehicle, now_ns: int) -> Sight:
        arrived_ns = vehicle.arrived_ns.get("status")
        status = _decoded(vehicle, "status", wire.Status)
        stale = {kind for kind, ns in vehicle.arrived_ns.items() if now_ns - ns > STALE_NS}
        record = None if "setpoint" in stale else _decoded(vehicle, "setpoint", wire.SetpointRecord)
        state = None if "vehicle" in stale else _decoded(vehicle, "vehicle", wire.VehicleOut)
        tracks = None if "tracks" in stale else _decoded(vehicle, "tracks", wire.TracksOut)
        return Sight(
            name=name,
            status=status,
            status_age_s=None if arrived_ns is None else (now_ns - arrived_ns) / NS_PER_S,
            record=record,
            vehicle=state,
            tracks=tracks,
            rate_hz=_rate_hz(vehicle.ticks_ns, now_ns),
            token=vehicle.token,
            drone_radius_m=vehicle.drone_radius_m,
            malformed=vehicle.malformed,
        )


def _decoded(vehicle: _Vehicle, kind: str, wanted: type[T]) -> T | None:
    """The newest payload of ``kind`` that can be read."""
    payload = vehicle.payloads.pop(kind, None)
    if payload is not None:
        try:
            vehicle.decoded[kind] = wire.decode(payload, wanted)
        except FrameRejected:
            vehicle.malformed += 1
    found = vehicle.decoded.get(kind)
    return found if isinstance(found, wanted) else None


def _rate_hz(ticks_ns: deque[int], now_ns: int) -> float | None:
    """Ticks a second over the last two; None without two of them."""
    recent = [ns for ns in ticks_ns if now_ns - ns <= RATE_WINDOW_NS]
    if len(recent) < 2 or recent[-1] == recent[0]:
        return None
    return (len(recent) - 1) * NS_PER_S / (recent[-1] - recent[0])


def _parts(key: str) -> tuple[str, str]:
    """The vehicle and the kind in a key of a daemon, empty where it is none."""
    words = key.split("/")
    return (words[1], words[3]) if len(words) == 4 and words[0] == "uav" and words[2] == "companion" else ("", "")
