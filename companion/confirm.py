"""Does the autopilot follow what it is sent? POSITION_TARGET_LOCAL_NED compared with the setpoints.

It is the only confirmation of a setpoint: none is acknowledged, and ArduPilot stops silently on a mask it dislikes.
What of the echo can be compared is the profile's (`profiles`). Nothing here ends a flight.
"""

from __future__ import annotations

from collections import Counter, deque

import numpy as np

from companion.link import mav
from companion.link.events import SetpointEcho
from companion.profiles import Profile
from companion.types import NS_PER_S, Vec3

ECHO_HZ = 4.0
SETTLE_NS = NS_PER_S  # after the first setpoint, and the longest silence
WINDOW_NS = NS_PER_S  # an echo may repeat any setpoint of this past
TOLERANCE_M_S2 = 0.05  # each axis: float32, and centimetres inside the autopilot
FOREIGN_ECHOES = 3  # in a row, none of whose accelerations is ours


class Confirmation:
    """One flight's setpoints and echoes.

    Args:
        type_mask: that of the setpoints sent.

    ``counts``: echoes, mask_mismatch, foreign_acceleration.
    """

    def __init__(self, profile: Profile, type_mask: int) -> None:
        self._bits = profile.echo_bits
        self._mask = type_mask
        self._compares_acceleration = profile.echo_exact or bool(type_mask & mav.IGNORE_VELOCITY)
        self.counts: Counter[str] = Counter()
        self.reset()

    def reset(self) -> None:
        """No setpoint is obeyed now."""
        self._since_ns: int | None = None  # first setpoint
        self._sent: deque[tuple[int, Vec3]] = deque()
        self._echo_ns: int | None = None
        self._wrong_mask: int | None = None
        self._foreign = 0

    def sent(self, a_enu: Vec3, now_ns: int) -> None:
        """A setpoint left, net acceleration [m/s^2], while the autopilot is in its external mode."""
        if self._sent and now_ns - self._sent[-1][0] > WINDOW_NS:
            self.reset()
        if self._since_ns is None:
            self._since_ns = now_ns
        self._sent.append((now_ns, a_enu))
        while now_ns - self._sent[0][0] > WINDOW_NS:
            self._sent.popleft()

    def echo(self, echo: SetpointEcho, now_ns: int) -> None:
        """The autopilot tells what it follows; believed once it has had a second to take up what it is sent."""
        self.counts["echoes"] += 1
        self._echo_ns = now_ns
        if self._since_ns is None or now_ns - self._since_ns < SETTLE_NS:
            return
        differs = bool((echo.type_mask ^ self._mask) & self._bits)
        self.counts["mask_mismatch"] += differs
        self._wrong_mask = echo.type_mask if differs else None
        if differs or not self._compares_acceleration or echo.type_mask & mav.IGNORE_ACCELERATION:
            return
        foreign = not self._is_ours(echo.a_enu)
        self.counts["foreign_acceleration"] += foreign
        self._foreign = self._foreign + 1 if foreign else 0

    def complaint(self, now_ns: int) -> str | None:
        """What the operator should know, or None."""
        if self._since_ns is None or now_ns - self._since_ns <= SETTLE_NS:
            return None
        if self._echo_ns is None or now_ns - self._echo_ns > SETTLE_NS:
            return "autopilot confirms no setpoint: no POSITION_TARGET_LOCAL_NED"
        if self._wrong_mask is not None:
            return f"autopilot does not follow: type_mask 0x{self._wrong_mask:04X}, sent 0x{self._mask:04X}"
        if self._foreign >= FOREIGN_ECHOES:
            return "autopilot follows an acceleration that is not ours: a second sender?"
        return None

    def _is_ours(self, a_enu: Vec3) -> bool:
        sent = np.array([a for _, a in self._sent])
        return bool((np.abs(sent - a_enu).max(axis=-1) <= TOLERANCE_M_S2).any())
