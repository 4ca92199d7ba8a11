"""Obstacle frames between the wire and the tick: bounded, ordered, checked, counted. No sockets, no clock.

Frames queue per source (the oldest of a full queue is dropped and counted) and are decoded and checked when a tick
drains them, against that tick's time. In lockstep each source also sends markers ``{through_ns, frames}``; a tick
waits until every source's marker for it is there and the frames which the markers announce have arrived, in
whatever order, and takes no frame that belongs to a later marker.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from companion.errors import FrameRejected
from companion.link import ingress, wire
from companion.types import NS_PER_S, DetectionFrame

MAX_PAYLOAD_BYTES = 1 << 20
MAX_SOURCES = 64

# bytes as they came, a frame that another door decoded, or the call that decodes it
Payload = bytes | wire.ObstacleFrame | Callable[[], wire.ObstacleFrame]
_Entry = tuple[int, Payload, str | None, int | None]  # sequence, payload, encoding, arrival


@dataclass(slots=True)
class _Source:
    queue: deque[_Entry] = field(default_factory=deque)
    arrived: int = 0  # frames so far; the next one's sequence
    announced: int = 0  # frames that the markers so far stand for
    through_ns: int | None = None  # of the newest marker
    before: int = 0  # frames announced by the markers before the newest
    newest_stamp_ns: int | None = None


class ObstacleInbox:
    """Queues of all sources.

    Args:
        sources: those configured; they keep their place however many strangers publish (at most 64 in all).
        queue: frames held for a source.
        per_tick: frames of a source that a tick uses.
        max_age_s: an older frame is rejected at the tick that would use it.
        on_report: told about rejected frames in one line, at most once a second of vehicle time.
        doors: sources of the daemon's own (`push_decoded`); what is published under their names is rejected.
        unix_ns: tells the time at which frames arrive, for the log.

    ``counts`` has frames (accepted), dropped (queue full), thinned and every reason of rejection.
    """

    def __init__(
        self,
        *,
        queue: int,
        max_age_s: float,
        per_tick: int = 4096,
        sources: Iterable[str] = (),
        on_report: Callable[[str], None] | None = None,
        doors: Iterable[str] = (),
        unix_ns: Callable[[], int | None] = lambda: None,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._queue = queue
        self._per_tick = per_tick
        self._max_age_s = max_age_s
        self._on_report = on_report
        self._unix_ns = unix_ns
        self._doors = frozenset(doors)
        self._configured = (*sources, *sorted(self._doors))
        self._sources = {name: _Source() for name in self._configured}
        self._unreported = 0
        self._last_rejection = ""
        self._reported_ns: int | None = None

    def retune(self, max_age_s: float) -> None:
        """Another age at which frames are too old, from the next tick on."""
        self._max_age_s = max_age_s

    def push(self, source: str, payload: bytes, encoding: str | None = None) -> None:
        """One frame as it arrived; never raises."""
        if source in self._doors:
            self.reject(source, FrameRejected("reserved_source", "expected another name: this one is a MAVLink door"))
            return
        self._enqueue(source, payload, encoding)

    def push_decoded(self, source: str, frame: wire.ObstacleFrame | Callable[[], wire.ObstacleFrame]) -> None:
        """One frame of another door, or the call that decodes it when a tick drains it; never raises.

        The call may raise FrameRejected, which is counted like any other.
        """
        self._enqueue(source, frame, None)

    def _enqueue(self, source: str, payload: Payload, encoding: str | None) -> None:
        entry = self._source(source)
        if entry is None:
            self.reject(source, FrameRejected("too_many_sources", f"expected at most {MAX_SOURCES} sources"))
            return
        sequence, entry.arrived = entry.arrived, entry.arrived + 1
        if isinstance(payload, bytes) and len(payload) > MAX_PAYLOAD_BYTES:
            detail = f"expected at most {MAX_PAYLOAD_BYTES} bytes, got {len(payload)}"
            self.reject(source, FrameRejected("too_large", detail))
            return
        if len(entry.queue) >= self._queue:
            entry.queue.popleft()
            self.counts["dropped"] += 1
        entry.queue.append((sequence, payload, encoding, self._unix_ns()))

    def push_marker(self, source: str, payload: bytes, encoding: str | None = None) -> None:
        """One lockstep marker as it arrived; never raises. A marker that does not advance is rejected."""
        entry = self._source(source)
        if entry is None:
            self.reject(source, FrameRejected("too_many_sources", f"expected at most {MAX_SOURCES} sources"))
            return
        try:
            marker = wire.decode(payload, wire.SyncMarker, encoding)
        except FrameRejected as error:
            self.reject(source, error)
            return
        if entry.through_ns is not None and marker.through_ns <= entry.through_ns:
            detail = f"through_ns: expected above {entry.through_ns}, got {marker.through_ns}"
            self.reject(source, FrameRejected("marker_order", detail))
            return
        entry.through_ns = marker.through_ns
        entry.before, entry.announced = entry.announced, entry.announced + marker.frames

    def ready(self, tick_ns: int, sources: Iterable[str]) -> bool:
        """True when every source's marker for ``tick_ns`` and the frames announced up to it have arrived."""
        return all(self._missing(tick_ns, source) == "" for source in sources)

    def missing(self, tick_ns: int, sources: Iterable[str]) -> str:
        """What `ready` waits for, in words; empty when nothing."""
        return "; ".join(text for source in sources if (text := self._missing(tick_ns, source)))

    def complete_through_ns(self, sources: Iterable[str]) -> int | None:
        """The newest tick for which `ready` is true, None where there is none."""
        names = tuple(sources)
        markers = [entry.through_ns for name in names if (entry := self._sources.get(name)) is not None]
        if not names or len(markers) < len(names) or None in markers:
            return None
        tick_ns = min(marker for marker in markers if marker is not None)
        return tick_ns if self.ready(tick_ns, names) else None

    def newest_stamp_ns(self, source: str) -> int | None:
        """Stamp of the newest frame accepted from ``source``, None where there was none."""
        entry = self._sources.get(source)
        return None if entry is None else entry.newest_stamp_ns

    @property
    def sources(self) -> tuple[str, ...]:
        """Every source that has sent a frame, sorted."""
        return tuple(sorted(name for name, entry in self._sources.items() if entry.arrived))

    def drain(self, now_ns: int, *, unix_minus_vehicle_ns: int | None = None) -> tuple[DetectionFrame, ...]:
        """The frames for the tick of vehicle time ``now_ns``, in the order (stamp, source, sequence).

        What breaks the wire contract is rejected, counted and reported.
        """
        frames: list[DetectionFrame] = []
        for name, entry in self._sources.items():
            for sequence, payload, encoding, arrived_unix_ns in self._taken(entry, self._limit(entry, now_ns)):
                try:
                    frame = ingress.detections_from_frame(
                        _decoded(payload, encoding),
                        source=name,
                        sequence=sequence,
                        now_ns=now_ns,
                        unix_minus_vehicle_ns=unix_minus_vehicle_ns,
                        max_age_s=self._max_age_s,
                        arrived_unix_ns=arrived_unix_ns,
                    )
                except FrameRejected as error:
                    self.reject(name, error)
                    continue
                self.counts["frames"] += 1
                entry.newest_stamp_ns = max(frame.stamp_ns, entry.newest_stamp_ns or frame.stamp_ns)
                frames.append(frame)
        self._report(now_ns)
        frames.sort(key=lambda frame: frame.order_key)
        return tuple(frames)

    def _taken(self, entry: _Source, limit: float) -> list[_Entry]:
        """A source's frames of this tick: all, or of more than ``per_tick`` the newest and others evenly before it.

        Every frame is a whole picture, so a source that is much faster than the ticks costs no tick its deadline.
        """
        taken = []
        while entry.queue and entry.queue[0][0] < limit:
            taken.append(entry.queue.popleft())
        if len(taken) > self._per_tick:
            stride = -(-len(taken) // self._per_tick)
            kept = taken[::-1][::stride][::-1]
            self.counts["thinned"] += len(taken) - len(kept)
            return kept
        return taken

    def reset(self) -> None:
        """Forget queues, markers and sources (the vehicle's clock began again); the counts stay."""
        self._sources = {name: _Source() for name in self._configured}
        self._reported_ns = None

    def _source(self, name: str) -> _Source | None:
        entry = self._sources.get(name)
        if entry is None and len(self._sources) < MAX_SOURCES:
            entry = self._sources[name] = _Source()
        return entry

    def _missing(self, tick_ns: int, source: str) -> str:
        entry = self._sources.get(source)
        if entry is None or entry.through_ns is None or entry.through_ns < tick_ns:
            return f"marker of {source} for {tick_ns}"
        wanted = self._limit(entry, tick_ns)
        if entry.arrived < wanted:
            return f"{int(wanted) - entry.arrived} of the frames of {source} for {tick_ns}"
        return ""

    @staticmethod
    def _limit(entry: _Source, tick_ns: int) -> float:
        """Frames with a sequence below this belong to ``tick_ns``; without markers, all do."""
        if entry.through_ns is None:
            return float("inf")
        return entry.announced if entry.through_ns <= tick_ns else entry.before

    def reject(self, source: str, error: FrameRejected) -> None:
        """Count what was refused at a door, for the next report."""
        self.counts[error.reason] += 1
        self._unreported += 1
        self._last_rejection = f"{source}: {error}"

    def _report(self, now_ns: int) -> None:
        if self._unreported == 0 or self._on_report is None:
            return
        last_ns = self._reported_ns
        if last_ns is not None and 0 <= now_ns - last_ns < NS_PER_S:
            return
        self._on_report(f"rejected {self._unreported} payloads, the last of {self._last_rejection}")
        self._unreported = 0
        self._reported_ns = now_ns


def _decoded(payload: Payload, encoding: str | None) -> wire.ObstacleFrame:
    if isinstance(payload, bytes):
        return wire.decode(payload, wire.ObstacleFrame, encoding)
    return payload if isinstance(payload, wire.ObstacleFrame) else payload()
