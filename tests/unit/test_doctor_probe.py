"""The doctor's side of the link against autopilots written with pymavlink, on a clock that only we move."""

from __future__ import annotations

import json
import random
from typing import Any

import pytest
from doctor_peer import ARDUPILOT, INT32, PX4, REAL32, Peer
from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.doctor.mavlink_probe import MavlinkProbe
from companion.doctor.observation import Autopilot
from companion.doctor.parameters import read_value, wire_value
from companion.doctor.sources import SourceLog
from companion.link.mavlink import MavlinkCodec
from companion.types import NS_PER_S

STREAMS = {"HEARTBEAT": 1.0, "EXTENDED_SYS_STATE": 2.0, "LOCAL_POSITION_NED": 50.0, "ATTITUDE_QUATERNION": 50.0}
PX4_VALUES = {"COM_OF_LOSS_T": 1.0, "COM_OBL_RC_ACT": 0, "COM_RCL_EXCEPT": 4, "MPC_THR_HOVER": 0.5, "OTHER": -1}
ARDU_VALUES = {"GUID_TIMEOUT": 3.0, "GUID_OPTIONS": 5, "PSC_JERK_XY": 5.0, "FS_GCS_ENABLE": 1}
UNIX_NS = 1_700_000_000 * NS_PER_S


def examine(
    *peers: Peer,
    fixes: tuple[tuple[str, float], ...] = (),
    system_id: int | None = 1,
    loss: Any = lambda k: False,
    limit_s: float = 30.0,
) -> tuple[Autopilot | None, float, MavlinkProbe]:
    """Let doctor and peers talk in steps of 5 ms until the doctor has seen enough; ``loss(k)``: is answer k lost?"""
    probe = MavlinkProbe(MavlinkCodec(system=1), system_id=system_id, streams=STREAMS, duration_s=4.0, fixes=fixes)
    answers = 0
    for step in range(round(limit_s / 0.005)):
        now_s = 100.0 + 0.005 * step
        now_ns = round(now_s * NS_PER_S)
        if probe.finished(now_ns):
            return probe.result(), now_s - 100.0, probe
        for data in probe.poll(now_ns):
            for peer in peers:
                answer = peer.take(data, now_s)
                answers += answer != b""
                if answer and not loss(answers):
                    probe.receive(answer, now_ns + 300_000, UNIX_NS + now_ns)
        for peer in peers:
            if telemetry := peer.stream(now_s):
                probe.receive(telemetry, now_ns, UNIX_NS + now_ns)
    raise AssertionError("the doctor does not end")


def test_px4_is_read_and_nothing_is_changed() -> None:
    peer = Peer(PX4, PX4_VALUES)
    seen, took_s, _ = examine(peer)
    assert seen is not None
    assert (seen.system, seen.component, seen.kind, seen.armed) == (1, 1, PX4, False)
    assert seen.parameters == {name: PX4_VALUES[name] for name in PX4_VALUES if name != "OTHER"}
    assert isinstance(seen.parameters["COM_OBL_RC_ACT"], int)
    for name, rate_hz in STREAMS.items():
        assert seen.streams[name].heard_hz == pytest.approx(rate_hz, abs=0.5), name
    assert seen.streams["LOCAL_POSITION_NED"].ack == 0
    assert seen.timesync.settled
    assert seen.timesync.median_ms == pytest.approx(0.3)
    assert took_s < 6.0
    assert peer.unasked() == []
    assert {m.get_srcComponent() for m in peer.received} == {196}
    assert {(m.type, m.autopilot) for m in peer.of("HEARTBEAT")} == {(18, 8)}


def test_ardupilot_is_read_and_unknown_names_are_given_up() -> None:
    values = {name: value for name, value in ARDU_VALUES.items() if name != "PSC_JERK_XY"}
    peer = Peer(ARDUPILOT, values)
    seen, took_s, _ = examine(peer)
    assert seen is not None
    assert seen.parameters == values
    assert seen.parameters["GUID_OPTIONS"] == 5
    assert seen.unanswered == ("PSC_JERK_XY",)
    asked = [m.param_id for m in peer.of("PARAM_REQUEST_READ")]
    assert asked.count("PSC_JERK_XY") == 4
    assert asked.count("GUID_TIMEOUT") == 1
    assert took_s < 6.0
    assert peer.unasked() == []


