"""What a tick tells the outside about its tracks."""

from __future__ import annotations

from tracking_scenes import frame, seen, vehicle

from companion.config import parse_config
from companion.link import wire
from companion.pilot import Pilot, PilotInput
from companion.report import tracks_out


def test_tracks_tell_their_status_and_sources() -> None:
    brain = Pilot(parse_config({}))
    frames = (
        frame(0.0, seen("a", [5.0, 0.0, 2.0]), seen(None, [0.0, 6.0, 2.0])),
        frame(0.0, seen("x", [-5.0, 0.0, 2.0]), source="radar"),
    )
    output = brain.step(PilotInput(vehicle(0.0, [0.0, 0.0, 2.0]), frames))
    out = wire.decode(wire.encode(tracks_out(output, brain.tracks())), wire.TracksOut)
    told = {track.id: (track.status, track.sources, len(track.predicted) > 0) for track in out.tracks}
    assert told == {
        "cam/a": ("confirmed", ["cam"], True),
        "cam/#1": ("tentative", ["cam"], False),
        "radar/x": ("confirmed", ["radar"], True),
    }
