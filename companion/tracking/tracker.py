"""From frames of detections to tracks, and from tracks to the prediction that the safety filter looks along.

Frames are consumed in the order (stamp, source, sequence), so that the same set gives the same tracks whatever the
order of arrival. Every track stays at the instant of its own last measurement; `table` and `predict` carry all of
them to one instant without touching them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from companion.config import TrackingConfig
from companion.tracking.associate import associate
from companion.tracking.imm import Bank, birth, build_constants, fuse, fuse_mean, join, put, step, widened
from companion.tracking.measurement import Measurements, is_finite, measure
from companion.tracking.models import propagate
from companion.tracking.predict import horizon, largest_sigma, predict_positions
from companion.types import NS_PER_S, Detection, DetectionFrame, DetectionKind, FloatArray, Prediction, TrackTable

IntArray = npt.NDArray[np.int64]


class Tracker:
    """Tracks of moving obstacles.

    ``dropped`` counts what was not used: ``late`` (older than its track), ``duplicate`` (a stamp seen before),
    ``outlier`` (a named detection far off its track), ``over_max_tracks``, ``not_finite``; and ``lost``, the tracks
    that ended for want of measurements.
    """

    def __init__(self, config: TrackingConfig) -> None:
        self._config = config
        self._constants = build_constants(config)
        self._coast_ns = round(config.coast_s * NS_PER_S)
        self._grid = (0, 1.0)  # steps and dt_s of ``_horizon``
        self._horizon = horizon(np.zeros(0), self._constants.models)
        self.reset()

    def reset(self) -> None:
        """Forget everything; the next update is bit-equal to the first of a new tracker."""
        self.dropped: Counter[str] = Counter()
        self._now_ns = 0
        self._ids: list[str] = []
        self._rows: dict[str, int] = {}
        self._born: Counter[str] = Counter()  # anonymous births of each source
        self._last_anonymous_ns: dict[str, int] = {}
        self._bank: Bank = birth(np.zeros((0, 3)), np.zeros((0, 3, 3)), self._constants)
        self._stamp_ns: IntArray = np.zeros(0, dtype=np.int64)
        self._radius_m: FloatArray = np.zeros(0)
        self._missed: npt.NDArray[np.bool_] = np.zeros(0, dtype=np.bool_)  # the last detection was an outlier
        self._carried: tuple[int, FloatArray, FloatArray] | None = None  # the bank at one later instant

    def __len__(self) -> int:
        return len(self._ids)

    def update(self, frames: Sequence[DetectionFrame], now_ns: int) -> None:
        """Use ``frames``, then forget the tracks without a measurement for ``coast_s`` before ``now_ns``."""
        self._carried = None
        self._now_ns = now_ns
        for frame in sorted(frames, key=lambda frame: frame.order_key):
            self._consume(frame)
        oldest_ns = now_ns - self._coast_ns
        if self._ids and self._stamp_ns.min() < oldest_ns:
            keep = self._stamp_ns >= oldest_ns
            self.dropped["lost"] += int(len(self) - keep.sum())
            self._keep(np.flatnonzero(keep))

    def table(self) -> TrackTable:
        """All tracks at the instant of the last `update`, fused over the models."""
        x, covariance = self._at(self._now_ns)
        mean, spread = fuse(x, covariance, self._bank.probabilities)
        return TrackTable(
            stamp_ns=self._now_ns,
            ids=tuple(self._ids),
            p_enu=_read_only(mean[:, :3]),
            v_enu=_read_only(mean[:, 3:6]),
            a_enu=_read_only(mean[:, 6:9]),
            covariance=_read_only(spread[:, :9, :9]),
            mode_probabilities=_read_only(self._bank.probabilities.copy()),
            radius_m=_read_only(self._radius_m.copy()),
            age_s=_read_only((self._now_ns - self._stamp_ns) / NS_PER_S),
        )

    def predict(self, start_ns: int, steps: int, dt_s: float) -> Prediction:
        """Every track at ``start_ns + k dt_s``, k = 0..steps-1 (20)."""
        x, covariance = self._at(start_ns)
        if (steps, dt_s) != self._grid:
            self._grid = (steps, dt_s)
            self._horizon = horizon(np.arange(float(steps)) * dt_s, self._constants.models)
        probabilities = self._bank.probabilities
        p_enu, spread = predict_positions(x, covariance, probabilities, self._horizon)
        spread = widened(spread, self._bank, self._constants)
        mean = fuse_mean(x, probabilities)
        return Prediction(
            start_ns=start_ns,
            dt_s=dt_s,
            ids=tuple(self._ids),
            p_enu=_read_only(p_enu),
            sigma_m=_read_only(largest_sigma(spread)),
            v_enu=_read_only(mean[:, 3:6]),
            a_enu=_read_only(mean[:, 6:9]),
            radius_m=_read_only(self._radius_m.copy()),
        )

    def forecast(self, start_ns: int, tau_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Position of every track ``tau_s`` (K,) after ``start_ns``, (M, K, 3) [m], and its covariance.

        The covariance has its entries xx, yy, zz, yz, xz, xy first: (M, 6, K) [m^2], spread of means included.
        """
        x, covariance = self._at(start_ns)
        at = horizon(tau_s, self._constants.models)
        p_enu, spread = predict_positions(x, covariance, self._bank.probabilities, at)
        return p_enu, widened(spread, self._bank, self._constants)

    def _at(self, t_ns: int) -> tuple[FloatArray, FloatArray]:
        """States and covariances of all models carried to ``t_ns``, each track from its own instant."""
        if self._carried is None or self._carried[0] != t_ns:
            dt = (t_ns - self._stamp_ns) / NS_PER_S
            self._carried = (t_ns, *propagate(self._bank.x, self._bank.covariance, dt, self._constants.models))
        return self._carried[1:]

    def _consume(self, frame: DetectionFrame) -> None:
        ids, detections = self._named(frame)
        rows = [self._rows.get(track_id, -1) for track_id in ids]
        anonymous = self._anonymous(frame)
        measurements = measure([*detections, *anonymous], self._config)
        if anonymous:
            rows += self._associated(frame.stamp_ns, measurements, len(ids), rows)
            ids += [self._rows_to_id(row, frame.source) for row in rows[len(ids) :]]
        if not rows:
            return
        row_of = np.array(rows, dtype=np.intp)
        if min(rows) >= 0:
            self._advance(frame, row_of, measurements)
            return
        known = np.flatnonzero(row_of >= 0)
        if known.size:
            self._advance(frame, row_of[known], measurements.take(known))
        fresh = np.flatnonzero(row_of < 0)
        self._spawn(frame.stamp_ns, [ids[k] for k in fresh], measurements.take(fresh))

    def _named(self, frame: DetectionFrame) -> tuple[list[str], list[Detection]]:
        """Usable named detections, one of each id, in the order of their ids."""
        named: dict[str, Detection] = {}
        for detection in frame.detections:
            if detection.id is None:
                continue
            track_id = f"{frame.source}/{detection.id}"
            if not is_finite(detection):
                self.dropped["not_finite"] += 1
            elif track_id in named:
                self.dropped["duplicate"] += 1
            else:
                named[track_id] = detection
        ids = sorted(named)
        return ids, [named[track_id] for track_id in ids]

    def _anonymous(self, frame: DetectionFrame) -> list[Detection]:
        """Usable detections without id, in the order of their positions; none where this stamp was seen before."""
        found = [d for d in frame.detections if d.id is None]
        usable = [d for d in found if is_finite(d)]
        if len(usable) < len(found):
            self.dropped["not_finite"] += len(found) - len(usable)
        if not usable:
            return []
        last_ns = self._last_anonymous_ns.get(frame.source)
        if last_ns is not None and frame.stamp_ns <= last_ns:
            self.dropped["duplicate" if frame.stamp_ns == last_ns else "late"] += len(usable)
            return []
        self._last_anonymous_ns[frame.source] = frame.stamp_ns
        return sorted(usable, key=lambda d: tuple(float(c) for c in d.p_enu))

    def _associated(self, stamp_ns: int, measurements: Measurements, first: int, taken: list[int]) -> list[int]:
        """Rows for the detections from ``first`` on; tracks that the frame itself names are not free."""
        free = np.setdiff1d(np.arange(len(self)), np.array(taken, dtype=np.intp))
        x, covariance = self._at(stamp_ns)
        mean, spread = fuse(x[free], covariance[free], self._bank.probabilities[free])
        z, noise = measurements.z[first:, :3], measurements.noise[first:, :3, :3]
        found = associate(z, noise, mean[:, :3], spread[:, :3, :3], self._config.gate_sigma)
        return [int(free[row]) if row >= 0 else -1 for row in found]

    def _rows_to_id(self, row: int, source: str) -> str:
        if row >= 0:
            return self._ids[row]
        self._born[source] += 1
        return f"{source}/#{self._born[source]}"

    def _advance(self, frame: DetectionFrame, rows: npt.NDArray[np.intp], measurements: Measurements) -> None:
        """Tracks ``rows`` by one measurement each."""
        dt_ns = frame.stamp_ns - self._stamp_ns[rows]
        if dt_ns.min() <= 0:
            self.dropped["late"] += int((dt_ns < 0).sum())
            self.dropped["duplicate"] += int((dt_ns == 0).sum())
            usable = np.flatnonzero(dt_ns > 0)
            rows, measurements, dt_ns = rows[usable], measurements.take(usable), dt_ns[usable]
        full = measurements.full.tolist()
        if not any(full):
            self._filter(frame, rows, dt_ns, measurements, full=False)
            return
        for part in (False, True):
            chosen = np.flatnonzero(measurements.full == part)
            self._filter(frame, rows[chosen], dt_ns[chosen], measurements.take(chosen), full=part)

    def _filter(
        self,
        frame: DetectionFrame,
        rows: npt.NDArray[np.intp],
        dt_ns: IntArray,
        measurements: Measurements,
        *,
        full: bool,
    ) -> None:
        """One update of the tracks ``rows``; one far off is skipped once, a second time restarts the track there."""
        if not rows.size:
            return
        z, noise = measurements.parts(full)
        everything = rows.tolist() == list(range(len(self)))  # as when a frame shows every track, the common case
        before = self._bank if everything else self._bank.take(rows)
        foreign = frame.kind is DetectionKind.TRACK
        after, nis = step(before, dt_ns / NS_PER_S, z, noise, self._constants, foreign=foreign)
        nearest = nis.min(axis=1)
        if nearest.max() > self._config.jump_sigma**2:
            far = nearest > self._config.jump_sigma**2
            again = far & self._missed[rows]
            after = put(after, np.flatnonzero(again), birth(z[again], noise[again], self._constants))
            skipped = far & ~again
            self.dropped["outlier"] += int(skipped.sum())
            self._missed[rows] = skipped
            used = np.flatnonzero(~skipped)
            rows, after, measurements = rows[used], after.take(used), measurements.take(used)
            everything = False
        else:
            self._missed[rows] = False
        self._bank = after if everything else put(self._bank, rows, after)
        self._stamp_ns[rows] = frame.stamp_ns
        self._radius_m[rows] = measurements.radius_m
        self._carried = None

    def _spawn(self, stamp_ns: int, ids: list[str], measurements: Measurements) -> None:
        """New tracks, while there is room."""
        room = self._config.max_tracks - len(self)
        if len(ids) > room:
            self.dropped["over_max_tracks"] += len(ids) - room
            ids, measurements = ids[:room], measurements.take(np.arange(room))
        for full in (False, True):
            chosen = np.flatnonzero(measurements.full == full)
            if not chosen.size:
                continue
            part = measurements.take(chosen)
            self._bank = join(self._bank, birth(*part.parts(full), self._constants))
            self._ids += [ids[k] for k in chosen]
            self._stamp_ns = np.append(self._stamp_ns, np.full(chosen.size, stamp_ns, dtype=np.int64))
            self._radius_m = np.append(self._radius_m, part.radius_m)
            self._missed = np.append(self._missed, np.zeros(chosen.size, dtype=np.bool_))
        self._index()

    def _keep(self, rows: npt.NDArray[np.intp]) -> None:
        self._bank = self._bank.take(rows)
        self._ids = [self._ids[row] for row in rows]
        self._stamp_ns, self._radius_m = self._stamp_ns[rows], self._radius_m[rows]
        self._missed = self._missed[rows]
        self._index()

    def _index(self) -> None:
        self._rows = {track_id: row for row, track_id in enumerate(self._ids)}
        self._carried = None


def _read_only(array: FloatArray) -> FloatArray:
    array.flags.writeable = False
    return array
