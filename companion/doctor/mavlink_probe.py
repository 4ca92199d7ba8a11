"""The doctor's side of the MAVLink link without input or output: bytes in, bytes to send out, time as an argument.

It speaks as the daemon does, component 196, and asks for what the daemon asks for (SET_MESSAGE_INTERVAL, TIMESYNC),
so that what it measures is what the daemon would get. It never sends a setpoint, a mode or an arming command.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from typing import Any

from companion.doctor import parameters
from companion.doctor.dialogue import ParameterDialogue
from companion.doctor.observation import Autopilot, Stream, Timesync
from companion.latch import LATCH_NS, AutopilotLatch
from companion.link import mav
from companion.link.events import CommandAck, Event, Heartbeat, SystemTime, TimesyncReply
from companion.link.mavlink import MavlinkCodec
from companion.link.timesync import TimeSync
from companion.types import NS_PER_S

FIND_NS = LATCH_NS + 3 * NS_PER_S  # no autopilot after this: none
SETTLE_NS = NS_PER_S  # from asking for streams to measuring them
ASK_AGAIN_NS = 2 * NS_PER_S  # for a stream that has not come
ACK_NS = 3 * NS_PER_S // 10
TIMESYNC_NS = NS_PER_S // 10

TRAFFIC = ("ADSB_VEHICLE", "UTM_GLOBAL_POSITION", "OBSTACLE_DISTANCE", "OBSTACLE_DISTANCE_3D")


class MavlinkProbe:
    """Finds the autopilot, reads its parameters, measures its streams.

    Args:
        system_id: as configured, None to take the one autopilot that is heard.
        streams: message name -> rate to ask for; HEARTBEAT is measured without asking.
        duration_s: of the measuring window.
        fixes: parameters to set, (name, value).
    """

    def __init__(
        self,
        codec: MavlinkCodec,
        *,
        system_id: int | None,
        streams: dict[str, float],
        duration_s: float,
        fixes: Sequence[tuple[str, float]] = (),
    ) -> None:
        self._codec = codec
        codec.on_message = self._on_message
        self._latch = AutopilotLatch(system_id)
        self._wanted_hz = streams
        self._duration_ns = round(duration_s * NS_PER_S)
        self._fixes = tuple(fixes)
        self._chosen: tuple[int, int] | None = None
        self._chosen_ns = 0
        self._began_ns: int | None = None
        self._now_ns = 0
        self._beats: dict[tuple[int, int], Heartbeat] = {}
        self._dialogue: ParameterDialogue | None = None
        self._arrivals: dict[str, list[int]] = {name: [] for name in streams}
        self._asked_ns: dict[str, int] = {}
        self._acks: dict[str, int] = {}
        self._asking: tuple[str, int] | None = None  # SET_MESSAGE_INTERVAL without an answer yet, and when
        self._timesync = TimeSync()
        self._timesync_ns: int | None = None
        self._round_trips_ns: list[int] = []
        self._requests = 0
        self._last_beat_ns: int | None = None
        self._system_time_ns: int | None = None
        self._unix_minus_ours_s: float | None = None
        self.traffic: Counter[str] = Counter()
        self.systems: set[int] = set()

    @property
    def unix_minus_vehicle_ns(self) -> int | None:
        """This machine's unix time minus the vehicle's clock, None until TIMESYNC has settled."""
        return self._timesync.unix_minus_vehicle_ns

    def receive(self, data: bytes, now_ns: int, unix_ns: int) -> None:
        """Bytes as they arrived, at ``now_ns`` of the monotonic clock and ``unix_ns`` of this machine's."""
        self._now_ns = now_ns
        for event in self._codec.receive(data):
            self._on_event(event, now_ns, unix_ns)

    def poll(self, now_ns: int) -> list[bytes]:
        """What to send now."""
        self._began_ns = now_ns if self._began_ns is None else self._began_ns
        out: list[bytes] = []
        if self._last_beat_ns is None or now_ns - self._last_beat_ns >= NS_PER_S:
            self._last_beat_ns = now_ns
            out.append(self._codec.encode_heartbeat(mav.STATE_BOOT))
        if self._chosen is None:
            self._choose(now_ns)
        if self._chosen is not None:
            out.extend(self._ask_streams(now_ns))
            out.extend(self._ask_time(now_ns))
            if self._dialogue is not None:
                out.extend(self._codec.encode(message) for message in self._dialogue.poll(now_ns))
        return out

    def finished(self, now_ns: int) -> bool:
        """Everything is measured, or there is nobody to measure."""
        if self._chosen is None or self._dialogue is None:
            return self._began_ns is not None and now_ns - self._began_ns >= FIND_NS
        return now_ns >= self._window[1] and self._dialogue.finished(now_ns)

    def result(self) -> Autopilot | None:
        """The autopilot, None where none was chosen."""
        if self._chosen is None or self._dialogue is None:
            return None
        beat = self._beats[self._chosen]
        trips = sorted(self._round_trips_ns)
        return Autopilot(
            *self._chosen,
            kind=beat.autopilot,
            custom_mode=beat.custom_mode,
            armed=beat.armed,
            parameters=self._dialogue.values,
            unanswered=self._dialogue.unanswered,
            streams={name: self._stream(name) for name in self._wanted_hz},
            timesync=Timesync(
                asked=self._requests,
                answered=len(trips),
                median_ms=trips[len(trips) // 2] / 1e6 if trips else None,
                max_ms=trips[-1] / 1e6 if trips else None,
                settled=self._timesync.settled,
            ),
            unix_minus_ours_s=self._unix_minus_ours_s,
            fixes=self._dialogue.done,
        )

    # what comes in

    def _on_message(self, message: Any) -> None:
        name, sender = message.get_type(), (message.get_srcSystem(), message.get_srcComponent())
        if name in TRAFFIC or (name == "GLOBAL_POSITION_INT" and self._chosen and sender[0] != self._chosen[0]):
            self.traffic[name] += 1
        if sender != self._chosen:
            return
        if name in self._arrivals:
            self._arrivals[name].append(self._now_ns)
        elif name == "PARAM_VALUE" and self._dialogue is not None:
            self._dialogue.heard(message)

    def _on_event(self, event: Event, now_ns: int, unix_ns: int) -> None:
        match event:
            case Heartbeat() if event.autopilot != mav.AUTOPILOT_INVALID:
                self.systems.add(event.system)
                self._beats[event.system, event.component] = event
                if self._chosen is None:
                    self._latch.heard(event, now_ns)
                    if self._choose(now_ns) and "HEARTBEAT" in self._arrivals:
                        self._arrivals["HEARTBEAT"].append(now_ns)  # the one that it was found by
            case TimesyncReply() if (event.system, event.component) == self._chosen:
                sample = {"tc1_ns": event.tc1_ns, "ts1_ns": event.ts1_ns, "now_ns": now_ns, "unix_ns": unix_ns}
                if self._timesync.reply(**sample):
                    self._round_trips_ns.append(now_ns - event.ts1_ns)
            case CommandAck() if (event.from_system, event.from_component) == self._chosen:
                if event.command == mav.CMD_SET_MESSAGE_INTERVAL and self._asking is not None:
                    self._acks[self._asking[0]] = event.result
                    self._asking = None
            case SystemTime() if (event.system, event.component) == self._chosen and event.unix_ns > 0:
                self._unix_minus_ours_s = (event.unix_ns - unix_ns) / NS_PER_S
            case _:
                pass

    # details

    def _choose(self, now_ns: int) -> bool:
        """Whether there is one now."""
        chosen = self._latch.choose(now_ns)
        if chosen is None:
            return False
        system, component, autopilot = chosen
        self._chosen, self._chosen_ns = (system, component), now_ns
        self._codec.system = system
        names = parameters.NAMES.get(autopilot, ())
        writable = not self._beats[self._chosen].armed
        self._dialogue = ParameterDialogue(system, component, autopilot, names, self._fixes, writable=writable)
        return True

    @property
    def _window(self) -> tuple[int, int]:
        begin_ns = self._chosen_ns + SETTLE_NS
        return begin_ns, begin_ns + self._duration_ns

    def _stream(self, name: str) -> Stream:
        begin_ns, end_ns = self._window
        if name == "HEARTBEAT":  # nobody asks for it, so nothing has to settle; at 1 Hz a short window may hold none
            begin_ns = self._chosen_ns
        inside = [t for t in self._arrivals[name] if begin_ns <= t < end_ns]
        gaps = [after - before for before, after in itertools.pairwise(inside)]
        measured_s = (end_ns - begin_ns) / NS_PER_S
        longest_s = max(gaps) / NS_PER_S if gaps else None
        return Stream(self._wanted_hz[name], len(inside) / measured_s, longest_s, self._acks.get(name), measured_s)

    def _ask_streams(self, now_ns: int) -> list[bytes]:
        """SET_MESSAGE_INTERVAL for each stream until it comes, as the daemon does; SYSTEM_TIME once a second.

        One at a time: a COMMAND_ACK does not say which interval it answers.
        """
        out: list[bytes] = []
        if self._asking is not None and now_ns - self._asking[1] >= ACK_NS:
            self._asking = None
        for name, rate_hz in self._wanted_hz.items():
            if name == "HEARTBEAT" or self._asking is not None:
                continue
            asked_ns, heard = self._asked_ns.get(name), self._arrivals[name]
            silent = not heard or now_ns - heard[-1] >= ASK_AGAIN_NS
            if asked_ns is None or (silent and now_ns - asked_ns >= ASK_AGAIN_NS):
                self._asked_ns[name] = now_ns
                self._asking = (name, now_ns)
                out.append(self._codec.encode_set_message_interval(_MESSAGE_IDS[name], rate_hz))
        if self._system_time_ns is None or now_ns - self._system_time_ns >= NS_PER_S:
            self._system_time_ns = now_ns
            out.append(self._codec.encode_request_message(mav.MSG_SYSTEM_TIME))
        return out

    def _ask_time(self, now_ns: int) -> list[bytes]:
        if self._timesync_ns is not None and now_ns - self._timesync_ns < TIMESYNC_NS:
            return []
        self._timesync_ns = now_ns
        self._requests += 1
        return [self._codec.encode_timesync_request(self._timesync.request(now_ns))]


_MESSAGE_IDS = {
    "LOCAL_POSITION_NED": mav.MSG_LOCAL_POSITION_NED,
    "ATTITUDE_QUATERNION": mav.MSG_ATTITUDE_QUATERNION,
    "EXTENDED_SYS_STATE": mav.MSG_EXTENDED_SYS_STATE,
}
