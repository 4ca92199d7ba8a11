"""The asyncio shell: links in, one control task, records out (design 2, 3, 4).

The control task is driven by vehicle telemetry and wakes by itself without it. Everything runs on the loop's thread;
Zenoh's callbacks only hand bytes over.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from companion.clock import Clock, stopwatch_ns
from companion.config import Config
from companion.doors import Doors
from companion.errors import CompanionError, LockstepStalled
from companion.link import mav
from companion.link.events import TimesyncReply, TimesyncRequest
from companion.link.inbox import ObstacleInbox
from companion.link.mavlink import MavlinkCodec, packet_count
from companion.link.timesync import TimeSync
from companion.link.transports import Transport, open_transport
from companion.link.zenoh import ZenohLink
from companion.metrics import TickMeter
from companion.pilot import Pilot, PilotInput, PilotOutput, Task
from companion.publisher import Publisher
from companion.record import Recorder
from companion.report import setpoint_record
from companion.route import Route
from companion.session import VehicleSession
from companion.state import FLYING, State
from companion.types import NS_PER_S, DetectionFrame, VehicleState

log = logging.getLogger("companion")

HEARTBEAT_NS = NS_PER_S
STATUS_NS = NS_PER_S // 5
TIMESYNC_NS = NS_PER_S
TIMESYNC_SETTLING_NS = NS_PER_S // 10
STALL_NS = NS_PER_S  # lockstep: no progress for this much wall time ends the run
WAKE_S = 0.2  # of wall time: heartbeats, timeouts and the stall guard need no telemetry
RELEASE_NS = 6 * NS_PER_S // 10  # on shutdown in flight the autopilot is given this long to show its hold mode

_TASKS = {State.ACTIVE: Task.FLY, State.HOLD: Task.HOLD}
_SYSTEM_STATUS = {
    State.WAITING: mav.STATE_BOOT,
    State.READY: mav.STATE_STANDBY,
    State.OVERRIDDEN: mav.STATE_STANDBY,
    State.FAULT: mav.STATE_CRITICAL,
}


@dataclass(frozen=True, slots=True)
class Summary:
    """What a run amounted to; ``companion run --json`` prints it."""

    ticks: int
    verdicts: dict[str, int]
    tick_ms: dict[str, float]
    deadline_misses: int
    states_skipped: int
    counts: dict[str, int]
    final_state: str
    log: str | None
    log_hash: str


@dataclass(frozen=True, slots=True)
class _Ahead:
    """A tick's frames, taken before its vehicle state was there."""

    tick_ns: int
    frames: tuple[DetectionFrame, ...]
    spent_ns: int


