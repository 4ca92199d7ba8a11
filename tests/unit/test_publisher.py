"""The status says which tracks break their assumed agility."""

from __future__ import annotations

import numpy as np
from tracking_scenes import frame, seen, vehicle

from companion.config import Config
from companion.link import wire
from companion.link.mavlink import MavlinkCodec
from companion.metrics import TickMeter
from companion.pilot import Pilot, PilotInput
from companion.publisher import Publisher
from companion.report import setpoint_record, tracks_out
from companion.session import VehicleSession
from companion.state import State


class Link:
    """Stands for Zenoh: keeps what is put."""

    def __init__(self) -> None:
        self.statuses: list[wire.Status] = []

    def wanted(self, key: str) -> bool:
        return False

    def put_encoded(self, key: str, payload: bytes) -> None:
        pass

    def put(self, key: str, payload: wire.Status) -> None:
        self.statuses.append(wire.decode(wire.encode(payload), wire.Status))


def test_the_status_lists_the_jinking_obstacle_and_not_the_straight_one() -> None:
    config, link, brain = Config(), Link(), Pilot(Config())
    publisher = Publisher(link, None)
    session = VehicleSession(config, MavlinkCodec(system=1), lambda p_enu: None)
    rng = np.random.default_rng(4)
    straight, jinker, v = np.array([-9.0, 8.0, 3.0]), np.array([-9.0, -8.0, 3.0]), np.array([1.5, 0.0, 0.0])
    for k in range(200):
        if k % 40 == 39:
            v = v * (1.0, -1.0, 1.0) + (0.0, 2.0 if v[1] == 0.0 else 0.0, 0.0)
        straight, jinker = straight + np.array([0.05, 0.0, 0.0]), jinker + 0.05 * v
        found = [seen(name, p + rng.normal(scale=0.03, size=3)) for name, p in (("s", straight), ("j", jinker))]
        output = brain.step(PilotInput(vehicle(0.05 * k, [0.0, 0.0, 2.0]), (frame(0.05 * k, *found, sequence=k),)))
        record = setpoint_record(output.stamp_ns, State.READY, output, sent=False, messages=0, timings_ms={})
        publisher.tick(record, State.READY, vehicle(0.05 * k, [0.0, 0.0, 2.0]), (), output, brain.tracks)
    publisher.status(0, 0, session, target_enu=None, counts=dict, meter=TickMeter(0.05))
    assert link.statuses[-1].agile == ["cam/j"]
    told = {track.id: (track.surprise, track.growth) for track in tracks_out(output, brain.tracks()).tracks}
    assert told["cam/j"][0] > told["cam/s"][0]
    assert told["cam/j"][1] >= 2.0 > told["cam/s"][1] >= 1.0
