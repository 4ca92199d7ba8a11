"""The asyncio shell: links in, one control task, records out (design 2, 3, 4).

The control task is driven by vehicle telemetry and wakes by itself without it. Everything runs on the loop's thread;
Zenoh's callbacks only hand bytes over.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import logging
from pathlib import Path

from companion import realtime
from companion.clock import Clock, stopwatch_ns
from companion.config import Config
from companion.doors import Doors
from companion.errors import CompanionError
from companion.journal import Journal
from companion.link import mav
from companion.link.events import Event, TimesyncReply, TimesyncRequest
from companion.link.inbox import ObstacleInbox
from companion.link.mavlink import MavlinkCodec, packet_count
from companion.link.params import ParamRequest
from companion.link.router import Router
from companion.link.signing_files import open_signing
from companion.link.traffic import TrafficDoors
from companion.link.traffic_events import TrafficEvent
from companion.link.zenoh import ZenohLink
from companion.lockstep import LockstepBarrier
from companion.metrics import Summary, TickMeter
from companion.microservices import Microservices
from companion.parameters import with_stored
from companion.pilot import Pilot, PilotOutput
from companion.publisher import Publisher
from companion.record import Recorder
from companion.report import setpoint_record, sources_out
from companion.route import Route
from companion.scene_log import SceneLog
from companion.sdnotify import Notifier
from companion.session import VehicleSession
from companion.state import FLYING
from companion.thinker import Thinker
from companion.timebase import TimeBase
from companion.types import NS_PER_S, VehicleState
from companion.vitals import Vitals

log = logging.getLogger("companion")

HEARTBEAT_NS = NS_PER_S
WAKE_S = 0.2  # of wall time: heartbeats, timeouts and the stall guard need no telemetry
RELEASE_NS = 6 * NS_PER_S // 10  # on shutdown in flight the autopilot is given this long to show its hold mode


class Service:
    """One vehicle, one brain. ``run`` returns after ``stop``, and raises whatever else ended it."""

    def __init__(
        self, config: Config, clock: Clock, *, pilot: Pilot | None = None, notifier: Notifier | None = None
    ) -> None:
        base, config = config, with_stored(config)
        self._config = config
        self._clock = clock
        self._lockstep = config.sync == "lockstep"
        signing = open_signing(config.mavlink.signing, clock.unix_ns, log.warning)
        self._codec = MavlinkCodec(system=config.mavlink.system_id or 1, signing=signing)
        self._route = Route(config.target, config.limits)
        self._session = VehicleSession(config, self._codec, self._route.set_position, self._on_profile)
        self._transport = Router(config.mavlink, self._codec, self._session, clock, self._on_events)
        self._inbox = ObstacleInbox(
            queue=config.obstacles.queue,
            per_tick=config.obstacles.per_tick,
            max_age_s=config.obstacles.max_age_s,
            sources=(*config.lockstep_sources, *config.obstacles.required),
            on_report=log.warning,
            doors=config.traffic.open_doors,
            unix_ns=clock.unix_ns,
        )
        self._traffic = TrafficDoors(
            config.traffic,
            self._inbox,
            self._session.request_message,
            elapsed_ns=None if self._lockstep else clock.monotonic_ns,
        )
        self._session.origin = lambda: self._traffic.origin
        self._barrier = LockstepBarrier(config, self._inbox, clock)
        pilot = Pilot(config) if pilot is None else pilot
        self._journal = None if config.log.directory is None else Journal(pilot, config, artifact=pilot.artifact)
        self._thinker = Thinker(config, self._journal or pilot, self._inbox, self._session)
        self._time = TimeBase(clock, self._codec, self._transport.send, self._on_restart, runs=not self._lockstep)
        self._time.on_step = self._session.watch.unix_stepped
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
        self._services = Microservices(
            base, config, self._codec, self._session, clock, send=self._transport.send, retune=self._retune
        )
        parts = self._session, self._meter, self._inbox, self._transport
        self._vitals = Vitals(clock, notifier or Notifier(None), *parts, self._groups, lambda: self._vehicle_ns)
        self._garbage = realtime.Collector()
        self._wake = asyncio.Event()
        self._stopping = False
        self._pending: VehicleState | None = None  # the newest state, not yet answered
        self._arrived_ns = 0  # its arrival, for the latency figure
        self._arrived_unix_ns = 0  # and for the log
        self._vehicle_ns = 0  # vehicle time of the newest state
        self._last_beat: tuple[int, int] | None = None

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
            stack.callback(self._vitals.close)
            recorder, scenes = self._open_log(stack)
            realtime.apply(config.realtime, log.warning)  # behind the recorder, before the links' threads
            await self._transport.open()  # first: a heartbeat that comes while the rest is loaded waits in the socket
            stack.push_async_callback(self._transport.close)
            self._load()
            zenoh = ZenohLink.open(config.zenoh, config.prefix, loop, self._doors.handlers(), lockstep=self._lockstep)
            stack.callback(zenoh.close)
            self._publisher = Publisher(zenoh, recorder, scenes, self._journal)
            if config.http.enabled:
                await self._serve_http(stack)
            self._garbage.take_over(realtime.load_seldom())
            stack.callback(self._garbage.hand_back)
            self._vitals.up(self._publisher)
            log.info("up: %s, zenoh prefix %s", config.mavlink.url, config.prefix)
            await self._until_stopped()
        return self._summary(recorder)

    def _load(self) -> None:
        """Import what takes long before Zenoh tells that we are there: lockstep gives the first answer a second."""
        if self._config.http.enabled:
            for name in ("companion.http", "companion.page.handlers", "companion.probes"):
                importlib.import_module(name)
        if self._lockstep or self._config.safety.solver == "osqp":
            realtime.load_seldom(wait=True)

    def _open_log(self, stack: contextlib.AsyncExitStack) -> tuple[Recorder | None, SceneLog | None]:
        """The log, where one is wanted, and who draws for it; it hears of packets and texts from now on."""
        config = self._config
        if config.log.directory is None:
            return None, None
        recorder = Recorder(Path(config.log.directory) / "flight.mcap", config, self._clock)
        stack.callback(recorder.close)
        self._transport.on_packet = recorder.packet if config.log.tlog else None
        self._session.on_text = lambda severity, text: recorder.text(self._vehicle_ns, severity, text)
        return recorder, SceneLog(recorder, config, lambda: self._traffic.origin) if config.log.scene_hz > 0.0 else None

    async def _serve_http(self, stack: contextlib.AsyncExitStack) -> None:
        """Whatever is read by HTTP; aiohttp is imported only where it serves."""
        from companion.http import HttpServer
        from companion.page.access import Access
        from companion.page.feed import PageFeed
        from companion.page.handlers import Page
        from companion.probes import add_probes

        server = HttpServer(self._config.http)
        feed = PageFeed(self._session, self._route, self._inbox, self._transport, self._clock)
        Page(server, feed, Access(self._config.http, self._doors), self._clock)
        self._publisher.watcher = feed
        add_probes(server, self._vitals)
        await server.start()
        stack.push_async_callback(server.stop)

    async def _until_stopped(self) -> None:
        try:
            async with asyncio.TaskGroup() as group:
                waker = group.create_task(self._keep_waking())
                try:
                    await self._control()
                except Exception:
                    self._give_up()
                    raise
                waker.cancel()
        except* CompanionError as errors:
            raise errors.exceptions[0] from None

    def _give_up(self) -> None:
        """The shell itself failed: the last thing the vehicle hears is a request for its hold mode."""
        now_ns = self._now_ns()
        self._session.fail("the daemon failed", now_ns)
        self._session.poll(now_ns)
        self._flush()
        self._transport.send(self._codec.encode_heartbeat(mav.STATE_CRITICAL))

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
            if self._pending is not None and self._barrier.passes(self._pending.stamp_ns):
                vehicle, self._pending = self._pending, None
                self._tick(vehicle)
            elif self._pending is None and self._lockstep:
                self._thinker.observe_ahead(self._vehicle_ns, self._now_ns())
                self._barrier.check_simulator(self._vehicle_ns)
            self._housekeeping()
            self._vitals.beat()
            if self._pending is None:
                self._garbage.idle(self._arrived_ns + NS_PER_S // self._config.rate_hz)
            if deadline_ns is not None and (
                self._session.situation.state not in FLYING or self._clock.monotonic_ns() >= deadline_ns
            ):
                return

    def _begin_shutdown(self) -> int:
        """Hand the vehicle back: ask for the hold mode and stream until it is seen, for at most RELEASE_NS."""
        log.info("stopping")
        self._vitals.stopping()
        if self._session.situation.state in FLYING:
            self._session.release(self._now_ns())
            self._flush()
        return self._clock.monotonic_ns() + RELEASE_NS

    def _tick(self, vehicle: VehicleState) -> None:
        """One vehicle state in, one record out, and a setpoint where the state of the daemon sends one."""
        started_ns, now_ns, session = stopwatch_ns(), self._now_ns(), self._session
        session.poll(now_ns)
        taken = self._thinker.take_frames(vehicle.stamp_ns, self._time.unix_minus_vehicle_ns)
        self._traffic.frames_taken()
        self._route.advance(vehicle.p_enu)
        output = self._thinker.think(vehicle, taken.frames, self._route.current, now_ns)
        thought_ns = stopwatch_ns()
        sent = False
        if output is not None and session.streams:
            with self._thinker.fault_on_error(now_ns):
                self._send_setpoint(vehicle, output)
                session.sent_setpoint(output.wire, now_ns)
                sent = True
        messages = self._flush()
        sent_ns = stopwatch_ns()
        timings_ms = {
            "queue": (started_ns - self._arrived_ns) / 1e6,
            "ahead": taken.ahead_ns / 1e6,  # spent on this tick before its state arrived, lockstep only
            "brain": (thought_ns - started_ns) / 1e6,
            "total": (sent_ns - self._arrived_ns + taken.ahead_ns) / 1e6,
        }
        state = session.situation.state
        record = setpoint_record(vehicle.stamp_ns, state, output, sent=sent, messages=messages, timings_ms=timings_ms)
        self._publisher.tick(
            record,
            state,
            vehicle,
            taken.frames,
            output,
            self._thinker.tracks,
            arrived_unix_ns=self._arrived_unix_ns,
            target_enu=self._route.current,
        )
        self._services.note(vehicle, output)
        busy_ms = (stopwatch_ns() - started_ns) / 1e6
        self._meter.tick(timings_ms["total"], busy_ms, record.verdict)

    def _send_setpoint(self, vehicle: VehicleState, output: PilotOutput) -> None:
        """Acceleration, and where the mask uses it the velocity that the vehicle should then have."""
        stamp_ms, mask = vehicle.stamp_ns // 1_000_000, self._config.type_mask
        self._transport.send(self._codec.encode_setpoint(stamp_ms, output.wire, mask, v_enu=output.v_next))

    # housekeeping

    def _now_ns(self) -> int:
        """Vehicle time in lockstep, so that every timeout counts it; the monotonic clock otherwise."""
        return self._vehicle_ns if self._lockstep else self._clock.monotonic_ns()

    def _housekeeping(self) -> None:
        """Whatever is due by time: timeouts, heartbeat, TIMESYNC, status."""
        now_ns, wall_ns = self._now_ns(), self._clock.monotonic_ns()
        if not self._lockstep:
            self._session.poll(now_ns)
            self._time.poll()
        self._traffic.poll(now_ns)
        last = self._last_beat
        if last is None or now_ns - last[0] >= HEARTBEAT_NS or wall_ns - last[1] >= HEARTBEAT_NS:
            self._last_beat = (now_ns, wall_ns)
            self._transport.send(self._services.heartbeat())
        self._services.poll()
        self._flush()
        self._publish_status(now_ns)
        self._keep_log()

    def _keep_log(self) -> None:
        """Let the log be written; what goes wrong with it is told once and flown on without."""
        trouble = self._publisher.keep_log()
        if trouble is not None:
            log.error("%s", trouble)
            self._session.say(mav.SEVERITY_WARNING, "companion: log damaged, flying on")

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
            sources=lambda: sources_out(self._inbox, self._vehicle_ns),
        )

    def _groups(self) -> dict[str, dict[str, int]]:
        groups = {"obstacles": self._inbox.counts, "tracking": self._thinker.tracking_counts}
        groups |= {"mavlink": self._codec.counts, "texts": self._session.text_counts}
        return groups | {"autopilot": self._session.watch.counts, "timesync": self._time.counts}

    def _counts(self) -> dict[str, int]:
        """Everything counted, by kind."""
        groups = self._groups() | {"log": dict(self._publisher.log_counts)}
        return self._meter.counts(groups) | self._transport.all_counts()

    def _summary(self, recorder: Recorder | None) -> Summary:
        log_path = None if recorder is None else str(recorder.path)
        state = self._session.situation.state.value
        return self._meter.summary(self._counts(), state, log=log_path, log_hash=self._publisher.log_hash)

    # what the links hand in

    def _on_events(self, events: list[Event]) -> None:
        self._barrier.heard()
        for event in events:
            if isinstance(event, TimesyncRequest | TimesyncReply):
                self._time.handle(event, self._session.system)
            elif isinstance(event, ParamRequest):
                self._services.handle(event)
            elif isinstance(event, TrafficEvent):
                self._traffic.handle(event, self._session.system, self._time.unix_minus_vehicle_ns)
            elif (vehicle := self._session.handle(event, self._now_ns())) is not None:
                self._on_vehicle(vehicle)
        self._flush()

    def _on_vehicle(self, vehicle: VehicleState) -> None:
        """A new vehicle state; only the newest waits for the control task."""
        self._time.note(vehicle.stamp_ns)
        if self._is_stale(vehicle.stamp_ns):
            self._meter.skip()
            return
        if self._pending is not None:
            self._meter.skip()
        if 0 < vehicle.stamp_ns <= self._vehicle_ns:
            return  # reordered or repeated by the link
        self._pending = vehicle
        self._vehicle_ns = vehicle.stamp_ns
        self._arrived_ns, self._arrived_unix_ns = stopwatch_ns(), self._clock.unix_ns()
        self._barrier.pending()
        self._traffic.on_vehicle(vehicle)
        self._session.heard_vehicle(self._now_ns())
        self._wake.set()

    def _is_stale(self, stamp_ns: int) -> bool:
        """Whether a state lay about before it was read: what it says is not where the vehicle is."""
        age_ns = None if self._lockstep else self._time.age_ns(stamp_ns)
        return age_ns is not None and age_ns > self._config.vehicle.stale_s * NS_PER_S

    def _on_profile(self, config: Config) -> None:
        """`vehicle.profile = "auto"` is settled; nothing was sent before."""
        log.info("profile %s", config.vehicle.profile)
        self._config = config
        self._thinker.adopt(config)
        self._services.adopt(config.vehicle.profile)
        self._publisher.configured(config, self._vehicle_ns)
        self._meter.set_period(1.0 / config.rate_hz)

    def _on_restart(self, why: str) -> None:
        log.warning("%s: tracks, queues and clock offset start anew", why)
        self._pending = None
        self._vehicle_ns = 0
        self._thinker.reset()
        self._traffic.reset()
        self._session.rebooted()
        self._session.watch.clock_restarted(why, self._now_ns())

    def _retune(self, config: Config) -> None:
        """Other live parameters, between two ticks: all of them or, with ConfigError, none."""
        self._route.check(config.limits)
        self._thinker.retune(config)
        self._route.retune(config.limits)
        self._inbox.retune(config.obstacles.max_age_s)
        self._session.retune(config)
        self._doors.retune(config)
        self._publisher.configured(config, self._vehicle_ns)

    def _on_change(self) -> None:
        """A command or a marker came by Zenoh: answer the autopilot and look again."""
        self._flush()
        self._wake.set()
