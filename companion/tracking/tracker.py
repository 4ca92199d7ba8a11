"""From frames of detections to tracks, and from tracks to the prediction that the safety filter looks along.

Every frame is used at its own stamp, whatever the order of arrival (`replay`); what a frame does to the tracks is
`cycle`. Every track stays at the instant of its own last measurement; `table`, `predict` and `forecast` carry all of
them to one instant without touching them. Tracks end by the stamps of frames; the time of the tick only hides those
that have not been seen for `coast_s`, because a frame that is still under way may show one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from companion.config import TrackingConfig
from companion.tracking.agility import growth_factor, surprise
from companion.tracking.bank import Bank
from companion.tracking.cycle import Rules, consume
from companion.tracking.engine import make_engine
from companion.tracking.imm import fuse, widened
from companion.tracking.lifecycle import forget
from companion.tracking.models import FEW
from companion.tracking.ownship import OwnPath
from companion.tracking.picture import Picture, empty_picture, source_names, statuses
from companion.tracking.predict import Horizon, horizon, joined, largest_sigma, velocity_ahead
from companion.tracking.replay import Replay
from companion.tracking.tracks import BoolArray, Rows, Tracks
from companion.types import NS_PER_S, DetectionFrame, FloatArray, Prediction, TrackTable, VehicleState

HORIZONS = 64  # kept at most: their number follows that of different ages of the newest measurement


class Tracker:
    """Tracks of moving obstacles.

    Args:
        vehicle_radius_m: of the vehicle whose own detections are recognised, see `ownship`.
    """

    def __init__(self, config: TrackingConfig, vehicle_radius_m: float = 0.2) -> None:
        self._engine = make_engine(config)
        self._constants = self._engine.constants
        self._rules = Rules(config, self._engine, vehicle_radius_m, round(config.coast_s * NS_PER_S))
        self._replay_ns = round(config.replay_s * NS_PER_S)
        self._replay = Replay(config.replay_s)
        self._path = OwnPath()
        self._horizons: dict[tuple[float, int, float], Horizon] = {}  # by start after the state, steps and dt_s
        self.reset()

    def reset(self) -> None:
        """Forget everything; the next update is bit-equal to the first of a new tracker."""
        self._replay.reset()
        self._path.reset()
        self._now_ns = 0
        self._picture = empty_picture(self._constants)

    def retune(self, vehicle_radius_m: float) -> None:
        """From the next update on the vehicle is this large; all tracks stay."""
        self._rules = replace(self._rules, vehicle_radius_m=vehicle_radius_m)

    def forget_path(self) -> None:
        """The vehicle's local frame moved: where it was does not tell any more which detections are its own."""
        self._path.reset()

    def __len__(self) -> int:
        return int(self._visible().sum())

    @property
    def dropped(self) -> Counter[str]:
        """What was not used, and what ended, by reason.

        Detections: ``late`` (older than their track, too late for the replay buffer), ``duplicate`` (a
        stamp seen before), ``outlier`` (far off its track), ``not_finite``, ``own_vehicle`` (the vehicle itself).
        Tracks: ``lost`` (no measurement for ``coast_s``), ``unconfirmed``, ``over_max_tracks``.
        """
        counts = self._picture.counts.copy()
        hidden = ~self._visible()
        counts["lost"] += int((hidden & self._picture.tracks.confirmed).sum())
        counts["unconfirmed"] += int((hidden & ~self._picture.tracks.confirmed).sum())
        return +counts

    def note_vehicle(self, state: VehicleState) -> None:
        """Where the vehicle itself is. Tell it after the `update` of the same instant."""
        self._path.note(state)

    def update(self, frames: Sequence[DetectionFrame], now_ns: int) -> None:
        """Use ``frames``; tracks without a measurement for ``coast_s`` before ``now_ns`` are shown no more."""
        self._now_ns = now_ns
        picture = self._replay.run(
            frames, self._picture, lambda before, frame: consume(before, frame, self._rules, self._path)
        )
        self._picture = self._forget(picture)

    def table(self) -> TrackTable:
        """The tracks at the instant of the last `update`, fused over the models, tentative ones included."""
        picture = self._picture
        tracks, bank = picture.tracks, picture.tracks.bank
        since_s = (self._now_ns - tracks.stamp_ns) / NS_PER_S
        x, covariance = self._engine.propagate(bank.x, bank.covariance, since_s)
        mean, spread = fuse(x, covariance, bank.probabilities)
        seen = np.flatnonzero(self._visible())
        status, sources = statuses(picture), source_names(picture)
        return TrackTable(
            stamp_ns=self._now_ns,
            ids=tuple([tracks.ids[row] for row in seen]),
            p_enu=_read_only(mean[seen, :3]),
            v_enu=_read_only(mean[seen, 3:6]),
            a_enu=_read_only(mean[seen, 6:9]),
            covariance=_read_only(spread[seen, :9, :9]),
            mode_probabilities=_read_only(bank.probabilities[seen]),
            radius_m=_read_only(tracks.radius_m()[seen]),
            age_s=_read_only((self._now_ns - tracks.stamp_ns[seen]) / NS_PER_S),
            surprise=_read_only(surprise(bank.means[seen])),
            growth=_read_only(growth_factor(bank.means[seen], self._constants.watch)),
            status=tuple([status[row] for row in seen]),
            sources=tuple([sources[row] for row in seen]),
        )

    def predict(self, start_ns: int, steps: int, dt_s: float) -> Prediction:
        """Every confirmed track at ``start_ns + k dt_s``, k = 0..steps-1 (20).

        Each is carried there from the instant of its own last measurement at once; the covariance of one that breaks
        its models grows faster, see `agility`.
        """
        tracks, bank, rows = self._confirmed()
        since_s = (start_ns - tracks.stamp_ns[rows]) / NS_PER_S
        p_enu, spread = self._ahead(bank, self._grid(since_s, steps, dt_s))
        v_enu, a_enu = velocity_ahead(bank.x, bank.probabilities, since_s, self._constants.models)
        return Prediction(
            start_ns=start_ns,
            dt_s=dt_s,
            ids=tracks.ids if len(rows) == len(tracks) else tuple([tracks.ids[row] for row in rows]),
            p_enu=_read_only(p_enu),
            sigma_m=_read_only(largest_sigma(spread)),
            v_enu=_read_only(v_enu),
            a_enu=_read_only(a_enu),
            radius_m=_read_only(tracks.radius_m()[rows]),
        )

    def forecast(self, start_ns: int, tau_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Position of every confirmed track ``tau_s`` (K,) after ``start_ns``, (M, K, 3) [m], and its covariance.

        The covariance has its entries xx, yy, zz, yz, xz, xy first: (M, 6, K) [m^2], spread of means included.
        """
        tracks, bank, rows = self._confirmed()
        since_s = (start_ns - tracks.stamp_ns[rows]) / NS_PER_S
        return self._ahead(bank, horizon(since_s[:, None] + tau_s, self._constants.models))

    def _ahead(self, bank: Bank, at: Horizon) -> tuple[FloatArray, FloatArray]:
        p_enu, spread = self._engine.predict(bank.x, bank.covariance, bank.probabilities, at)
        return p_enu, widened(spread, bank, self._constants)

    def _grid(self, since_s: FloatArray, steps: int, dt_s: float) -> Horizon:
        """The instants of a prediction; where tracks share them they are kept, as in steady flight."""
        starts: list[float] = since_s.tolist()
        different = set(starts)
        if len(different) == 1:
            return self._kept_horizon(starts[0], steps, dt_s)
        if not 0 < len(different) <= FEW:
            return horizon(since_s[:, None] + np.arange(float(steps)) * dt_s, self._constants.models)
        return joined([self._kept_horizon(first_s, steps, dt_s) for first_s in starts])

    def _kept_horizon(self, first_s: float, steps: int, dt_s: float) -> Horizon:
        key = (first_s, steps, dt_s)
        if key not in self._horizons:
            if len(self._horizons) >= HORIZONS:
                self._horizons.clear()
            self._horizons[key] = horizon(first_s + np.arange(float(steps)) * dt_s, self._constants.models)
        return self._horizons[key]

    def _visible(self) -> BoolArray:
        """Tracks with a measurement within ``coast_s``; which coast for less is for the stamps of frames to say."""
        return np.asarray(self._picture.tracks.stamp_ns >= self._now_ns - self._rules.coast_ns)

    def _confirmed(self) -> tuple[Tracks, Bank, Rows]:
        """All tracks, the bank of those that are confirmed and shown, and their rows."""
        tracks = self._picture.tracks
        rows = np.flatnonzero(self._visible() & tracks.confirmed)
        return tracks, tracks.bank if len(rows) == len(tracks) else tracks.bank.take(rows), rows

    def _forget(self, picture: Picture) -> Picture:
        """Without the tracks that no frame still admissible could revive."""
        counts = picture.counts.copy()
        oldest_ns = self._now_ns - self._replay_ns - self._rules.coast_ns
        tracks = forget(picture.tracks, oldest_ns, counts)
        return picture if tracks is picture.tracks else replace(picture, tracks=tracks, counts=counts)


def _read_only(array: FloatArray) -> FloatArray:
    array.flags.writeable = False
    return array