@pytest.mark.parametrize(
    ("kind", "values", "name", "wanted"),
    [
        (PX4, PX4_VALUES, "COM_OBL_RC_ACT", 5),
        (PX4, PX4_VALUES, "COM_OF_LOSS_T", 0.3),
        (PX4, PX4_VALUES, "OTHER", -7),
        (ARDUPILOT, ARDU_VALUES, "GUID_TIMEOUT", 0.5),
        (ARDUPILOT, ARDU_VALUES, "FS_GCS_ENABLE", 5),
    ],
)
def test_a_fix_changes_the_named_parameter_alone_and_reads_it_back(
    kind: int, values: dict[str, Any], name: str, wanted: float
) -> None:
    peer = Peer(kind, values)
    seen, _, _ = examine(peer, fixes=((name, wanted),))
    assert seen is not None
    assert peer.parameters == {**values, name: pytest.approx(wanted)}
    assert type(peer.parameters[name]) is type(values[name])
    (fix,) = seen.fixes
    assert (fix.before, fix.done) == (values[name], True)
    assert seen.parameters[name] == pytest.approx(wanted)  # what the checks judge is the new value
    writes = [index for index, m in enumerate(peer.received) if m.get_type() == "PARAM_SET"]
    assert len(writes) == 1
    later = peer.received[writes[0] :]
    assert name in [m.param_id for m in later if m.get_type() == "PARAM_REQUEST_READ"]


@pytest.mark.parametrize(
    ("peer", "fix", "refused", "writes"),
    [
        (Peer(PX4, PX4_VALUES), ("NO_SUCH", 1.0), "the autopilot does not know this name", 0),
        (Peer(PX4, PX4_VALUES, armed=True), ("COM_OBL_RC_ACT", 5.0), "the vehicle is armed", 0),
        (Peer(PX4, PX4_VALUES), ("COM_OBL_RC_ACT", 4.5), "expected a whole number, got 4.5", 0),
        (Peer(PX4, PX4_VALUES), ("COM_OBL_RC_ACT", 1e12), "expected a value that fits 32 bits, got 1e+12", 0),
        (Peer(PX4, PX4_VALUES, read_only=["COM_OBL_RC_ACT"]), ("COM_OBL_RC_ACT", 5.0), None, 4),
    ],
)
def test_fixes_that_cannot_be_done(peer: Peer, fix: tuple[str, float], refused: str | None, writes: int) -> None:
    seen, _, _ = examine(peer, fixes=(fix,))
    assert seen is not None
    assert peer.parameters == PX4_VALUES
    assert (seen.fixes[0].refused, seen.fixes[0].done) == (refused, False)
    assert len(peer.of("PARAM_SET")) == writes


def test_a_fix_that_is_so_already_writes_nothing() -> None:
    peer = Peer(PX4, PX4_VALUES)
    seen, _, _ = examine(peer, fixes=(("COM_RCL_EXCEPT", 4.0),))
    assert seen is not None
    assert seen.fixes[0].done
    assert peer.unasked() == []


def test_lost_answers_are_asked_for_again() -> None:
    peer, rng = Peer(PX4, PX4_VALUES), random.Random(6)
    seen, _, _ = examine(peer, fixes=(("COM_OBL_RC_ACT", 5.0),), loss=lambda k: rng.random() < 0.5)
    assert seen is not None
    assert seen.unanswered == ()
    assert seen.fixes[0].done
    assert seen.timesync.answered < seen.timesync.asked


def test_nobody_is_waited_for_a_bounded_time() -> None:
    seen, took_s, probe = examine()
    assert (seen, probe.systems) == (None, set())
    assert took_s == pytest.approx(6.0, abs=0.1)


def test_several_autopilots_need_a_choice() -> None:
    peers = Peer(PX4, PX4_VALUES), Peer(ARDUPILOT, ARDU_VALUES, system=2)
    seen, _, probe = examine(*peers, system_id=None)
    assert (seen, probe.systems) == (None, {1, 2})
    seen, _, _ = examine(Peer(PX4, PX4_VALUES), Peer(ARDUPILOT, ARDU_VALUES, system=2), system_id=2)
    assert seen is not None
    assert (seen.system, seen.kind) == (2, ARDUPILOT)
    assert seen.parameters == ARDU_VALUES


def test_an_autopilot_that_answers_nothing_is_told_as_such() -> None:
    seen, took_s, _ = examine(Peer(PX4, PX4_VALUES, silent=True))
    assert seen is not None
    assert seen.parameters == {}
    assert seen.timesync.answered == 0
    assert seen.streams["LOCAL_POSITION_NED"].heard_hz == 0.0
    assert took_s < 8.0


