"""What the page is fed with: the newest tick and status, and a minute of samples for its charts.

A tick costs the daemon two references, and ten times a second of vehicle time a sample. A message is made only when
a browser asks for it, once for all that ask within a period, so that a slow browser gets the newest or nothing.
"""

from __future__ import annotations

import logging
from collections import deque

import msgspec

from companion import __version__
from companion.clock import Clock
from companion.link import mav, wire
from companion.link.inbox import ObstacleInbox
from companion.link.router import Router
from companion.page.view import ENCODER, PageFrame, PageLink, Sample, Tick, page_tick, sample
from companion.pilot import PilotOutput
from companion.route import Route
from companion.session import VehicleSession
from companion.types import NS_PER_S, TrackTable, VehicleState

log = logging.getLogger("companion")

PERIOD_S = 0.1  # between two messages, and between two samples
SAMPLES = 600
_SHARE_NS = int(0.9 * PERIOD_S * NS_PER_S)  # a message younger than this serves every browser


class PageFeed:
    """The newest of everything. ``tick`` and ``status`` never raise: a page must not end a flight."""

    def __init__(
        self, session: VehicleSession, route: Route, inbox: ObstacleInbox, router: Router, clock: Clock
    ) -> None:
        self._session = session
        self._route = route
        self._inbox = inbox
        self._router = router
        self._clock = clock
        self._tick: Tick | None = None
        self._tick_ns = 0  # when it came, monotonic clock
        self._status: wire.Status | None = None
        self._samples: deque[Sample] = deque(maxlen=SAMPLES)
        self._broken = False
        self._made: tuple[int, PageFrame, bytes] | None = None  # when, what, encoded

    def tick(
        self, record: wire.SetpointRecord, vehicle: VehicleState, output: PilotOutput | None, table: TrackTable
    ) -> None:
        """The newest tick."""
        self._tick, self._tick_ns = Tick(record, vehicle, output, table), self._clock.monotonic_ns()
        last_s = self._samples[-1].t_s if self._samples else None
        t_s = vehicle.stamp_ns / NS_PER_S
        if self._broken or (last_s is not None and 0.0 <= t_s - last_s < PERIOD_S - 1e-3):
            return
        if last_s is not None and t_s < last_s:
            self._samples.clear()  # the vehicle's clock began anew
        try:
            self._samples.append(sample(self._tick, self._session.config.safety.drone_radius_m))
        except Exception:
            self._broken = True
            log.exception("page: no charts from here on")

    def status(self, status: wire.Status) -> None:
        """The newest status."""
        self._status = status

    def message(self, *, first: bool = False) -> bytes:
        """The message of now; the ``first`` to a browser carries the samples of the last minute."""
        now_ns = self._clock.monotonic_ns()
        if self._made is None or now_ns - self._made[0] >= _SHARE_NS:
            frame = self._frame(now_ns)
            self._made = (now_ns, frame, ENCODER.encode(frame))
        _, frame, encoded = self._made
        if not first:
            return encoded
        return ENCODER.encode(msgspec.structs.replace(frame, history=[point.row() for point in self._samples]))

    def _frame(self, now_ns: int) -> PageFrame:
        config, tick = self._session.config, self._tick
        safety, limits = config.safety, config.limits
        age_s = None if tick is None else (now_ns - self._tick_ns) / NS_PER_S
        mode = self._session.custom_mode
        return PageFrame(
            vehicle=config.vehicle.name,
            version=__version__,
            mode=config.mode,
            commands=config.http.commands,
            arena=(list(limits.arena_min), list(limits.arena_max)),
            drone_radius=safety.drone_radius_m,
            speed_limit=limits.speed_m_s,
            period_ms=1e3 / config.rate_hz,
            mode_name="unknown" if mode is None else mav.mode_name(config.profile.autopilot, mode),
            route=[point.tolist() for point in self._route.waypoints],
            status=self._status,
            tick=None if tick is None else page_tick(tick, safety.drone_radius_m),
            tick_age=None if age_s is None else round(age_s, 2),
            links=self._links(now_ns),
            sources=self._sources(tick, age_s),
        )

    def _links(self, now_ns: int) -> list[PageLink]:
        mavlink, heard = self._session.config.mavlink, self._router.heard_ns
        return [
            PageLink(name=url, age=None if at_ns is None else round((now_ns - at_ns) / NS_PER_S, 2))
            for url, at_ns in zip((mavlink.url, *mavlink.links), heard, strict=True)
        ]

    def _sources(self, tick: Tick | None, tick_age_s: float | None) -> list[PageLink]:
        """Ages count from the measurement's stamp, in vehicle time, and go on while the vehicle is silent."""
        required = self._session.config.obstacles.required
        found = []
        for name in sorted({*self._inbox.sources, *required}):
            stamp_ns = self._inbox.newest_stamp_ns(name)
            age_s = None
            if stamp_ns is not None and tick is not None and tick_age_s is not None:
                age_s = round((tick.vehicle.stamp_ns - stamp_ns) / NS_PER_S + tick_age_s, 2)
            found.append(PageLink(name=name, age=age_s, note="required" if name in required else ""))
        return found
