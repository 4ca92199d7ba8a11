"""Bytes to MAVLink messages: finds packets in a stream, checks them, recovers from anything.

pymavlink's own stream parser drops as many bytes as a damaged header claims, good packets included, and may
wait for 280 bytes that never come. Here a failed packet costs one byte and the search goes on behind it.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.link.signing import Signing, is_signed

_V1, _V2 = 0xFE, 0xFD
_SIGNED = 0x01
_MAGICS = (_V1, _V2)


class Framer:
    """Splits one byte stream. ``counts``: messages, unknown, bad_packets, garbage_bytes.

    With ``signing`` each packet is judged too; what is refused is counted by why (unsigned, bad_signature, future,
    replayed) and dropped whole. ``message.get_signed()`` then tells a proven message from one on the unsigned
    allowlist (counted as allowed_unsigned). ``keep_unknown`` hands on messages outside the dialect
    (`MAVLink_unknown`) where they lie exactly between packets, for routers; with signing only what is proven.
    """

    def __init__(
        self, *, signing: Signing | None = None, counts: Counter[str] | None = None, keep_unknown: bool = False
    ) -> None:
        self._pending = b""
        self._decoder = dialect.MAVLink(None)
        self._signing = signing
        self._keep_unknown = keep_unknown
        self.counts: Counter[str] = Counter() if counts is None else counts

    def push(self, data: bytes) -> list[Any]:
        """pymavlink messages that ``data`` completes. Never raises, whatever the bytes."""
        data = bytes(data)
        pending, self._pending = self._pending, b""
        if pending and data and data[0] in _MAGICS and self._decode(data, 0)[0] is not None:
            # A damaged header must not hold back what follows it: a chunk that begins with a whole good packet
            # does not continue the pending one.
            return self._scan(pending, final=True) + self._scan(data, final=False)
        return self._scan(pending + data, final=False)

    def _scan(self, data: bytes, *, final: bool) -> list[Any]:
        messages: list[Any] = []
        at = clean = 0  # up to ``clean`` everything was packets
        excused = 0  # up to here lies an unknown message: searched, since its checksum cannot be known, not counted
        while at < len(data):
            if data[at] not in _MAGICS:
                start, at = max(at, excused), _next_magic(data, at)
                self.counts["garbage_bytes"] += max(0, at - start)
                continue
            message, length = self._decode(data, at)
            if length == 0 and not final and at >= excused:
                self._pending = data[at:]
                break
            if message is None:
                self.counts["bad_packets"] += at >= excused
                at += 1
            elif isinstance(message, dialect.MAVLink_unknown):
                self.counts["unknown"] += at >= excused
                if at == clean and self._keep_unknown and self._fits(data, at, length):
                    messages.append(message)
                    clean = at + length
                excused = max(excused, at + length)
                at += 1
            else:
                if self._accepts(message):
                    self.counts["messages"] += 1
                    messages.append(message)
                at += length
                clean = at
        return messages

    def _accepts(self, message: Any) -> bool:
        if self._signing is None:
            return True
        header = message._header
        packet = message.get_msgbuf()
        why = self._signing.refusal(packet, header.srcSystem, header.srcComponent, header.msgId)
        if why is not None:
            self.counts[why] += 1
            return False
        message._signed = is_signed(packet)
        if not message._signed:
            self.counts["allowed_unsigned"] += 1
        return True

    def _fits(self, data: bytes, at: int, length: int) -> bool:
        """Whether an unknown message, whose checksum cannot be known, is one: proven, or followed by a packet."""
        if self._signing is None:
            return at + length == len(data) or data[at + length] in _MAGICS
        packet = data[at : at + length]
        return self._signing.refusal(packet, packet[5], packet[6], -1) is None

    def _decode(self, data: bytes, at: int) -> tuple[Any | None, int]:
        """The message at ``at``, None if it fails, and its length, 0 while more bytes are needed."""
        length = _packet_length(data, at)
        if length == 0 or at + length > len(data):
            return None, 0
        packet = bytearray(data[at : at + length])
        if packet[0] == _V2 and packet[2] & ~_SIGNED:
            return None, length  # an incompatible feature: the specification says drop
        try:
            return self._decoder.decode(packet), length
        except dialect.MAVError:
            return None, length


def _packet_length(data: bytes, at: int) -> int:
    """Length of the packet whose header starts at ``at``, 0 while the header is incomplete."""
    if at + 3 > len(data):
        return 0
    if data[at] == _V1:
        return data[at + 1] + 8
    return data[at + 1] + 12 + (13 if data[at + 2] & _SIGNED else 0)


def _next_magic(data: bytes, at: int) -> int:
    found = [i for i in (data.find(_V1, at), data.find(_V2, at)) if i >= 0]
    return min(found, default=len(data))
