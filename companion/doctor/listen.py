"""The doctor on real links: opens MAVLink and Zenoh as configured, listens, and returns what was seen."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Sequence

import zenoh

from companion.clock import Clock
from companion.config import Config
from companion.doctor.mavlink_probe import MavlinkProbe
from companion.doctor.observation import Link, Zenoh
from companion.doctor.sources import SourceLog
from companion.errors import ConfigError
from companion.link.mavlink import MavlinkCodec
from companion.link.signing_files import open_signing
from companion.link.transports import Transport, open_transport
from companion.link.zenoh import open_session
from companion.session import EXTENDED_SYS_STATE_HZ
from companion.types import NS_PER_S

log = logging.getLogger("companion")

POLL_S = 0.01
HEARTBEAT_HZ = 1.0
_MAX_STATES = 100_000


def wanted_streams(config: Config) -> dict[str, float]:
    """What the daemon needs from the autopilot, and how often."""
    streams = {"HEARTBEAT": HEARTBEAT_HZ, "EXTENDED_SYS_STATE": EXTENDED_SYS_STATE_HZ}
    if config.vehicle.source == "mavlink":
        rate_hz = float(config.rate_hz)
        streams |= {"LOCAL_POSITION_NED": rate_hz, "ATTITUDE_QUATERNION": rate_hz}
    return streams


async def listen(
    config: Config, clock: Clock, *, duration_s: float, fixes: Sequence[tuple[str, float]] = ()
) -> tuple[Link, Zenoh]:
    """Both sides at once, for ``duration_s`` after the autopilot was found.

    A link that cannot be opened is part of the answer.
    """
    signing = open_signing(config.mavlink.signing, clock.unix_ns, log.warning)
    codec = MavlinkCodec(system=config.mavlink.system_id or 1, signing=signing)
    probe = MavlinkProbe(
        codec,
        system_id=config.mavlink.system_id,
        streams=wanted_streams(config),
        duration_s=duration_s,
        fixes=fixes,
    )
    ears = _Ears(config, clock)
    async with contextlib.AsyncExitStack() as stack:
        zenoh_error = mavlink_error = None
        try:
            ears.open()
            stack.callback(ears.close)
        except ConfigError as error:
            zenoh_error = str(error)
        transport: Transport | None = None
        try:
            transport = await open_transport(
                config.mavlink.url,
                lambda data: probe.receive(data, clock.monotonic_ns(), clock.unix_ns()),
                clock=clock,
            )
            stack.push_async_callback(transport.close)
        except ConfigError as error:
            mavlink_error = str(error)
        stack.callback(codec.close)
        await _until_done(probe, codec, transport, clock, duration_s)
        bytes_in = 0 if transport is None else transport.counts["bytes_in"]
    link = Link(
        url=config.mavlink.url,
        autopilot=probe.result(),
        error=mavlink_error,
        bytes_in=bytes_in,
        systems=tuple(sorted(probe.systems)),
        traffic=dict(probe.traffic),
    )
    return link, ears.result(probe.unix_minus_vehicle_ns, zenoh_error)


async def _until_done(
    probe: MavlinkProbe, codec: MavlinkCodec, transport: Transport | None, clock: Clock, duration_s: float
) -> None:
    began_ns = clock.monotonic_ns()
    while True:
        now_ns = clock.monotonic_ns()
        if transport is not None:
            for data in probe.poll(now_ns):
                transport.send(codec.seal(data))
        over = now_ns - began_ns >= duration_s * NS_PER_S
        if over and (transport is None or probe.finished(now_ns)):
            return
        await clock.sleep(POLL_S)


class _Ears:
    """Subscriptions to obstacles and vehicle states. Callbacks run on Zenoh's thread: they note and return."""

    def __init__(self, config: Config, clock: Clock) -> None:
        self._config = config
        self._clock = clock
        self._log = SourceLog()
        self._states_ns: list[int] = []
        self._loop = asyncio.get_running_loop()
        self._session: zenoh.Session | None = None

    def open(self) -> None:
        session = self._session = open_session(self._config.zenoh)
        self._subscriptions = [
            session.declare_subscriber(f"{self._config.prefix}/obstacles/*", self._on_obstacles),
            session.declare_subscriber(f"{self._config.prefix}/vehicle/state", self._on_state),
        ]

    def close(self) -> None:
        if self._session is not None:
            self._session.close()  # type: ignore[no-untyped-call]

    def result(self, unix_minus_vehicle_ns: int | None, error: str | None) -> Zenoh:
        now_ns = self._clock.monotonic_ns()
        states = self._states_ns
        vehicle_hz = (len(states) - 1) * NS_PER_S / max(now_ns - states[0], 1) if states else 0.0
        sources = self._log.result(
            now_ns, unix_minus_vehicle_ns=unix_minus_vehicle_ns, max_age_s=self._config.obstacles.max_age_s
        )
        return Zenoh(self._config.prefix, sources, vehicle_hz, error)

    def _on_obstacles(self, sample: zenoh.Sample) -> None:
        now_ns, unix_ns = self._clock.monotonic_ns(), self._clock.unix_ns()
        source = str(sample.key_expr).rpartition("/")[2]
        payload, encoding = sample.payload.to_bytes(), str(sample.encoding)
        self._hand_over(lambda: self._log.push(source, payload, encoding, now_ns=now_ns, unix_ns=unix_ns))

    def _on_state(self, sample: zenoh.Sample) -> None:
        now_ns = self._clock.monotonic_ns()
        self._hand_over(lambda: self._states_ns.append(now_ns) if len(self._states_ns) < _MAX_STATES else None)

    def _hand_over(self, call: object) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(call)  # type: ignore[arg-type]
