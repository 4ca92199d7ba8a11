"""What an unauthenticated aircraft may do to the tracks: add, and nothing else; and one aircraft stays one."""

from __future__ import annotations

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect
from traffic_scenes import LAT, LON, OURS, S, Sky, adsb, alt_mm, lat_e7, lon_e7, position_int, utm, vehicle

from companion.config import parse_config
from companion.tracking.tracker import Tracker
from companion.types import Detection, DetectionFrame, DetectionKind, frozen

STEP_S = 0.05
OWN = (0.0, 0.0, 20.0)


def camera(t_s: float, *named: tuple[str, np.ndarray]) -> DetectionFrame:
    found = tuple(Detection(name, frozen(p), 0.3, 0.1) for name, p in named)
    return DetectionFrame(round(t_s * S), "camera", round(t_s / STEP_S), DetectionKind.DETECTION, found)


def test_adsb_neither_moves_nor_ends_nor_displaces_the_track_of_another_source() -> None:
    """Lies on top of a real obstacle, about it, and in a flood, with and without the camera's own silence."""
    config = parse_config({"tracking": {"max_tracks": 8}}).tracking
    assert {"adsb", "utm", "neighbours"} <= set(config.untrusted)
    honest, lied_to = Tracker(config), Tracker(config)
    sky = Sky("adsb", "utm", "neighbours")
    rng = np.random.default_rng(5)
    for k in range(120):
        t_s = 1.0 + STEP_S * k
        p = np.array([20.0 - 0.1 * k, 5.0, 20.0])
        if k % 3 == 0:
            sky.hear(adsb(p, ICAO_address=1, heading=9000, hor_velocity=5000), system=9)
            sky.hear(*(adsb(p + rng.normal(scale=3.0, size=3), ICAO_address=n) for n in range(2, 30)), system=9)
            sky.hear(utm(p, flags=4 | 8), position_int(p, v_ned_cm_s=(900, 0, 0)), system=9)
        lies = sky.tick(vehicle(t_s, OWN))
        truth = (camera(t_s, ("ball", p)),) if k < 80 else ()
        for tracker, frames in ((honest, truth), (lied_to, (*truth, *lies))):
            tracker.update(frames, round(t_s * S))
            tracker.note_vehicle(vehicle(t_s, OWN))
        known, table = honest.table(), lied_to.table()
        rows = [row for row, sources in enumerate(table.sources) if "camera" in sources]
        assert [table.ids[row] for row in rows] == list(known.ids)
        assert [table.sources[row] for row in rows] == list(known.sources)
        for column in ("p_enu", "v_enu", "a_enu", "covariance", "mode_probabilities", "radius_m"):
            assert np.array_equal(getattr(table, column)[rows], getattr(known, column)), (k, column)
        assert k < 4 or len(table) > len(known)  # it does add


@pytest.mark.parametrize("other", ["utm", "neighbours"])
def test_the_same_aircraft_through_two_doors_becomes_one_track(other: str) -> None:
    """ADS-B once a second, the other five times a second, each with its own error."""
    sky = Sky("adsb", other)
    tracker = Tracker(sky.config.tracking)
    rng = np.random.default_rng(7)
    lengths = []
    for k in range(200):
        t_s = 1.0 + STEP_S * k
        p = np.array([-60.0 + 6.0 * STEP_S * k, 80.0, 40.0])
        if k % 20 == 3:
            sky.hear(adsb(p + rng.normal(scale=1.0, size=3), heading=9000, hor_velocity=600), system=9, component=156)
        if k % 4 == 1:
            measured = p + rng.normal(scale=0.5, size=3)
            if other == "utm":
                sky.hear(utm(measured, vy=600, h_acc=1000, v_acc=1500, vel_acc=20), system=9)
            else:
                sky.hear(position_int(measured, v_ned_cm_s=(0, 600, 0)), system=9)
        tracker.update(sky.tick(vehicle(t_s, OWN)), round(t_s * S))
        tracker.note_vehicle(vehicle(t_s, OWN))
        lengths.append(len(tracker))
    table = tracker.table()
    assert max(lengths) == 2  # until they have agreed for long enough
    assert lengths[60:] == [1] * 140
    assert table.sources == (tuple(sorted(("adsb", other))),)
    np.testing.assert_allclose(table.p_enu[0], p, atol=3.0)
    np.testing.assert_allclose(table.v_enu[0], [6.0, 0.0, 0.0], atol=1.5)


