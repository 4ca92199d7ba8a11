"""What station, flight and runners use of an autopilot, whichever it imitates.

An autopilot is a pure state machine: no I/O and no clock; it is told the state and the time, and answers with replies
and with the setpoint that the controller flies. ENU, FLU, SI, integer nanoseconds since boot.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from sim_bridge.controller import Setpoint
from sim_bridge.messages import (
    AttitudeTarget,
    Command,
    Landed,
    LinkName,
    LocalSetpoint,
    Reply,
    Result,
    Sticks,
    Vec3,
)
from sim_bridge.physics import BodyState


class BatteryReading(Protocol):
    """What an autopilot's power monitor measures."""

    @property
    def share(self) -> float:
        """Charge left, 0 to 1."""

    @property
    def voltage_v(self) -> float: ...

    @property
    def current_a(self) -> float: ...

    @property
    def consumed_mah(self) -> float: ...


class ParameterTable(Protocol):
    """Parameters by name, in the order of their index on the wire."""

    @property
    def names(self) -> tuple[str, ...]: ...

    def __getitem__(self, name: str) -> float | int: ...

    def is_int(self, name: str) -> bool: ...

    def cast_to(self, name: str) -> int | None:
        """MAV_PARAM_TYPE of a parameter that travels as a plain float (C_CAST); None: bytewise."""

    def write(self, name: str, value: float | int, *, is_int: bool) -> bool:
        """Set a known parameter; False (and unchanged) for a wrong type or a value out of range."""

    def checksum(self) -> int | None:
        """What a request for ``_HASH_CHECK`` answers, None: nothing."""


class Personality(Protocol):
    """One vehicle's autopilot."""

    kind: int  # MAV_AUTOPILOT
    lockstep: bool  # set by the station: the state streams from the start, at the control rate
    up_since_ns: int  # flight time of its last boot, which its clock counts from; it is silent before
    unknown_stream: Result  # of a SET_MESSAGE_INTERVAL for a message that does not exist here
    too_fast_stream: Result  # and of one faster than `max_rate_hz`; ACCEPTED: it comes as fast as it can

    @property
    def armed(self) -> bool: ...

    @property
    def landed(self) -> Landed: ...

    @property
    def home_enu(self) -> Vec3: ...

    @property
    def position_valid(self) -> bool:
        """Its estimator has a position to tell."""

    @property
    def custom_mode(self) -> int:
        """HEARTBEAT.custom_mode."""

    @property
    def base_mode(self) -> int:
        """MAV_MODE_FLAG."""

    @property
    def system_status(self) -> int:
        """MAV_STATE."""

    @property
    def mode_name(self) -> str:
        """For traces and expectations: ``HOLD``, ``OFFBOARD``, ``GUIDED``..."""

    @property
    def external(self) -> bool:
        """Follows external setpoints: OFFBOARD or GUIDED."""

    @property
    def airborne(self) -> bool: ...

    @property
    def parameters(self) -> ParameterTable: ...

    @property
    def capabilities(self) -> int:
        """MAV_PROTOCOL_CAPABILITY."""

    @property
    def version(self) -> int:
        """AUTOPILOT_VERSION.flight_sw_version: major << 24 | minor << 16 | patch << 8 | FIRMWARE_VERSION_TYPE."""

    @property
    def max_rate_hz(self) -> float:
        """The fastest stream that can be asked for."""

    def stream_group(self, stream: int) -> tuple[int, ...]:
        """Messages of a MAV_DATA_STREAM; none where REQUEST_DATA_STREAM is not served."""

    @property
    def health(self) -> tuple[int, int, int]:
        """SYS_STATUS's MAV_SYS_STATUS_SENSOR masks: present, enabled, healthy."""

    @property
    def charge_state(self) -> int:
        """MAV_BATTERY_CHARGE_STATE."""

    def rates_hz(self, link: LinkName) -> Mapping[int, float]:
        """What streams unasked on ``link``: message id to rate."""

    def command(self, command: Command, state: BodyState, t_ns: int) -> tuple[Reply, ...]:
        """Carry out a command; one Ack to its sender, with the reason of a refusal as Text."""

    def setpoint(self, setpoint: LocalSetpoint, t_ns: int) -> tuple[Reply, ...]:
        """Take SET_POSITION_TARGET_LOCAL_NED or SET_POSITION_TARGET_GLOBAL_INT."""

    def attitude_setpoint(self, setpoint: AttitudeTarget, t_ns: int) -> tuple[Reply, ...]:
        """Take SET_ATTITUDE_TARGET."""

    def manual(self, sticks: Sticks, t_ns: int) -> tuple[Reply, ...]:
        """Take MANUAL_CONTROL or RC_CHANNELS_OVERRIDE."""

    def heard_station(self, t_ns: int, system: int = 255) -> None:
        """The heartbeat of the ground station ``system`` came."""

    def battery(self, reading: BatteryReading) -> None:
        """The power monitor's newest reading."""

    def step(self, state: BodyState, t_ns: int) -> tuple[Reply, ...]:
        """Watch the clock once a control period: failsafes, takeoff, landing, disarming."""

    def target(self, state: BodyState) -> Setpoint:
        """What the controller flies now."""

    def turn(self, dt_s: float) -> None:
        """One physics step has passed: let the heading follow."""

    def hovering(self, t_ns: int) -> bool:
        """Airborne, holding a position, and at rest there for half a second."""

    def hold(self, p_enu: Vec3) -> None:
        """Hold the position ``p_enu``."""

    def position_target(self) -> LocalSetpoint | None:
        """POSITION_TARGET_LOCAL_NED: what is flown, in the form of a setpoint; None: nothing to tell."""

    def attitude_target(self) -> AttitudeTarget | None:
        """ATTITUDE_TARGET: the attitude or rates that are flown; None where the position loops fly."""
