"""A plan view in characters: two by four Braille dots a cell, so that a dot is about as wide as it is high.

North is up, east is right. ``@`` is the vehicle, ``X`` its target; circles are obstacles at their size, dots their
predicted ways, the nearest one's in another colour.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.text import Text

from companion.link import wire
from companion.monitor.essentials import Sight

# bit of a dot in the Braille block (U+2800), by row and column
_DOTS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
_SPANS_M = (2.0, 3.0, 5.0, 8.0, 12.0, 20.0, 30.0, 50.0, 80.0, 120.0)  # half of what is shown, the lesser side
_NEAREST_SHOWN = 5  # tracks that the picture makes room for

VEHICLE, TARGET, NEAREST, TRACK, PATH = "bold cyan", "bold green", "bold red", "yellow", "bright_black"


class Canvas:
    """Dots and characters on ``columns`` x ``rows`` cells around ``centre``, at ``metres`` a dot."""

    def __init__(self, columns: int, rows: int, centre: tuple[float, float], metres: float) -> None:
        self._columns, self._rows = columns, rows
        self._centre, self._metres = centre, metres
        self._bits = [[0] * columns for _ in range(rows)]
        self._styles = [[""] * columns for _ in range(rows)]
        self._marks: dict[tuple[int, int], str] = {}

    def dot(self, x: float, y: float, style: str) -> None:
        """A dot at a place [m]; what lies outside is left out."""
        if (at := self._at(x, y)) is not None:
            column, row = at
            self._bits[row // 4][column // 2] |= _DOTS[row % 4][column % 2]
            self._styles[row // 4][column // 2] = style

    def circle(self, x: float, y: float, radius: float, style: str) -> None:
        """A circle, of one dot where it is smaller than that."""
        steps = max(1, min(256, round(2.0 * math.pi * radius / self._metres)))
        for k in range(steps):
            angle = 2.0 * math.pi * k / steps
            self.dot(x + radius * math.cos(angle), y + radius * math.sin(angle), style)

    def mark(self, x: float, y: float, character: str, style: str) -> None:
        """A character over whatever is there."""
        if (at := self._at(x, y)) is not None:
            cell = at[1] // 4, at[0] // 2
            self._marks[cell] = character
            self._styles[cell[0]][cell[1]] = style

    def text(self) -> Text:
        """The picture, one line a row."""
        lines = []
        for row in range(self._rows):
            line = Text(no_wrap=True)
            for column in range(self._columns):
                bits = self._bits[row][column]
                shown = self._marks.get((row, column), chr(0x2800 + bits) if bits else " ")
                line.append(shown, self._styles[row][column])
            lines.append(line)
        return Text("\n").join(lines)

    def _at(self, x: float, y: float) -> tuple[int, int] | None:
        """The dot of a place, None outside."""
        right, up = (x - self._centre[0]) / self._metres, (y - self._centre[1]) / self._metres
        if not (math.isfinite(right) and math.isfinite(up)):
            return None
        column, row = self._columns + math.floor(right), 2 * self._rows - 1 - math.floor(up)
        return (column, row) if 0 <= column < 2 * self._columns and 0 <= row < 4 * self._rows else None


def plan(sight: Sight, columns: int, rows: int) -> Text:
    """The surroundings of a vehicle whose position is known, and the scale below; ``rows`` lines in all."""
    assert sight.vehicle is not None
    p = sight.vehicle.position
    target = None if sight.status is None else sight.status.target
    tracks = [] if sight.tracks is None else sorted(sight.tracks.tracks, key=lambda t: math.dist(t.position, p))
    span_m = _span_m(p, target, tracks[:_NEAREST_SHOWN])
    dots = min(2 * columns, 4 * (rows - 1))
    canvas = Canvas(columns, rows - 1, (p[0], p[1]), 2.0 * span_m / dots)
    for index, track in reversed(list(enumerate(tracks))):  # the nearest last, on top of the others
        for x, y, _ in track.predicted:
            canvas.dot(x, y, PATH)
        canvas.circle(track.position[0], track.position[1], track.radius, TRACK if index else NEAREST)
    if target is not None:
        canvas.mark(target[0], target[1], "X", TARGET)
    canvas.mark(p[0], p[1], "@", VEHICLE)
    picture = canvas.text()
    bar_m = span_m / 2.0
    bar = "─" * max(1, round(bar_m * dots / (2.0 * span_m) / 2.0))
    return picture.append(f"\n├{bar}┤ {bar_m:g} m   @ vehicle  X target", "bright_black")


def _span_m(p: wire.Vec, target: wire.Vec | None, tracks: Sequence[wire.TrackOut]) -> float:
    """Half of what is shown: enough for the target and the tracks, or the most there is."""
    places = [track.position for track in tracks] + ([] if target is None else [target])
    reach_m = max((max(abs(q[0] - p[0]), abs(q[1] - p[1])) for q in places), default=0.0)
    return next((span for span in _SPANS_M if span >= 1.1 * reach_m), _SPANS_M[-1])
