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


_ENCODER = msgspec.json.Encoder()
_RECORDS = msgspec.json.Decoder(Record)
LEAST_STD_M = 0.001  # a sensor without noise still states a deviation above 0


def session_config(listen: Sequence[str], connect: Sequence[str] = ()) -> zenoh.Config:
    """A peer that finds nobody by itself: no multicast, no gossip."""
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
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


class Bridge:
    """The simulator's Zenoh session.

    Args:
        endpoint: where to listen, e.g. ``tcp/127.0.0.1:7447``.
        wake: written to (one byte) whenever a record or a change of presence has come in.
        reliable: lockstep's quality of service.
    Raises:
        ScenarioError: the endpoint cannot be listened on.
    """

    def __init__(
        self, endpoint: str, prefix: str, sources: Sequence[str], *, reliable: bool, wake: socket.socket
    ) -> None:
        self.record_key = f"{prefix}/companion/setpoint"
        self.alive_key = f"{prefix}/companion/alive"
        self.companion_alive = False
        self.malformed = 0
        self._records: deque[bytes] = deque()
        self._wake = wake
        try:
            self._session = zenoh.open(session_config([endpoint]))
        except zenoh.ZError as error:
            raise ScenarioError(f"--zenoh-listen {endpoint}: cannot listen there ({_first_words(error)})") from None
        congestion = zenoh.CongestionControl.BLOCK if reliable else zenoh.CongestionControl.DROP
        self._frames, self._markers = (
            {
                source: self._session.declare_publisher(
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
            self._session.declare_subscriber(self.record_key, self._on_record)
            self._session.liveliness().declare_subscriber(self.alive_key, self._on_presence, history=True)

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

    def close(self) -> None:
        self._session.close()  # type: ignore[no-untyped-call]

    def _on_record(self, sample: zenoh.Sample) -> None:
        self._records.append(bytes(sample.payload))
        self._poke()

    def _on_presence(self, sample: zenoh.Sample) -> None:
        self.companion_alive = sample.kind == zenoh.SampleKind.PUT
        self._poke()

    def _poke(self) -> None:
        try:
            self._wake.send(b"\0")
        except OSError:
            return  # full (the loop is awake anyway) or closed (it is going home)


def _first_words(error: Exception) -> str:
    """Zenoh's errors carry their source lines; the cause comes first."""
    text = str(error)
    return "address in use" if "Address already in use" in text else text.split(" at /")[0]