class Service:
    """One vehicle, one brain. ``run`` returns after ``stop``, and raises whatever else ended it."""

    def __init__(self, config: Config, clock: Clock, *, pilot: Pilot | None = None) -> None:
        self._config = config
        self._clock = clock
        self._lockstep = config.sync == "lockstep"
        self._pilot = Pilot(config) if pilot is None else pilot
        self._codec = MavlinkCodec(system=config.mavlink.system_id or 1)
        self._route = Route(config.target, config.limits)
        self._session = VehicleSession(config, self._codec, self._route.set_position)
        self._inbox = ObstacleInbox(
            queue=config.obstacles.queue,
            max_age_s=config.obstacles.max_age_s,
            sources=(*config.lockstep_sources, *config.obstacles.required),
            on_report=log.warning,
        )
        self._timesync = TimeSync()
        self._meter = TickMeter(1.0 / config.rate_hz)
        self._publisher: Publisher
        self._doors = Doors(
            config,
            self._session,
            self._route,
            self._inbox,
            self._meter,
            now_ns=self._now_ns,
            on_vehicle=self._on_vehicle,
            on_change=self._on_change,
        )
        self._wake = asyncio.Event()
        self._stopping = False
        self._pending: VehicleState | None = None  # the newest state, not yet answered
        self._arrived_ns = 0  # its arrival, for the latency figure
        self._pending_since_ns = 0
        self._ahead: _Ahead | None = None
        self._vehicle_ns = 0  # vehicle time of the newest state
        self._silent_since: dict[str, int] = {}
        self._policy_valid = True
        self._last_beat: tuple[int, int] | None = None
        self._last_timesync_ns: int | None = None
        self._transport: Transport

    def stop(self) -> None:
        """Ask for a clean end: release first if flying, then close everything."""
        self._stopping = True
        self._wake.set()

    async def run(self) -> Summary:
        """Open the links and fly until stopped.

        Raises:
            ConfigError: a link or the log cannot be opened as configured.
            LockstepStalled: the other side went silent in lockstep.
        """
        config = self._config
        loop = asyncio.get_running_loop()
        async with contextlib.AsyncExitStack() as stack:
            recorder = None
            if config.log.directory is not None:
                recorder = Recorder(Path(config.log.directory) / "flight.mcap", config)
                stack.callback(recorder.close)
            self._transport = await open_transport(config.mavlink.url, self._on_bytes, clock=self._clock)
            stack.push_async_callback(self._transport.close)
            zenoh = ZenohLink.open(config.zenoh, config.prefix, loop, self._doors.handlers(), lockstep=self._lockstep)
            stack.callback(zenoh.close)
            self._publisher = Publisher(zenoh, recorder)
            gc.collect()
            gc.freeze()  # what exists now lives as long as the daemon: no later collection has to walk it
            log.info("up: %s, zenoh prefix %s", config.mavlink.url, config.prefix)
            await self._until_stopped()
        return self._summary(recorder)

    async def _until_stopped(self) -> None:
        try:
            async with asyncio.TaskGroup() as group:
                waker = group.create_task(self._keep_waking())
                await self._control()
                waker.cancel()
        except* CompanionError as errors:
            raise errors.exceptions[0] from None

    # the control task

    async def _keep_waking(self) -> None:
        while True:
            await self._clock.sleep(WAKE_S)
            self._wake.set()

    async def _control(self) -> None:
        deadline_ns: int | None = None  # of the shutdown
        while True:
            await self._wake.wait()
            self._wake.clear()
            if self._stopping and deadline_ns is None:
                deadline_ns = self._begin_shutdown()
            if self._pending is not None and self._inputs_complete(self._pending):
                vehicle, self._pending = self._pending, None
                self._tick(vehicle)
            elif self._pending is None and self._lockstep:
                self._observe_ahead()
            self._housekeeping()
            if deadline_ns is not None and (
                self._session.situation.state not in FLYING or self._clock.monotonic_ns() >= deadline_ns
            ):
                return

    def _begin_shutdown(self) -> int:
        """Hand the vehicle back: ask for the hold mode and stream until it is seen, for at most RELEASE_NS."""
        log.info("stopping")
        if self._session.situation.state in FLYING:
            self._session.release(self._now_ns())
            self._flush()
        return self._clock.monotonic_ns() + RELEASE_NS

    def _inputs_complete(self, vehicle: VehicleState) -> bool:
        """In lockstep: whether every source's marker and frames for this tick are there."""
        sources = self._config.lockstep_sources
        if not self._lockstep or self._inbox.ready(vehicle.stamp_ns, sources):
            return True
        if self._clock.monotonic_ns() - self._pending_since_ns > STALL_NS:
            missing = self._inbox.missing(vehicle.stamp_ns, sources)
            raise LockstepStalled(f"lockstep: no progress for 1 s at tick {vehicle.stamp_ns}: missing {missing}")
        return False

    def _observe_ahead(self) -> None:
        """In lockstep: the next tick's obstacles may be here before its vehicle state; track them meanwhile."""
        tick_ns = self._inbox.complete_through_ns(self._config.lockstep_sources)
        prepared_ns = -1 if self._ahead is None else self._ahead.tick_ns
        if tick_ns is None or tick_ns <= max(self._vehicle_ns, prepared_ns) or self._faulty:
            return
        began_ns = stopwatch_ns()
        frames = self._inbox.drain(tick_ns)
        with self._fault_on_error():
            self._pilot.observe(frames, tick_ns)
        self._ahead = _Ahead(tick_ns, frames, stopwatch_ns() - began_ns)

    def _tick(self, vehicle: VehicleState) -> None:
        """One vehicle state in, one record out, and a setpoint where the state of the daemon sends one."""
        started_ns = stopwatch_ns()
        session = self._session
        session.poll(self._now_ns())
        frames, ahead_ns = self._take_frames(vehicle.stamp_ns)
        session.degraded(self._degradation(vehicle.stamp_ns))
        self._route.advance(vehicle.p_enu)
        output = self._think(vehicle, frames)
        thought_ns = stopwatch_ns()
        sent = output is not None and session.streams
        messages = self._flush()
        if output is not None and sent:
            self._send_setpoint(vehicle, output)
        sent_ns = stopwatch_ns()
        timings_ms = {
            "queue": (started_ns - self._arrived_ns) / 1e6,
            "ahead": ahead_ns / 1e6,  # spent on this tick before its state arrived, lockstep only
            "brain": (thought_ns - started_ns) / 1e6,
            "total": (sent_ns - self._arrived_ns + ahead_ns) / 1e6,
        }
        record = setpoint_record(
            vehicle.stamp_ns, session.situation.state, output, sent=sent, messages=messages, timings_ms=timings_ms
        )
        self._publisher.tick(record, session.situation.state, vehicle, frames, output, self._pilot.tracks)
        self._meter.tick(timings_ms["total"], record.verdict)

    def _take_frames(self, tick_ns: int) -> tuple[tuple[DetectionFrame, ...], int]:
        """The frames of this tick, and the time that was spent on them before its state arrived [ns]."""
        ahead, self._ahead = self._ahead, None
        if ahead is not None and ahead.tick_ns == tick_ns:
            return ahead.frames, ahead.spent_ns
        return self._inbox.drain(tick_ns, unix_minus_vehicle_ns=self._timesync.unix_minus_vehicle_ns), 0

    def _think(self, vehicle: VehicleState, frames: tuple[DetectionFrame, ...]) -> PilotOutput | None:
        """The brain's answer, None in FAULT."""
        situation = self._session.situation
        if self._faulty:
            return None
        task = _TASKS.get(situation.state, Task.STAY)
        inputs = PilotInput(vehicle=vehicle, frames=frames, task=task, target_enu=self._route.current)
        output = None
        with self._fault_on_error():
            output = self._pilot.step(inputs, sent=self._session.streams and situation.external)
            self._policy_valid = output.policy_valid
        return output

    @property
    def _faulty(self) -> bool:
        return self._session.situation.state is State.FAULT

    @contextlib.contextmanager
    def _fault_on_error(self) -> Iterator[None]:
        """Whatever is wrong with the brain, the answer is FAULT."""
        try:
            yield
        except Exception as error:
            log.exception("the brain failed")
            self._session.fail(f"brain failed: {type(error).__name__}: {error}")
            self._pilot.reset()
            self._session.poll(self._now_ns())

    def _send_setpoint(self, vehicle: VehicleState, output: PilotOutput) -> None:
        self._transport.send(
            self._codec.encode_setpoint(
                vehicle.stamp_ns // 1_000_000, output.wire, self._config.profile.type_mask, v_enu=vehicle.v_enu
            )
        )

    def _degradation(self, stamp_ns: int) -> str | None:
        """Why only holding is safe now, or None."""
        for source in self._config.obstacles.required:
            heard_ns = self._inbox.newest_stamp_ns(source)
            since_ns = self._silent_since.setdefault(source, stamp_ns) if heard_ns is None else heard_ns
            if stamp_ns - since_ns > self._config.obstacles.silent_s * NS_PER_S:
                return f"obstacle source {source} silent"
        return None if self._policy_valid else "policy output invalid"

    # housekeeping

    def _now_ns(self) -> int:
        """Vehicle time in lockstep, so that every timeout counts it; the monotonic clock otherwise."""
        return self._vehicle_ns if self._lockstep else self._clock.monotonic_ns()

    def _housekeeping(self) -> None:
        """Whatever is due by time: timeouts, heartbeat, TIMESYNC, status."""
        now_ns, wall_ns = self._now_ns(), self._clock.monotonic_ns()
        if not self._lockstep:
            self._session.poll(now_ns)
            every_ns = TIMESYNC_NS if self._timesync.settled else TIMESYNC_SETTLING_NS
            if self._last_timesync_ns is None or wall_ns - self._last_timesync_ns >= every_ns:
                self._last_timesync_ns = wall_ns
                self._transport.send(self._codec.encode_timesync_request(self._timesync.request(wall_ns)))
        state = self._session.situation.state
        last = self._last_beat
        if last is None or now_ns - last[0] >= HEARTBEAT_NS or wall_ns - last[1] >= HEARTBEAT_NS:
            self._last_beat = (now_ns, wall_ns)
            self._transport.send(self._codec.encode_heartbeat(_SYSTEM_STATUS.get(state, mav.STATE_ACTIVE)))
        self._flush()
        self._publish_status(now_ns)

    def _flush(self) -> int:
        """Send what the session has to say; the number of MAVLink packets."""
        outgoing = self._session.take_outgoing()
        for data in outgoing:
            self._transport.send(data)
        return sum(packet_count(data) for data in outgoing)

    def _publish_status(self, now_ns: int) -> None:
        self._publisher.status(
            now_ns,
            self._vehicle_ns,
            self._session,
            target_enu=self._route.current,
            counts=self._counts,
            meter=self._meter,
        )

    def _counts(self) -> dict[str, int]:
        """Everything counted, by kind."""
        meter = self._meter
        return {
            **{f"verdict.{name}": count for name, count in sorted(meter.verdicts.items())},
            **{f"obstacles.{name}": count for name, count in sorted(self._inbox.counts.items())},
            **{f"mavlink.{name}": count for name, count in sorted(self._codec.counts.items())},
            "deadline_misses": meter.deadline_misses,
            "states_skipped": meter.states_skipped,
        }

    def _summary(self, recorder: Recorder | None) -> Summary:
        meter = self._meter
        return Summary(
            ticks=meter.ticks,
            verdicts=dict(meter.verdicts),
            tick_ms=meter.quantiles_ms(),
            deadline_misses=meter.deadline_misses,
            states_skipped=meter.states_skipped,
            counts=self._counts(),
            final_state=self._session.situation.state.value,
            log=None if recorder is None else str(recorder.path),
            log_hash=self._publisher.log_hash,
        )

    # what the links hand in

    def _on_bytes(self, data: bytes) -> None:
        for event in self._codec.receive(data):
            if isinstance(event, TimesyncRequest | TimesyncReply):
                self._on_timesync(event)
            elif (vehicle := self._session.handle(event, self._now_ns())) is not None:
                self._on_vehicle(vehicle)
        self._flush()

    def _on_vehicle(self, vehicle: VehicleState) -> None:
        """A new vehicle state; only the newest waits for the control task."""
        if self._timesync.vehicle_time(vehicle.stamp_ns):
            log.warning("the autopilot rebooted: tracks and clock offset start anew")
            self._inbox.reset()
            self._pilot.reset()
        elif self._pending is not None:
            self._meter.states_skipped += 1
            if vehicle.stamp_ns <= self._pending.stamp_ns:
                return
        elif 0 < vehicle.stamp_ns <= self._vehicle_ns:
            return  # reordered or repeated by the link
        self._pending = vehicle
        self._vehicle_ns = vehicle.stamp_ns
        self._arrived_ns = stopwatch_ns()
        self._pending_since_ns = self._clock.monotonic_ns()
        self._session.heard_vehicle(vehicle, self._now_ns())
        self._wake.set()

    def _on_timesync(self, event: TimesyncRequest | TimesyncReply) -> None:
        now_ns = self._clock.monotonic_ns()
        if isinstance(event, TimesyncReply):
            if event.system == self._session.system and event.component == mav.AUTOPILOT_COMPONENT:
                self._timesync.reply(
                    tc1_ns=event.tc1_ns, ts1_ns=event.ts1_ns, now_ns=now_ns, unix_ns=self._clock.unix_ns()
                )
        elif self._timesync.settled:
            self._transport.send(self._codec.encode_timesync_reply(tc1_ns=now_ns, ts1_ns=event.ts1_ns))

    def _on_change(self) -> None:
        """A command or a marker came by Zenoh: answer the autopilot and look again."""
        self._flush()
        self._wake.set()
