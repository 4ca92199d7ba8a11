"""Between the shell and the brain: gathers a tick's obstacles, asks the pilot, turns any failure into FAULT.

Also knows why only holding is safe now: a required source that is silent, obstacle frames that cannot be placed in
time, a policy whose output is not usable.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from dataclasses import dataclass

from companion.clock import stopwatch_ns
from companion.config import Config
from companion.journal import Brain
from companion.link.inbox import ObstacleInbox
from companion.pilot import PilotInput, PilotOutput, Task
from companion.session import VehicleSession
from companion.state import State
from companion.types import NS_PER_S, DetectionFrame, TrackTable, Vec3, VehicleState

log = logging.getLogger("companion")

_TASKS = {State.ACTIVE: Task.FLY, State.HOLD: Task.HOLD}


@dataclass(frozen=True, slots=True)
class TickFrames:
    """A tick's obstacle frames, and the time spent on them before its vehicle state was there."""

    tick_ns: int
    frames: tuple[DetectionFrame, ...]
    ahead_ns: int = 0


class Thinker:
    """One pilot behind a guard."""

    def __init__(self, config: Config, pilot: Brain, inbox: ObstacleInbox, session: VehicleSession) -> None:
        self._config = config
        self._pilot = pilot
        self._inbox = inbox
        self._session = session
        self.reset()

    def adopt(self, config: Config) -> None:
        """The profile is known: the pilot needs its delays, rate and limits."""
        self._config = config
        self._pilot = self._pilot.configured(config)

    def reset(self) -> None:
        """The vehicle's clock began anew: forget tracks, queues and everything that was dated."""
        self._pilot.reset()
        self._inbox.reset()
        self._ahead: TickFrames | None = None
        self._silent_since: dict[str, int] = {}
        self._undated = self._inbox.counts["no_time_base"]
        self._undated_ns: int | None = None  # last tick at which frames could not be placed in time
        self._policy_valid = True

    def retune(self, config: Config) -> None:
        """Fly on under ``config``. Raises ConfigError where the pilot cannot; nothing has changed then."""
        self._pilot.retune(config)
        self._config = config

    def tracks(self) -> TrackTable:
        return self._pilot.tracks()

    @property
    def tracking_counts(self) -> dict[str, int]:
        return self._pilot.tracking_counts

    def observe_ahead(self, after_ns: int, now_ns: int) -> None:
        """In lockstep: the next tick's obstacles may be here before its vehicle state; track them meanwhile."""
        tick_ns = self._inbox.complete_through_ns(self._config.lockstep_sources)
        prepared_ns = -1 if self._ahead is None else self._ahead.tick_ns
        if tick_ns is None or tick_ns <= max(after_ns, prepared_ns) or self._faulty:
            return
        began_ns = stopwatch_ns()
        frames = self._inbox.drain(tick_ns)
        with self.fault_on_error(now_ns):
            self._pilot.observe(frames, tick_ns)
        self._ahead = TickFrames(tick_ns, frames, stopwatch_ns() - began_ns)

    def take_frames(self, tick_ns: int, unix_minus_vehicle_ns: int | None) -> TickFrames:
        """The frames of this tick; also judges whether the brain's inputs allow more than holding."""
        taken, self._ahead = self._ahead, None
        if taken is None or taken.tick_ns != tick_ns:
            taken = TickFrames(tick_ns, self._inbox.drain(tick_ns, unix_minus_vehicle_ns=unix_minus_vehicle_ns))
        self._session.degraded(self._degradation(tick_ns))
        return taken

    def think(
        self, vehicle: VehicleState, frames: tuple[DetectionFrame, ...], target_enu: Vec3 | None, now_ns: int
    ) -> PilotOutput | None:
        """The brain's answer, None in FAULT."""
        if self._faulty:
            return None
        situation = self._session.situation
        task = _TASKS.get(situation.state, Task.STAY)
        inputs = PilotInput(vehicle=vehicle, frames=frames, task=task, target_enu=target_enu)
        output = None
        with self.fault_on_error(now_ns):
            output = self._pilot.step(inputs, sent=self._session.streams and situation.external)
            self._policy_valid = output.policy_valid
            if output.origin_moved_m is not None:
                self._session.watch.origin_moved(output.origin_moved_m, now_ns)
        return output

    @contextlib.contextmanager
    def fault_on_error(self, now_ns: int) -> Iterator[None]:
        """Whatever goes wrong inside, the answer is FAULT."""
        try:
            yield
        except Exception as error:
            log.exception("the brain failed")
            self._session.fail(f"brain failed: {type(error).__name__}: {error}", now_ns)
            self._pilot.reset()
            self._session.poll(now_ns)

    @property
    def _faulty(self) -> bool:
        return self._session.situation.state is State.FAULT

    def _degradation(self, tick_ns: int) -> str | None:
        """Why only holding is safe now, or None."""
        obstacles = self._config.obstacles
        silent_ns = obstacles.silent_s * NS_PER_S
        for source in obstacles.required:
            heard_ns = self._inbox.newest_stamp_ns(source)
            since_ns = self._silent_since.setdefault(source, tick_ns) if heard_ns is None else heard_ns
            if tick_ns - since_ns > silent_ns:
                return f"obstacle source {source} silent"
        undated = self._inbox.counts["no_time_base"]
        if undated > self._undated:
            self._undated, self._undated_ns = undated, tick_ns
        if self._undated_ns is not None and tick_ns - self._undated_ns <= silent_ns:
            return "time base lost: unix stamps without TIMESYNC"
        return None if self._policy_valid else "policy output invalid"
