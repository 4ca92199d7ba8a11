"""Zenoh as the simulator uses it: obstacle frames and sync markers out, the companion's records and presence in.

Frames carry full state, so in real time they may drop (the default); in lockstep every one counts: RELIABLE and
BLOCK. Callbacks run on Zenoh's threads: they copy, append to a deque, wake the main loop and return.
"""

from __future__ import annotations

import json
import socket
from collections import deque
from collections.abc import Sequence

import msgspec
import zenoh

from sim_bridge.errors import ScenarioError
from sim_bridge.sensors import Frame


class ObstacleOut(msgspec.Struct, frozen=True):
    id: str | None  # None: anonymous
    position: tuple[float, float, float]
    radius: float
    position_std: float


class FrameOut(msgspec.Struct, frozen=True):
    """`{prefix}/obstacles/{source}`."""

    stamp_ns: int
    obstacles: list[ObstacleOut]
    clock: str = "vehicle"
    frame: str = "local_enu"
    kind: str = "detection"


class MarkerOut(msgspec.Struct, frozen=True):
    """`{prefix}/sync/{source}`: all frames through ``through_ns`` are sent, ``frames`` of them new."""

    through_ns: int
    frames: int


class Record(msgspec.Struct, frozen=True):
    """What lockstep needs of `{prefix}/companion/setpoint`."""

    stamp_ns: int
    sent: bool
    messages: int = 0
    state: str = ""
    verdict: str = ""
    timings_ms: dict[str, float] = {}


_ENCODER = msgspec.json.Encoder()
_RECORDS = msgspec.json.Decoder(Record)
LEAST_STD_M = 0.001  # a sensor without noise still states a deviation above 0


def session_config(listen: Sequence[str], connect: Sequence[str] = (), mode: str = "peer") -> zenoh.Config:
    """A peer, or a router's client, that finds nobody by itself: no multicast, no gossip."""
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps(mode))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/gossip/enabled", "false")
    config.insert_json5("listen/endpoints", json.dumps(list(listen)))
    config.insert_json5("connect/endpoints", json.dumps(list(connect)))
    return config


def encode_frame(frame: Frame, sigma_m: float) -> bytes:
    """JSON of one sensor frame; the stated deviation is that of the sensor."""
    stamp_ns, seen = frame
    std_m = max(sigma_m, LEAST_STD_M)
    return _ENCODER.encode(FrameOut(stamp_ns, [ObstacleOut(name, p, radius, std_m) for name, p, radius in seen]))


class Session:
    """The simulator's Zenoh session, for all vehicles.

    Args:
        endpoint: where to listen, e.g. ``tcp/127.0.0.1:7447``.
        wake: written to (one byte) whenever something has come in.
        connect: be a client of the router at ``endpoint`` instead.
    Raises:
        ScenarioError: the endpoint cannot be listened on, or no router answers there.
    """

    def __init__(self, endpoint: str, wake: socket.socket, *, connect: bool = False) -> None:
        self._wake = wake
        try:
            config = session_config([], [endpoint], mode="client") if connect else session_config([endpoint])
            self.zenoh = zenoh.open(config)
        except zenoh.ZError as error:
            what = "--zenoh-connect" if connect else "--zenoh-listen"
            why = "no Zenoh router answers" if connect else "cannot listen"
            raise ScenarioError(f"{what} {endpoint}: {why} there ({_first_words(error)})") from None

    def poke(self) -> None:
        """Wake the main loop, from any thread."""
        try:
            self._wake.send(b"\0")
        except OSError:
            return  # full (the loop is awake anyway) or closed (it is going home)

    def close(self) -> None:
        self.zenoh.close()  # type: ignore[no-untyped-call]


class Bridge:
    """One vehicle's keys.

    Args:
        prefix: of the keys, e.g. ``uav/uav1``.
        reliable: lockstep's quality of service; only then are records and presence listened to, but see `listen`.
    """

    def __init__(self, session: Session, prefix: str, sources: Sequence[str], *, reliable: bool) -> None:
        self.record_key = f"{prefix}/companion/setpoint"
        self.alive_key = f"{prefix}/companion/alive"
        self.companion_alive = False
        self.malformed = 0
        self._records: deque[bytes] = deque()
        self._session = session
        self._listens = False
        congestion = zenoh.CongestionControl.BLOCK if reliable else zenoh.CongestionControl.DROP
        self._frames, self._markers = (
            {
                source: session.zenoh.declare_publisher(
                    f"{prefix}/{kind}/{source}",
                    encoding="application/json",
                    congestion_control=congestion,
                    reliability=zenoh.Reliability.RELIABLE,
                )
                for source in sources
            }
            for kind in ("obstacles", "sync")
        )
        if reliable:  # in real time nobody waits for the companion
            self.listen()

    def listen(self) -> None:
        """Listen to the companion's records and presence."""
        if not self._listens:
            self._listens = True
            self._session.zenoh.declare_subscriber(self.record_key, self._on_record)
            self._session.zenoh.liveliness().declare_subscriber(self.alive_key, self._on_presence, history=True)

    def publish_frame(self, source: str, payload: bytes) -> None:
        self._frames[source].put(payload)

    def publish_marker(self, source: str, through_ns: int, frames: int) -> None:
        self._markers[source].put(_ENCODER.encode(MarkerOut(through_ns, frames)))

    def unmatched(self) -> list[str]:
        """Keys of lockstep publishers that nobody subscribes to yet."""
        publishers = (*self._frames.values(), *self._markers.values())
        # zenoh's stub says bool where the library returns a MatchingStatus
        return [str(p.key_expr) for p in publishers if not p.matching_status.matching]  # type: ignore[attr-defined]

    def records(self) -> list[Record]:
        """Records that have arrived since the last call; what cannot be read is counted."""
        arrived = []
        while self._records:
            try:
                arrived.append(_RECORDS.decode(self._records.popleft()))
            except (msgspec.DecodeError, UnicodeDecodeError):
                self.malformed += 1
        return arrived

    def _on_record(self, sample: zenoh.Sample) -> None:
        self._records.append(bytes(sample.payload))
        self._session.poke()

    def _on_presence(self, sample: zenoh.Sample) -> None:
        self.companion_alive = sample.kind == zenoh.SampleKind.PUT
        self._session.poke()


def _first_words(error: Exception) -> str:
    """Zenoh's errors carry their source lines; the cause comes first."""
    text = str(error)
    return "address in use" if "Address already in use" in text else text.split(" at /")[0]
