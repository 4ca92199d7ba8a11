"""The sockets of a flight: for each vehicle two MAVLink links and its Zenoh keys, one Zenoh session for all."""

from __future__ import annotations

import contextlib
import select
import socket
from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass, field

import numpy as np

from sim_bridge.craft import Craft
from sim_bridge.errors import ScenarioError
from sim_bridge.impairments import Channel, damage_bytes
from sim_bridge.links import Address, Router
from sim_bridge.placement import Resolved
from sim_bridge.scenario import SensorSpec, Vehicle
from sim_bridge.sensors import Frame
from sim_bridge.zenoh_io import Bridge, Session, encode_frame


@dataclass(frozen=True, slots=True)
class Outgoing:
    """One obstacle frame on its way: as it was measured, and its bytes."""

    stamp_ns: int
    frame: Frame
    payload: bytes


@dataclass(slots=True)
class Feed:
    """One source's frames of one vehicle, and the faults between the sensor and the wire."""

    spec: SensorSpec
    offset_ns: int = 0  # by which the source's clock has jumped
    channel: Channel[Outgoing] | None = None

    @property
    def source(self) -> str:
        return self.spec.source

    def encode(self, frame: Frame, clock_offset_ns: int = 0) -> Outgoing:
        """A frame under the stamp of the clocks that jumped."""
        stamp_ns = max(0, frame[0] + self.offset_ns + clock_offset_ns)
        return Outgoing(stamp_ns, frame, encode_frame((stamp_ns, frame[1]), self.spec.sigma_m))

    def due(self, craft: Craft, t_ns: int, clock_offset_ns: int = 0) -> list[bytes]:
        """Payloads of what ``craft`` has measured and what leaves by ``t_ns``, after the faults."""
        frames = [self.encode(frame, clock_offset_ns) for frame in craft.frames(self.source, t_ns)]
        if self.channel is None:
            return [frame.payload for frame in frames]
        late = self.channel.release()
        return [passage.item.payload for passage in (*late, *self.channel.pass_on(frames))]


def damage_frame(frame: Outgoing, rng: np.random.Generator) -> Outgoing:
    """A frame with one byte changed."""
    return Outgoing(frame.stamp_ns, frame.frame, damage_bytes(frame.payload, rng))


@dataclass(slots=True)
class CraftWires:
    """One vehicle's links, its keys where there is a Zenoh session, and its sensors' feeds."""

    vehicle: Vehicle
    router: Router
    bridge: Bridge | None
    feeds: tuple[Feed, ...] = field(default=())


class Wires:
    """Every vehicle's links, the Zenoh session if there is one, and the wake-up; opened together, closed together.

    Args:
        onboard_port, ground_port: of the first vehicle; the n-th has the n-th after it, unless the scenario says.
        endpoint: where Zenoh listens, None: no Zenoh.
        prefix: of the first vehicle's keys, None: ``uav/`` and its name.
        onboard_bind, ground_bind: addresses of the links' own sockets, the n-th vehicle's port as above.
        connect: ``endpoint`` is a Zenoh router's, of which the session is a client.
    Raises:
        ScenarioError: two links with one port, a port above 65535, an address or endpoint that cannot be listened on,
            or a router that does not answer.
    """

    def __init__(
        self,
        resolved: Resolved,
        *,
        onboard_port: int,
        ground_port: int,
        endpoint: str | None,
        lockstep: bool,
        prefix: str | None = None,
        onboard_bind: Address | None = None,
        ground_bind: Address | None = None,
        connect: bool = False,
    ) -> None:
        scenario = resolved.scenario
        ports = ports_of(resolved, onboard_port, ground_port)
        self._stack = ExitStack()
        with self._stack:  # closed on any error below
            self._wake_in, self._wake_out = (self._stack.enter_context(s) for s in socket.socketpair())
            self._wake_in.setblocking(False)
            self._wake_out.setblocking(False)
            session = None if endpoint is None else Session(endpoint, self._wake_out, connect=connect)
            if session is not None:
                self._stack.callback(session.close)
            crafts = []
            for index, (vehicle, (onboard, ground)) in enumerate(zip(scenario.fleet, ports, strict=True)):
                binds = _nth(onboard_bind, index), _nth(ground_bind, index)
                router = _router(onboard, ground, binds, system=vehicle.system_id)
                self._stack.callback(router.close)
                feeds = tuple(Feed(spec) for _, spec in scenario.carried(vehicle.name))
                own = prefix if prefix is not None and index == 0 else f"uav/{vehicle.name}"
                sources = [feed.source for feed in feeds]
                bridge = None if session is None else Bridge(session, own, sources, reliable=lockstep)
                crafts.append(CraftWires(vehicle, router, bridge, feeds))
            self.crafts = tuple(crafts)
            self._stack = self._stack.pop_all()
        links = [link.socket for craft in self.crafts for link in craft.router.links]
        self._sockets = [self._wake_in, *links]

    def wait(self, timeout_s: float) -> bool:
        """Sleep until something arrives or the time is up; whether something did."""
        readable, _, _ = select.select(self._sockets, [], [], max(0.0, timeout_s))
        if self._wake_in in readable:
            with contextlib.suppress(BlockingIOError):
                self._wake_in.recv(4096)
        return bool(readable)

    def poke(self) -> None:
        """Wake the loop; may be called from a signal handler or another thread."""
        with contextlib.suppress(OSError):
            self._wake_out.send(b"\0")

    def close(self) -> None:
        self._stack.close()


def _nth(address: Address | None, index: int) -> Address | None:
    """The address of the vehicle ``index``: as many ports on."""
    return None if address is None else (address[0], address[1] + index)


def _router(onboard: int, ground: int, binds: tuple[Address | None, Address | None], *, system: int) -> Router:
    try:
        return Router(onboard, ground, onboard_bind=binds[0], ground_bind=binds[1], system=system)
    except (OSError, OverflowError) as error:  # Overflow: a port above 65535
        wanted = ", ".join(f"{host}:{port}" for host, port in filter(None, binds))
        raise ScenarioError(
            f"--onboard-bind, --gcs-bind: expected free addresses of this host, got {wanted} ({error})"
        ) from None


def ports_of(resolved: Resolved, onboard_port: int, ground_port: int) -> list[tuple[int, int]]:
    """The ports (onboard, ground) of each vehicle.

    Raises:
        ScenarioError: one of them is used twice or is none.
    """
    ports = [
        (
            onboard_port + index if vehicle.onboard_port is None else vehicle.onboard_port,
            ground_port + index if vehicle.gcs_port is None else vehicle.gcs_port,
        )
        for index, vehicle in enumerate(resolved.scenario.fleet)
    ]
    for port, uses in Counter(port for pair in ports for port in pair).items():
        if uses > 1:
            raise ScenarioError(f"--gcs-port: expected a port of its own for every link, got {port} twice")
        if port > 65535:
            raise ScenarioError(f"--onboard-port, --gcs-port: expected ports up to 65535 for all, got {port}")
    return ports
