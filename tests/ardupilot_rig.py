"""Flights of the ardupilot personality in PyBullet, in process; commands and setpoints as ENU values."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from sim_bridge.ardupilot import ArduCopter
from sim_bridge.flight import Flight
from sim_bridge.messages import Ack, Command, LocalSetpoint, Reply, Result, Sender, Sticks, Text
from sim_bridge.placement import resolve
from sim_bridge.scenario import parse_scenario

GCS, COMPANION = Sender(255, 190), Sender(1, 196)
ACCELERATION, ACCELERATION_YAW, ACCELERATION_YAW_RATE, VELOCITY_ACCELERATION = 0x0C3F, 0x083F, 0x043F, 0x0C07
POSITION, VELOCITY = 0x0DF8, 0x0DC7
S = 1_000_000_000
Vec3 = tuple[float, float, float]
ZERO: Vec3 = (0.0, 0.0, 0.0)


def command(number: int, *params: float, custom_mode: int | None = None) -> Command:
    filled = (*params, *[0.0] * (7 - len(params)))
    return Command(number, filled, GCS, custom_mode=custom_mode)


ARM, DISARM = command(400, 1.0), command(400, 0.0)


def set_mode(number: int) -> Command:
    return command(176, 1.0, float(number))


def takeoff(above_home_m: float) -> Command:
    return command(22, *[0.0] * 6, above_home_m)


def setpoint(
    a: Vec3 = ZERO,
    *,
    mask: int = ACCELERATION,
    v: Vec3 = ZERO,
    p: Vec3 = ZERO,
    frame: int = 1,
    yaw: float = 0.0,
    yaw_rate: float = 0.0,
) -> LocalSetpoint:
    """In ENU as the decoder makes it; what the mask ignores may be any number."""
    return LocalSetpoint(0, frame, mask, p, v, a, yaw, yaw_rate, COMPANION)


def sticks(
    forward: float = 0.0, left: float = 0.0, up: float = 0.0, turn_left: float = 0.0, system: int = 255
) -> Sticks:
    return Sticks(forward, left, up, turn_left, Sender(system, 190))


def result(replies: tuple[Reply, ...]) -> Result:
    (ack,) = [reply for reply in replies if isinstance(reply, Ack)]
    return ack.result


def texts(replies: tuple[Reply, ...]) -> list[str]:
    return [reply.text for reply in replies if isinstance(reply, Text)]


class Rig:
    """One flight; ``said`` are the STATUSTEXTs of its control periods."""

    def __init__(
        self,
        start: Vec3 = (0.0, 0.0, 20.0),
        *,
        yaw_deg: float = 0.0,
        physics_hz: int = 240,
        control_hz: int = 20,
        **parameters: float,
    ) -> None:
        raw: dict[str, Any] = {
            "physics_hz": physics_hz,
            "control_hz": control_hz,
            "vehicle": {"start": list(start), "yaw_deg": yaw_deg, "personality": "ardupilot"},
            "sensors": [],
            "end": {"stop": False},
        }
        self.flight = Flight(resolve("ardupilot", parse_scenario(raw, source="ardupilot"), 0))
        (self.craft,) = self.flight.crafts
        assert isinstance(self.craft.autopilot, ArduCopter)
        self.autopilot: ArduCopter = self.craft.autopilot
        for name, value in parameters.items():
            assert self.autopilot.parameters.write(name, value, is_int=False)
        self.said: list[str] = []
        self.modes: list[str] = []
        if self.autopilot.airborne:
            self.fly(1.5)  # the rotors start from rest

    @property
    def t_ns(self) -> int:
        return self.flight.t_ns

    @property
    def p(self) -> np.ndarray:
        return np.array(self.craft.truth.p_enu)

    @property
    def v(self) -> np.ndarray:
        return np.array(self.craft.truth.v_enu)

    @property
    def heading_deg(self) -> float:
        w, x, y, z = self.craft.truth.q_wxyz
        return math.degrees(math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))

    def order(self, what: Command) -> tuple[Reply, ...]:
        return self.autopilot.command(what, self.craft.state, self.t_ns)

    def guided(self) -> Rig:
        assert result(self.order(set_mode(4))) is Result.ACCEPTED
        return self

    def fly(
        self, seconds: float, stream: LocalSetpoint | None = None, until: Callable[[], bool] = lambda: False
    ) -> np.ndarray:
        """Rows (t, x, y, z, vx, vy, vz), t from now, one a physics step; ``stream`` is sent once a control period."""
        rows, began_ns = [], self.t_ns
        for _ in range(round(seconds * self.flight.world.physics_hz)):
            if self.flight.at_tick:
                for replies in self.flight.control():
                    self.said += texts(replies)
                if not self.modes or self.modes[-1] != self.autopilot.mode_name:
                    self.modes.append(self.autopilot.mode_name)
                if stream is not None:
                    self.said += texts(self.autopilot.setpoint(stream, self.t_ns))
                if until():
                    break
            self.flight.advance()
            rows.append(((self.t_ns - began_ns) / S, *self.p, *self.v))
        return np.array(rows)

    def close(self) -> None:
        self.flight.close()
