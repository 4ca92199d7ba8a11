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


class TimeBase:
    """Maps the vehicle's clock to ours.

    Args:
        send: puts bytes on the vehicle's link.
        on_reboot: called when a reply shows that the vehicle's clock began anew.
    """

    def __init__(
        self, clock: Clock, codec: MavlinkCodec, send: Callable[[bytes], None], on_reboot: Callable[[], None]
    ) -> None:
        self._clock = clock
        self._codec = codec
        self._send = send
        self._on_reboot = on_reboot
        self._timesync = TimeSync()
        self._asked_ns: int | None = None

    @property
    def unix_minus_vehicle_ns(self) -> int | None:
        """Unix time minus the vehicle's clock, None until settled."""
        return self._timesync.unix_minus_vehicle_ns

    def poll(self) -> None:
        """Ask for the vehicle's time when it is due: often until settled, then once a second."""
        now_ns = self._clock.monotonic_ns()
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
        reboots = self._timesync.counts["reboots"]
        self._timesync.reply(tc1_ns=event.tc1_ns, ts1_ns=event.ts1_ns, now_ns=now_ns, unix_ns=self._clock.unix_ns())
        if self._timesync.counts["reboots"] > reboots:
            self._on_reboot()

    def rebooted(self, stamp_ns: int) -> bool:
        """Note a stamp of the vehicle's clock; True where it went back."""
        return self._timesync.vehicle_time(stamp_ns)

    def age_ns(self, stamp_ns: int) -> int | None:
        """How long ago the vehicle stamped, None until settled."""
        offset_ns = self._timesync.ours_minus_vehicle_ns
        return None if offset_ns is None else self._clock.monotonic_ns() - (stamp_ns + offset_ns)
