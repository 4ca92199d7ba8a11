"""MAVLink 2 packet signing without input or output: what leaves is stamped, what arrives is judged.

    signature = SHA-256(key + header + payload + CRC + link id + timestamp)[:6]

with the header's first byte (0xFD) included, the timestamp in 10 us since 2015-01-01 UTC, 48 bits, little endian.
A receiver takes a packet if the signature is right and its timestamp is greater than the last one of that stream
(system, component, link id). Here nothing is remembered of a packet before its signature is known to be right:
pymavlink 2.4.50 stores the timestamp first, so that one forged packet locks the genuine sender out.
Source: MAVLink guide, "Message Signing".
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Callable, Collection
from typing import Annotated

from msgspec import Meta, Struct

EPOCH_UNIX_NS = 1_420_070_400 * 1_000_000_000  # 2015-01-01T00:00:00 UTC
TICK_NS = 10_000
KEY_BYTES = 32
SIGNATURE_BLOCK = 13  # link id, timestamp, signature
FLAG_SIGNED = 0x01  # of the incompatibility flags, the third byte

_TICKS_PER_S = 1_000_000_000 // TICK_NS
MAX_AHEAD = 60 * _TICKS_PER_S  # of the clock: further is no honest sender's clock
MAX_BEHIND = 60 * _TICKS_PER_S  # of the clock, where a stream is new: older is a recording
MAX_PERSISTED_AHEAD = 24 * 3600 * _TICKS_PER_S  # a clock may have fallen behind this much while the power was off
RESERVE = 10 * _TICKS_PER_S  # written ahead of use, so that a crash repeats no timestamp
_LAST = 2**48 - 1
_MAX_STREAMS = 256

Byte = Annotated[int, Meta(ge=0, le=255)]
Timestamp = Annotated[int, Meta(ge=0, le=_LAST)]
Stream = tuple[int, int, int]  # system, component, link id


class SigningState(Struct, frozen=True, forbid_unknown_fields=True):
    """What outlives a restart: the last timestamp that may have been sent, and the last one heard of each stream."""

    transmit: Timestamp
    streams: tuple[tuple[Byte, Byte, Byte, Timestamp], ...] = ()  # system, component, link id, timestamp


def timestamp_at(unix_ns: int) -> int:
    """The signing timestamp of a moment, 0 before 2015.

    >>> timestamp_at(1_420_070_400_000_020_000)
    2
    """
    return min(max(0, (unix_ns - EPOCH_UNIX_NS) // TICK_NS), _LAST)


def signature(key: bytes, signed_part: bytes | bytearray | memoryview) -> bytes:
    """The six bytes at the end of a packet; ``signed_part`` is everything before them."""
    digest = hashlib.sha256(key)
    digest.update(signed_part)
    return digest.digest()[:6]


class Signing:
    """One key's sender and receiver state, shared by every link: a packet heard on one cannot be replayed on another.

    Args:
        key: 32 bytes.
        unix_ns: the clock, Unix time [ns].
        link_id: of our first link; the others count up from it.
        allow_unsigned: message ids that are taken without a signature; they are not to be trusted.
        state: from an earlier run. Its transmit timestamp counts if it is at most a day ahead of the clock.
        persist: called with the state to keep, before a timestamp beyond the last kept one is used: every 10 s.
        on_report: called with a line for the log.
    """

    def __init__(
        self,
        key: bytes,
        unix_ns: Callable[[], int],
        *,
        link_id: int = 0,
        allow_unsigned: Collection[int] = (),
        state: SigningState | None = None,
        persist: Callable[[SigningState], None] | None = None,
        on_report: Callable[[str], None] | None = None,
    ) -> None:
        if len(key) != KEY_BYTES:
            raise ValueError(f"key: expected {KEY_BYTES} bytes, got {len(key)}")
        self._key = key
        self._link_id = link_id
        self._unix_ns = unix_ns
        self._allow_unsigned = frozenset(allow_unsigned)
        self._persist = persist
        self._streams: dict[Stream, int] = {}
        self._transmit = self._kept = self._floor = 0
        if state is not None:
            self._resume(state, on_report)

    def seal(self, packet: bytes, link: int = 0) -> bytes:
        """The packet with its signature block filled in, to be sent on ``link`` before any other packet is sealed.

        What is sealed early and sent late would be a replay to its receiver.
        """
        link_id = (self._link_id + link) & 0xFF
        body = packet[:-SIGNATURE_BLOCK] + bytes([link_id]) + self.next_timestamp().to_bytes(6, "little")
        return body + signature(self._key, body)

    def next_timestamp(self) -> int:
        """The timestamp of the next packet: the clock's, but greater than every earlier one."""
        self._transmit = min(max(timestamp_at(self._unix_ns()), self._transmit + 1), _LAST)
        if self._transmit > self._kept:
            self._kept = self._transmit + RESERVE
            self._keep(self._kept)
        return self._transmit

    def close(self) -> None:
        """Keep the exact state: the next run need not skip the reserve."""
        self._keep(self._transmit)

    def refusal(self, packet: bytes | bytearray, system: int, component: int, message_id: int) -> str | None:
        """Judge a whole packet whose checksum is right: None to take it, or the name under which it is counted.

        ``unsigned``, ``bad_signature``, ``future`` (more than 60 s ahead of the clock) or ``replayed`` (not after
        the last of its stream; of a stream not heard before, more than 60 s behind the clock).
        """
        if not is_signed(packet):
            return None if message_id in self._allow_unsigned else "unsigned"
        view = memoryview(packet)
        if not hmac.compare_digest(signature(self._key, view[:-6]), bytes(view[-6:])):
            return "bad_signature"
        link_id = packet[-SIGNATURE_BLOCK]
        timestamp = int.from_bytes(view[-12:-6], "little")
        now = timestamp_at(self._unix_ns())
        latest = max(now, self._floor) + MAX_AHEAD
        if timestamp > latest:
            return "future"
        stream = (system, component, link_id)
        last = self._streams.get(stream)
        if last is None or last > latest:  # the latter was taken while the clock was wrong, and would lock it out
            last = now - MAX_BEHIND
        if timestamp <= last:
            return "replayed"
        self._remember(stream, timestamp)
        self._transmit = max(self._transmit, timestamp)  # as the guide asks: who hears us may go by that clock
        return None

    def _remember(self, stream: Stream, timestamp: int) -> None:
        streams = self._streams
        streams[stream] = timestamp
        if len(streams) > _MAX_STREAMS:
            del streams[min(streams, key=streams.__getitem__)]

    def _keep(self, transmit: int) -> None:
        if self._persist is not None:
            self._persist(SigningState(transmit, tuple((*stream, last) for stream, last in self._streams.items())))

    def _resume(self, state: SigningState, on_report: Callable[[str], None] | None) -> None:
        now = timestamp_at(self._unix_ns())
        ahead = state.transmit - now
        if ahead <= MAX_PERSISTED_AHEAD:
            self._transmit = self._floor = state.transmit
        for system, component, link_id, last in state.streams[:_MAX_STREAMS]:
            self._streams[system, component, link_id] = last
        if ahead > MAX_AHEAD and on_report is not None:
            used = "is used" if self._floor else "is not used, more than a day"
            on_report(
                f"signing: the kept timestamp {used}: it lies {ahead / _TICKS_PER_S:.0f} s ahead of the clock; "
                "expected a clock that is set, or others may refuse what we sign"
            )


def is_signed(packet: bytes | bytearray) -> bool:
    """Whether a whole packet carries a signature block."""
    return packet[0] == 0xFD and bool(packet[2] & FLAG_SIGNED)
