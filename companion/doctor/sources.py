"""Obstacle frames as they arrive, judged by the daemon's own rules: rates, ages, and what it would reject and why."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from companion.doctor.observation import Source
from companion.errors import FrameRejected
from companion.link import ingress, wire
from companion.types import NS_PER_S

MAX_FRAMES = 20_000  # remembered a source: the doctor's memory is bounded whatever is sent
MAX_SOURCES = 64


@dataclass(slots=True)
class _Heard:
    arrivals_ns: list[int] = field(default_factory=list)
    ages_ns: list[int] = field(default_factory=list)
    clocks: set[str] = field(default_factory=set)
    rejected: Counter[str] = field(default_factory=Counter)
    late: list[tuple[wire.ObstacleFrame, int]] = field(default_factory=list)  # (frame, unix time at arrival)


class SourceLog:
    """Feed it every frame; frames are judged at the end, when the clocks' offset is known."""

    def __init__(self) -> None:
        self._heard: dict[str, _Heard] = {}

    def push(self, source: str, payload: bytes, encoding: str, *, now_ns: int, unix_ns: int) -> None:
        """One frame at ``now_ns`` of the monotonic clock and ``unix_ns`` of this machine's; never raises."""
        if source not in self._heard and len(self._heard) >= MAX_SOURCES:
            return
        heard = self._heard.setdefault(source, _Heard())
        if len(heard.arrivals_ns) >= MAX_FRAMES:
            return
        heard.arrivals_ns.append(now_ns)
        try:
            frame = wire.decode(payload, wire.ObstacleFrame, encoding)
        except FrameRejected as error:
            heard.rejected[error.reason] += 1
            return
        heard.clocks.add(frame.clock)
        heard.late.append((frame, unix_ns))

    def result(self, end_ns: int, *, unix_minus_vehicle_ns: int | None, max_age_s: float) -> tuple[Source, ...]:
        """The sources by name; a rate counts from the source's first frame to ``end_ns``."""
        for name, heard in self._heard.items():
            for frame, unix_ns in heard.late:
                self._judge(name, heard, frame, unix_ns, unix_minus_vehicle_ns, max_age_s)
            heard.late.clear()
        return tuple(self._told(name, heard, end_ns) for name, heard in sorted(self._heard.items()))

    @staticmethod
    def _judge(
        name: str, heard: _Heard, frame: wire.ObstacleFrame, unix_ns: int, offset_ns: int | None, max_age_s: float
    ) -> None:
        """Age and fate of one frame.

        The daemon compares on the vehicle's clock, onto which it maps unix stamps by its own: for those the offset
        falls out of the age, so it is told before TIMESYNC has settled too.
        """
        if frame.clock == "unix":
            heard.ages_ns.append(unix_ns - frame.stamp_ns)
        elif offset_ns is not None:
            heard.ages_ns.append(unix_ns - offset_ns - frame.stamp_ns)
        now_ns = unix_ns - (offset_ns or 0)
        if frame.clock == "vehicle" and offset_ns is None:
            now_ns = frame.stamp_ns  # its age is unknown here; the rest is judged
        try:
            ingress.detections_from_frame(
                frame,
                source=name,
                sequence=0,
                now_ns=now_ns,
                unix_minus_vehicle_ns=offset_ns or 0,
                max_age_s=max_age_s,
            )
        except FrameRejected as error:
            heard.rejected[error.reason] += 1

    @staticmethod
    def _told(name: str, heard: _Heard, end_ns: int) -> Source:
        elapsed_s = max(end_ns - heard.arrivals_ns[0], 1) / NS_PER_S
        ages_s = [age / NS_PER_S for age in heard.ages_ns]
        return Source(
            name=name,
            frames=len(heard.arrivals_ns),
            rate_hz=(len(heard.arrivals_ns) - 1) / elapsed_s,
            clocks=tuple(sorted(heard.clocks)),
            least_age_s=min(ages_s, default=None),
            greatest_age_s=max(ages_s, default=None),
            rejected=dict(heard.rejected),
        )