@pytest.mark.parametrize(
    ("param_type", "value"), [(INT32, -1), (INT32, 2**31 - 1), (INT32, -(2**31)), (2, -5), (3, 65535)]
)
def test_integers_of_px4_are_read_from_their_bytes(param_type: int, value: int) -> None:
    """Some of these bit patterns are NaNs: packet by hand, as the specification lays it out."""
    number = value & {2: 0xFF, 3: 0xFFFF, INT32: 0xFFFFFFFF}[param_type]
    payload = number.to_bytes(4, "little") + bytes(4) + b"NAME".ljust(16, b"\x00") + bytes([param_type])
    head = bytes([len(payload), 0, 0, 0, 1, 1, 22, 0, 0])
    checksum = dialect.x25crc(head + payload + bytes([220])).crc  # CRC_EXTRA of PARAM_VALUE
    codec, heard = MavlinkCodec(), []
    codec.on_message = heard.append
    codec.receive(b"\xfd" + head + payload + checksum.to_bytes(2, "little"))
    assert [read_value(message, PX4) for message in heard] == [value]


def test_an_integer_whose_bits_are_no_number_is_not_sent() -> None:
    with pytest.raises(ValueError, match="can carry"):
        wire_value(0x7F800001, INT32, PX4)  # a signalling NaN: the conversion to a double would change it
    assert wire_value(0.25, REAL32, PX4) == 0.25


def frame(stamp_ns: int, clock: str = "unix", **obstacle: Any) -> bytes:
    seen = {"id": "a", "position": [1.0, 2.0, 3.0], "radius": 0.2, **obstacle}
    return json.dumps({"stamp_ns": stamp_ns, "clock": clock, "obstacles": [seen]}).encode()


def test_sources_are_judged_by_the_daemons_rules() -> None:
    log, now_ns = SourceLog(), 50 * NS_PER_S
    for k in range(11):
        at = {"now_ns": now_ns + k * NS_PER_S // 10, "unix_ns": UNIX_NS + k * NS_PER_S // 10}
        log.push("fast", frame(at["unix_ns"] - 20_000_000 - k * 1_000_000), "application/json", **at)
        log.push("ahead", frame(at["unix_ns"] + 150_000_000), "", **at)
        log.push("old", frame(at["unix_ns"] - 700_000_000), "", **at)
        log.push("boot", frame(at["now_ns"] - 49 * NS_PER_S - 40_000_000, "vehicle"), "", **at)
    log.push("bad", b"{", "", now_ns=now_ns, unix_ns=UNIX_NS)
    log.push("bad", frame(UNIX_NS, radius=-1.0), "", now_ns=now_ns, unix_ns=UNIX_NS)
    # the vehicle's clock stood at 1 s where ours stood at 50 s
    sources = log.result(now_ns + NS_PER_S, unix_minus_vehicle_ns=UNIX_NS - NS_PER_S, max_age_s=0.5)
    told = {source.name: source for source in sources}
    assert told["fast"].rate_hz == pytest.approx(10.0)
    assert (told["fast"].least_age_s, told["fast"].greatest_age_s) == pytest.approx((0.020, 0.030))
    assert told["fast"].rejected == {}
    assert told["ahead"].rejected == {"future": 11}
    assert told["ahead"].least_age_s == pytest.approx(-0.15)
    assert told["old"].rejected == {"stale": 11}
    assert told["boot"].least_age_s == pytest.approx(0.040)
    assert told["bad"].rejected == {"malformed": 1, "out_of_range": 1}


def test_without_timesync_unix_ages_are_known_and_vehicle_ages_are_not() -> None:
    log = SourceLog()
    log.push("unix", frame(UNIX_NS - 5_000_000), "", now_ns=7, unix_ns=UNIX_NS)
    log.push("boot", frame(123, "vehicle"), "", now_ns=7, unix_ns=UNIX_NS)
    boot, unix = log.result(NS_PER_S, unix_minus_vehicle_ns=None, max_age_s=0.5)
    assert unix.least_age_s == pytest.approx(0.005)
    assert (boot.least_age_s, boot.rejected) == (None, {})


def test_a_heartbeat_that_falls_just_outside_a_short_window_is_heard() -> None:
    """At 1 Hz a second may hold none; what came since the autopilot was found counts, for nobody asks for them."""
    probe = MavlinkProbe(MavlinkCodec(system=1), system_id=1, streams={"HEARTBEAT": 1.0}, duration_s=1.0)
    autopilot = dialect.MAVLink(None, 1, 1)
    for k in range(400):
        now_ns = 10 * NS_PER_S + k * 10_000_000
        if k in (0, 99, 201, 300):  # [s / 100]; the window is from 100 to 200
            probe.receive(autopilot.heartbeat_encode(2, PX4, 1, 0, 3).pack(autopilot), now_ns, UNIX_NS)
        probe.poll(now_ns)
    seen = probe.result()
    assert seen is not None
    stream = seen.streams["HEARTBEAT"]
    assert stream.heard_hz == pytest.approx(1.0)
    assert stream.measured_s == pytest.approx(2.0)