def test_two_aircraft_of_one_door_stay_two() -> None:
    sky = Sky("adsb")
    tracker = Tracker(sky.config.tracking)
    for k in range(100):
        t_s, x = 1.0 + STEP_S * k, 0.3 * k
        if k % 20 == 3:
            sky.hear(adsb((x, 80.0, 40.0), ICAO_address=1, heading=9000, hor_velocity=600))
        if k % 20 == 9:
            sky.hear(adsb((x, 83.0, 40.0), ICAO_address=2, heading=9000, hor_velocity=600))
        tracker.update(sky.tick(vehicle(t_s, OWN)), round(t_s * S))
    assert tracker.table().ids == ("adsb/adsb-000001", "adsb/adsb-000002")


def test_an_aircraft_that_reports_once_a_second_is_never_out_of_sight() -> None:
    """The tracker hides what it has not seen for a second; two reports are lost here."""
    sky = Sky("adsb")
    tracker = Tracker(sky.config.tracking)
    worst_m = 0.0
    for k in range(160):
        t_s = 1.0 + STEP_S * k
        p = np.array([-60.0 + 20.0 * STEP_S * k, 80.0, 40.0])
        tracker.update(sky.tick(vehicle(t_s, OWN)), round(t_s * S))
        if k % 20 == 3 and k not in (63, 83):
            sky.hear(adsb(p, heading=9000, hor_velocity=2000))
        assert len(tracker) == (k > 3)
        if k > 3:
            worst_m = max(worst_m, float(np.linalg.norm(tracker.table().p_enu[0] - p)))
            assert tracker.predict(round(t_s * S), 1, 0.05).ids == ("adsb/adsb-a1b2c3",)
    assert worst_m < 0.5
    for k in range(160, 280):  # silence: carried on for traffic.carry_s, then coasting, then gone
        tracker.update(sky.tick(vehicle(1.0 + STEP_S * k, OWN)), round((1.0 + STEP_S * k) * S))
    assert len(tracker) == 0


def test_from_bytes_to_a_frame_of_the_brain() -> None:
    """All five doors at once through one codec, in pieces that the stream happens to be cut into."""
    sky = Sky("adsb", "neighbours", "utm", "obstacle_distance", "obstacle_distance_3d", origin_known=False)
    sky.tick(vehicle(1.0, OWN))
    place = lat_e7(100.0), lon_e7(50.0), alt_mm(30.0)
    senders = {system: dialect.MAVLink(None, system, 1) for system in (OURS, 7)}
    ring = dialect.MAVLink_obstacle_distance_message(0, 0, [300] + [65535] * 71, 5, 20, 1000, 0.0, 0.0, 12)
    stream = b"".join(
        bytes(message.pack(senders[system]))
        for system, message in (
            (OURS, dialect.MAVLink_gps_global_origin_message(round(LAT * 1e7), round(LON * 1e7), 488_000, 0)),
            (7, adsb((50.0, 100.0, 30.0))),
            (7, dialect.MAVLink_global_position_int_message(0, *place, 0, 0, 0, 0, 0)),
            (7, utm((50.0, 100.0, 30.0))),
            (OURS, ring),
            (OURS, dialect.MAVLink_obstacle_distance_3d_message(0, 0, 12, 3, 2.0, 0.0, 0.0, 0.1, 9.0)),
        )
    )
    for start in range(0, len(stream), 7):
        for event in sky.codec.receive(stream[start : start + 7]):
            sky.doors.handle(event, OURS, None)
    frames = sky.tick(vehicle(1.05, OWN))
    assert {frame.source: [d.id for d in frame.detections] for frame in frames} == {
        "adsb": ["adsb-a1b2c3"],
        "neighbours": ["system-7"],
        "utm": ["utm-" + bytes(range(18)).hex()],
        "obstacle_distance": [None],
        "obstacle_distance_3d": ["3"],
    }
    for frame in [frame for frame in frames if frame.source in ("adsb", "neighbours")]:
        np.testing.assert_allclose(frame.detections[0].p_enu, [50.0, 100.0, 30.0], atol=0.6)
    assert frames == tuple(sorted(frames, key=lambda frame: frame.order_key))
