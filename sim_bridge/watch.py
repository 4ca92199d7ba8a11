"""What was seen of a flight, and when: states and verdicts of the daemons, modes of the autopilots, STATUSTEXTs.

Everything is dated by vehicle time at the tick at which it was seen. Texts count where they are said, whether or not
a fault lets them reach the ground station.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from pymavlink.dialects.v20 import ardupilotmega as dialect

from sim_bridge.flight import Flight
from sim_bridge.lockstep import COMPANION
from sim_bridge.mavlink import Packet
from sim_bridge.messages import Text
from sim_bridge.station import Station
from sim_bridge.zenoh_io import Record

STATUSTEXT_ID = 253


@dataclass(slots=True)
class Run:
    """A value that was seen at every look from ``first_ns`` to ``last_ns``."""

    value: str
    first_ns: int
    last_ns: int


@dataclass(slots=True)
class Seen:
    """One vehicle's history."""

    states: list[Run] = field(default_factory=list)
    verdicts: list[Run] = field(default_factory=list)
    modes: list[Run] = field(default_factory=list)
    texts: list[Run] = field(default_factory=list)

    @staticmethod
    def extend(runs: list[Run], value: str, t_ns: int) -> None:
        """Note ``value`` at ``t_ns``."""
        if runs and runs[-1].value == value:
            runs[-1].last_ns = t_ns
        else:
            runs.append(Run(value, t_ns, t_ns))


class Watch:
    """The eyes of a check on one flight."""

    def __init__(self, flight: Flight) -> None:
        self.seen = tuple(Seen() for _ in flight.crafts)
        self._flight = flight
        self._codec = dialect.MAVLink(None)
        self._chunks: dict[tuple[int, int], dict[int, str]] = {}  # (vehicle, id) -> text by chunk

    def listen(self, stations: Sequence[Station]) -> None:
        """Hear what the autopilots say."""
        for index, station in enumerate(stations):
            station.on_text = lambda text, index=index: self._said(index, text)  # type: ignore[misc]

    def record(self, vehicle: int, record: Record) -> None:
        """A daemon's record of one tick."""
        seen, t_ns = self.seen[vehicle], self._flight.t_ns
        if record.state:
            Seen.extend(seen.states, record.state, t_ns)
        if record.verdict:
            Seen.extend(seen.verdicts, record.verdict, t_ns)

    def packet(self, vehicle: int, packet: Packet) -> None:
        """A packet of a daemon; only its STATUSTEXTs matter."""
        if packet.message_id != STATUSTEXT_ID or packet.sender.component != COMPANION:
            return
        message = self._codec.decode(bytearray(packet.raw))
        text = str(message.text)
        if message.id:
            chunks = self._chunks.setdefault((vehicle, message.id), {})
            chunks[message.chunk_seq] = text
            if len(text) == 50:
                return  # more is to come
            text = "".join(chunks[i] for i in sorted(chunks))
            del self._chunks[vehicle, message.id]
        self._note_text(vehicle, text)

    def tick(self, t_ns: int) -> None:
        """The autopilots' modes, in force since the tick of ``t_ns``."""
        for seen, craft in zip(self.seen, self._flight.crafts, strict=True):
            Seen.extend(seen.modes, craft.autopilot.mode_name, t_ns)

    def _said(self, vehicle: int, text: Text) -> None:
        self._note_text(vehicle, text.text)

    def _note_text(self, vehicle: int, text: str) -> None:
        t_ns = self._flight.t_ns
        self.seen[vehicle].texts.append(Run(text, t_ns, t_ns))
