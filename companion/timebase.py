"""The daemon's side of TIMESYNC: asks, answers, and says whether a vehicle state is as fresh as it looks."""

from __future__ import annotations

from collections.abc import Callable

from companion.clock import Clock
from companion.link import mav
from companion.link.events import TimesyncReply, TimesyncRequest
from companion.link.mavlink import MavlinkCodec
from companion.link.timesync import TimeSync
from companion.types import NS_PER_S

EVERY_NS = NS_PER_S
SETTLING_NS = NS_PER_S // 10
STEP_NS = NS_PER_S // 10  # unix time set by more than this at once is told


class TimeBase:
    """Maps the vehicle's clock to ours.

    Args:
        send: puts bytes on the vehicle's link.
        on_restart: called with the reason when a stamp or a reply shows that the vehicle's clock began anew or jumped:
            whatever was dated by it is worth nothing.
        runs: whether the vehicle's clock runs beside ours; in lockstep it does not, and only a step back is noticed.
    """

    def __init__(
        self,
        clock: Clock,
        codec: MavlinkCodec,
        send: Callable[[bytes], None],
        on_restart: Callable[[str], None],
        *,
        runs: bool = True,
    ) -> None:
        self._clock = clock
        self._codec = codec
        self._send = send
        self._on_restart = on_restart
        self._runs = runs
        self._timesync = TimeSync()
        self._asked_ns: int | None = None
        self._unix_minus_ours_ns: int | None = None
        self.on_step: Callable[[float, int], None] = lambda step_s, now_ns: None  # unix time was set; by how much, when

    @property
    def unix_minus_vehicle_ns(self) -> int | None:
        """Unix time minus the vehicle's clock, None until settled; follows at once where unix time is set."""
        offset_ns = self._timesync.ours_minus_vehicle_ns
        return None if offset_ns is None else offset_ns + self._clock.unix_ns() - self._clock.monotonic_ns()

    def poll(self) -> None:
        """Ask for the vehicle's time when it is due: often until settled, then once a second."""
        now_ns = self._clock.monotonic_ns()
        self._watch_unix(now_ns)
        every_ns = EVERY_NS if self._timesync.settled else SETTLING_NS
        if self._asked_ns is None or now_ns - self._asked_ns >= every_ns:
            self._asked_ns = now_ns
            self._send(self._codec.encode_timesync_request(self._timesync.request(now_ns)))

    def handle(self, event: TimesyncRequest | TimesyncReply, system: int) -> None:
        """A request is answered once our own clock is settled; a reply of the autopilot of ``system`` counts."""
        now_ns = self._clock.monotonic_ns()
        if isinstance(event, TimesyncRequest):
            if self._timesync.settled:
                self._send(self._codec.encode_timesync_reply(tc1_ns=now_ns, ts1_ns=event.ts1_ns))
            return
        if (event.system, event.component) != (system, mav.AUTOPILOT_COMPONENT):
            return
        before = self._breaks
        self._timesync.reply(tc1_ns=event.tc1_ns, ts1_ns=event.ts1_ns, now_ns=now_ns, unix_ns=self._clock.unix_ns())
        self._tell(before)

    def note(self, stamp_ns: int) -> None:
        """Note the stamp of a vehicle state."""
        before = self._breaks
        self._timesync.vehicle_time(stamp_ns, self._clock.monotonic_ns() if self._runs else None)
        self._tell(before)

    @property
    def counts(self) -> dict[str, int]:
        """What TIMESYNC counts."""
        return dict(+self._timesync.counts)

    @property
    def _breaks(self) -> tuple[int, int]:
        return self._timesync.counts["reboots"], self._timesync.counts["jumps_ahead"]

    def _watch_unix(self, now_ns: int) -> None:
        before_ns, self._unix_minus_ours_ns = self._unix_minus_ours_ns, self._clock.unix_ns() - now_ns
        if before_ns is not None and abs(self._unix_minus_ours_ns - before_ns) > STEP_NS:
            self.on_step((self._unix_minus_ours_ns - before_ns) / NS_PER_S, now_ns)

    def _tell(self, before: tuple[int, int]) -> None:
        if self._breaks != before:
            self._on_restart("autopilot rebooted" if self._breaks[0] > before[0] else "vehicle clock jumped ahead")

    def age_ns(self, stamp_ns: int) -> int | None:
        """How long ago the vehicle stamped, None until settled."""
        offset_ns = self._timesync.ours_minus_vehicle_ns
        return None if offset_ns is None else self._clock.monotonic_ns() - (stamp_ns + offset_ns)
