"""The doctor's checks by table, over observations written by hand."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.config import parse_config
from companion.doctor.checks import run_checks
from companion.doctor.command import parse_fix
from companion.doctor.failsafe import if_it_dies
from companion.doctor.machine import _secrets, check_solver, examine, measure_deadline
from companion.doctor.observation import (
    ARDUPILOT,
    PX4,
    Autopilot,
    Deadline,
    Fix,
    Link,
    Machine,
    Observation,
    SecretFile,
    Source,
    Stream,
    Timesync,
    Zenoh,
)
from companion.doctor.parameters import NAMES
from companion.doctor.verdict import Check, Level, worst
from companion.errors import ConfigError
from companion.safety.qp import Infeasible, Program

PX4_VALUES = {"COM_OF_LOSS_T": 1.0, "COM_OBL_RC_ACT": 5, "COM_RCL_EXCEPT": 0, "MPC_THR_HOVER": 0.5}
ARDU_VALUES = {"GUID_TIMEOUT": 0.5, "GUID_OPTIONS": 0, "PSC_JERK_XY": 5.0, "FS_GCS_ENABLE": 1}
CONFIG = parse_config({"vehicle": {"profile": "px4"}})
STREAMS = {
    "HEARTBEAT": Stream(1.0, 1.0, 1.0),
    "LOCAL_POSITION_NED": Stream(50.0, 50.0, 0.021, ack=0),
    "ATTITUDE_QUATERNION": Stream(50.0, 49.8, 0.022, ack=0),
    "EXTENDED_SYS_STATE": Stream(2.0, 2.0, 0.5, ack=0),
}
PX4_VEHICLE = Autopilot(
    system=1,
    component=1,
    kind=PX4,
    custom_mode=0,
    armed=False,
    parameters=PX4_VALUES,
    unanswered=(),
    streams=STREAMS,
    timesync=Timesync(50, 50, 0.5, 2.0, settled=True),
    unix_minus_ours_s=0.002,
)
ARDU_VEHICLE = replace(PX4_VEHICLE, kind=ARDUPILOT, parameters=ARDU_VALUES)
RADAR = Source("radar", 100, 20.0, ("unix",), 0.010, 0.030)
MACHINE = Machine(
    artifact="builtin:default",
    artifact_digest="0123456789abcdef",
    artifact_error=None,
    solvers={"daqp": None, "osqp": None},
    deadline=Deadline(600, 10, 1.0, 3.0, 5.0, 20.0),
    deadline_error=None,
)


def observed(**changes: Any) -> Observation:
    """A sound observation but for ``changes``: vehicle, link, sources, zenoh, machine."""
    link = Link("udpin://127.0.0.1:14540", changes.get("vehicle", PX4_VEHICLE), bytes_in=1000)
    zenoh = Zenoh("uav/uav1", changes.get("sources", (RADAR,)))
    return Observation(5.0, changes.get("link", link), changes.get("zenoh", zenoh), changes.get("machine", MACHINE))


def line(name: str, seen: Observation, config: Any = CONFIG) -> Check:
    (found,) = [check for check in run_checks(seen, config) if check.name == name]
    return found


def px4(**values: Any) -> Observation:
    return observed(vehicle=replace(PX4_VEHICLE, parameters={**PX4_VALUES, **values}))


def ardupilot(**values: Any) -> Observation:
    return observed(vehicle=replace(ARDU_VEHICLE, parameters={**ARDU_VALUES, **values}))


def test_all_is_well() -> None:
    checks = run_checks(observed(), CONFIG)
    assert {check.level for check in checks} == {Level.PASS}
    assert worst(checks) is Level.PASS


@pytest.mark.parametrize(
    ("name", "value", "level"),
    [
        ("COM_OF_LOSS_T", 0.5, Level.PASS),
        ("COM_OF_LOSS_T", 0.01, Level.WARN),
        ("COM_OF_LOSS_T", 5.0, Level.WARN),
        ("COM_OBL_RC_ACT", 0, Level.WARN),
        ("COM_OBL_RC_ACT", 3, Level.WARN),
        ("COM_OBL_RC_ACT", 4, Level.PASS),
        ("COM_OBL_RC_ACT", 5, Level.PASS),
        ("COM_OBL_RC_ACT", 6, Level.FAIL),
        ("COM_OBL_RC_ACT", 7, Level.FAIL),
        ("COM_OBL_RC_ACT", 99, Level.WARN),
        ("COM_RCL_EXCEPT", 3, Level.PASS),
        ("COM_RCL_EXCEPT", 4, Level.WARN),
        ("MPC_THR_HOVER", 0.76, Level.PASS),  # 0.76 (1 + 3 / 9.81) = 0.992
        ("MPC_THR_HOVER", 0.77, Level.WARN),
        ("MPC_THR_HOVER", 0.0, Level.FAIL),
    ],
)
def test_px4_parameters(name: str, value: float, level: Level) -> None:
    assert line(name, px4(**{name: value})).level is level


@pytest.mark.parametrize(
    ("name", "value", "level"),
    [
        ("GUID_TIMEOUT", 0.5, Level.PASS),
        ("GUID_TIMEOUT", 3.0, Level.WARN),
        ("GUID_TIMEOUT", 0.01, Level.WARN),
        ("GUID_OPTIONS", 0b0000_0101, Level.PASS),
        ("GUID_OPTIONS", 0b0010_0000, Level.WARN),
        ("GUID_OPTIONS", 0b1000_0000, Level.WARN),
        ("PSC_JERK_XY", 5.0, Level.PASS),
        ("PSC_JERK_XY", 2.0, Level.WARN),
        ("FS_GCS_ENABLE", 0, Level.WARN),
        ("FS_GCS_ENABLE", 5, Level.PASS),
    ],
)
def test_ardupilot_parameters(name: str, value: float, level: Level) -> None:
    config = parse_config({"vehicle": {"profile": "ardupilot"}})
    assert line(name, ardupilot(**{name: value}), config).level is level


def test_the_filter_must_not_change_faster_than_ardupilot_follows() -> None:
    config = parse_config({"vehicle": {"profile": "ardupilot"}, "limits": {"slew_m_s3": 8.0}})
    assert line("PSC_JERK_XY", ardupilot(), config).level is Level.WARN
    assert line("PSC_JERK_XY", ardupilot(PSC_JERK_XY=6.5), config).level is Level.PASS


@pytest.mark.parametrize(
    ("vehicle", "words"),
    [
        (PX4_VEHICLE, "after 1 s without setpoints the autopilot holds its position (COM_OBL_RC_ACT 5)"),
        (
            replace(PX4_VEHICLE, parameters={"COM_OF_LOSS_T": 0.5, "COM_OBL_RC_ACT": 4}),
            "after 0.5 s without setpoints the autopilot lands where it is (COM_OBL_RC_ACT 4)",
        ),
        (replace(PX4_VEHICLE, parameters={}), "unknown: COM_OF_LOSS_T or COM_OBL_RC_ACT was not told"),
        (
            # 3 m/s^2 for 3 s: 9 m/s, 13.5 m
            replace(ARDU_VEHICLE, parameters={"GUID_TIMEOUT": 3.0}),
            "the last acceleration goes on for 3 s (GUID_TIMEOUT), then it brakes: from 3 m/s^2 it gains up to 9.0 m/s"
            " and flies 14 m beyond its path",
        ),
        (replace(PX4_VEHICLE, kind=0), "unknown: autopilot kind 0 is neither PX4 nor ArduPilot"),
    ],
)
def test_what_happens_if_the_daemon_dies(vehicle: Autopilot, words: str) -> None:
    assert if_it_dies(vehicle, CONFIG) == words


def test_a_parameter_that_is_not_told_is_skipped_unless_it_decides_a_death() -> None:
    seen = observed(vehicle=replace(PX4_VEHICLE, parameters={}))
    assert line("MPC_THR_HOVER", seen).level is Level.SKIP
    assert line("COM_OBL_RC_ACT", seen).level is Level.FAIL
    unknown = replace(PX4_VEHICLE, kind=0)
    assert line("failsafe", observed(vehicle=unknown)).level is Level.SKIP


@pytest.mark.parametrize(
    ("name", "stream", "level"),
    [
        ("LOCAL_POSITION_NED", Stream(50.0, 44.0, 0.03), Level.WARN),
        ("LOCAL_POSITION_NED", Stream(50.0, 20.0, 0.1), Level.FAIL),
        ("LOCAL_POSITION_NED", Stream(50.0, 48.0, 0.6), Level.FAIL),  # longer than vehicle.stale_s
        ("LOCAL_POSITION_NED", Stream(50.0, 0.0, None, ack=2), Level.FAIL),
        ("EXTENDED_SYS_STATE", Stream(2.0, 1.8, 0.6), Level.PASS),
        ("EXTENDED_SYS_STATE", Stream(2.0, 0.0, None), Level.FAIL),
        ("HEARTBEAT", Stream(1.0, 0.8, 1.0), Level.PASS),  # four in a window of five seconds
        ("HEARTBEAT", Stream(1.0, 0.0, None), Level.FAIL),
    ],
)
def test_streams(name: str, stream: Stream, level: Level) -> None:
    seen = observed(vehicle=replace(PX4_VEHICLE, streams={**STREAMS, name: stream}))
    assert line(name, seen).level is level
    if stream.ack == 2:
        assert "denied" in line(name, seen).found


def test_lockstep_skips_what_waits_for_the_daemon() -> None:
    config = parse_config({"sync": "lockstep", "lockstep_sources": ["sim"]})
    assert line("LOCAL_POSITION_NED", observed(), config).level is Level.SKIP
    assert line("HEARTBEAT", observed(), config).level is Level.PASS


@pytest.mark.parametrize(
    ("sync", "level"),
    [
        (Timesync(50, 0, None, None, settled=False), Level.FAIL),
        (Timesync(50, 3, 1.0, 2.0, settled=False), Level.FAIL),
        (Timesync(50, 50, 35.0, 60.0, settled=True), Level.WARN),
    ],
)
def test_timesync(sync: Timesync, level: Level) -> None:
    assert line("TIMESYNC", observed(vehicle=replace(PX4_VEHICLE, timesync=sync))).level is level


def test_the_vehicles_date() -> None:
    assert line("vehicle date", observed(vehicle=replace(PX4_VEHICLE, unix_minus_ours_s=-37.0))).level is Level.WARN
    assert line("vehicle date", observed(vehicle=replace(PX4_VEHICLE, unix_minus_ours_s=None))).level is Level.SKIP


@pytest.mark.parametrize(
    ("link", "name", "found"),
    [
        (Link("u", None, error="port in use"), "link", "port in use"),
        (Link("udpin://h:1", None), "autopilot", "nothing on udpin://h:1"),
        (Link("u", None, bytes_in=5), "autopilot", "bytes, but no heartbeat"),
        (Link("u", None, bytes_in=5, systems=(1, 2)), "autopilot", "heard: system 1, 2"),
    ],
)
def test_no_autopilot_fails_and_the_rest_is_checked(link: Link, name: str, found: str) -> None:
    seen = observed(link=link)
    assert line(name, seen).level is Level.FAIL
    assert found in line(name, seen).found
    assert line("deadline", seen).level is Level.PASS
    assert line("source radar", seen).level is Level.PASS


def test_the_profile_must_be_for_the_autopilot_that_is_heard() -> None:
    assert line("autopilot", observed(vehicle=ARDU_VEHICLE)).level is Level.FAIL
    config = parse_config({"vehicle": {"profile": "ardupilot"}})
    assert line("autopilot", observed(vehicle=ARDU_VEHICLE), config).level is Level.PASS


@pytest.mark.parametrize(
    ("least_s", "greatest_s", "level"),
    [
        (0.010, 0.030, Level.PASS),
        (-0.004, 0.030, Level.PASS),
        (-0.006, 0.030, Level.WARN),  # that clock is ahead for certain
        (-0.101, 0.000, Level.FAIL),  # the daemon rejects it as coming from the future
        (0.100, 0.600, Level.WARN),
        (0.510, 0.600, Level.FAIL),  # every frame is stale
    ],
)
def test_clocks_of_sensor_hosts(least_s: float, greatest_s: float, level: Level) -> None:
    source = replace(RADAR, least_age_s=least_s, greatest_age_s=greatest_s)
    assert line("clock of radar", observed(sources=(source,))).level is level


def test_a_clock_that_cannot_be_compared_is_skipped() -> None:
    source = replace(RADAR, clocks=("vehicle",), least_age_s=None, greatest_age_s=None)
    assert line("clock of radar", observed(sources=(source,))).level is Level.SKIP


def test_sources() -> None:
    some, most = replace(RADAR, rejected={"stale": 3}), replace(RADAR, rejected={"stale": 40, "malformed": 20})
    assert line("source radar", observed(sources=(some,))).level is Level.WARN
    assert line("source radar", observed(sources=(most,))).level is Level.FAIL
    assert "20 malformed, 40 stale" in line("source radar", observed(sources=(most,))).found
    assert line("sources", observed(sources=())).level is Level.WARN
    required = parse_config({"vehicle": {"profile": "px4"}, "obstacles": {"required": ["radar"]}})
    assert line("source radar", observed(sources=()), required).level is Level.FAIL
    assert line("source radar", observed(sources=(replace(RADAR, rate_hz=0.5),)), required).level is Level.FAIL
    traffic = replace(observed(sources=()).link, traffic={"ADSB_VEHICLE": 7})
    assert line("traffic", observed(sources=(), link=traffic)).found == "7 ADSB_VEHICLE over MAVLink"


def test_the_vehicle_by_zenoh() -> None:
    config = parse_config({"vehicle": {"profile": "px4", "source": "zenoh"}})
    for rate_hz, level in ((50.0, Level.PASS), (40.0, Level.WARN), (0.0, Level.FAIL)):
        seen = observed(zenoh=Zenoh("uav/uav1", (RADAR,), rate_hz))
        assert line("vehicle/state", seen, config).level is level


def test_a_zenoh_session_that_does_not_open_fails() -> None:
    assert line("zenoh", observed(zenoh=Zenoh("uav/uav1", error="cannot open"))).level is Level.FAIL


@pytest.mark.parametrize(("p99_ms", "level"), [(9.9, Level.PASS), (10.1, Level.WARN), (20.1, Level.FAIL)])
def test_deadlines(p99_ms: float, level: Level) -> None:
    machine = replace(MACHINE, deadline=Deadline(600, 10, 1.0, p99_ms, 30.0, 20.0))
    assert line("deadline", observed(machine=machine)).level is level


def test_a_broken_artefact_fails_and_nothing_is_timed() -> None:
    machine = replace(MACHINE, artifact_error="policy.artifact: x: expected a folder", deadline=None)
    assert line("artifact", observed(machine=machine)).level is Level.FAIL
    assert line("deadline", observed(machine=machine)).level is Level.SKIP
    broken = replace(MACHINE, solvers={"daqp": "not there", "osqp": None})
    assert line("solver daqp", observed(machine=broken)).level is Level.FAIL


@pytest.mark.parametrize(
    ("mode", "level"), [(0o600, Level.PASS), (0o400, Level.PASS), (0o640, Level.FAIL), (None, Level.FAIL)]
)
def test_secrets(mode: int | None, level: Level) -> None:
    machine = replace(MACHINE, secrets=(SecretFile("mavlink.signing_key_file", "key", mode),))
    assert line("mavlink.signing_key_file", observed(machine=machine)).level is level


def test_secret_files_are_found_by_their_keys_and_their_modes_read(tmp_path: Path) -> None:
    key, missing = tmp_path / "mavlink.key", tmp_path / "none"
    key.write_bytes(b"x")
    os.chmod(key, 0o604)
    table = {
        "mavlink": {"signing_key_file": str(key), "url": "udpin://0.0.0.0:1"},
        "zenoh": {
            "tls": {"private_key": str(missing), "certificate": "public.pem"},
            "users_file": "no/such",
            "password_file": None,
        },
        "obstacles": {"key": {"a": 1}},
    }
    assert list(_secrets("", table)) == [
        SecretFile("mavlink.signing_key_file", str(key), 0o604),
        SecretFile("zenoh.tls.private_key", str(missing), None),
        SecretFile("zenoh.users_file", "no/such", None),
    ]


def test_fixes_are_lines_of_their_own() -> None:
    fixes = (
        Fix("COM_OBL_RC_ACT", 5.0, 0, 5),
        Fix("COM_OF_LOSS_T", 0.3, 1.0, 1.0),
        Fix("NO_SUCH", 1.0, None, None, "the autopilot does not know this name"),
    )
    seen = observed(vehicle=replace(PX4_VEHICLE, fixes=fixes))
    assert line("fix COM_OBL_RC_ACT", seen).level is Level.PASS
    assert line("fix COM_OBL_RC_ACT", seen).found == "was 0, reads 5 now"
    assert line("fix COM_OF_LOSS_T", seen).level is Level.FAIL
    assert "does not know" in line("fix NO_SUCH", seen).found


@pytest.mark.parametrize("text", ["", "X", "X=", "x=1", "COM_OBL_RC_ACT=nan", "A_NAME_OF_17_CHARS=1", "A B=1", "=1"])
def test_fixes_that_cannot_be_read(text: str) -> None:
    with pytest.raises(ConfigError, match="expected NAME=VALUE"):
        parse_fix(text)


def test_a_solver_that_answers_wrongly_or_not_at_all_is_told() -> None:
    def fails(program: Program) -> Any:
        raise Infeasible("infeasible: 2 variables")

    assert check_solver(lambda program: np.array([2.0, 0.0])) == "expected (2.5, 0.5), got [2. 0.]"
    assert check_solver(lambda program: None) == "expected (2.5, 0.5), got None"
    assert check_solver(fails) == "infeasible: 2 variables"


def test_the_machine_is_examined_for_real() -> None:
    machine = examine(CONFIG, steps=20)
    assert machine.artifact_error is None
    assert machine.solvers == {"daqp": None, "osqp": None}
    assert machine.deadline is not None
    assert machine.deadline.period_ms == 20.0
    missing = examine(parse_config({"policy": {"artifact": "builtin:none"}}), steps=20)
    assert "builtin:none" in (missing.artifact_error or "")
    assert missing.deadline is None


def test_the_deadline_is_what_the_stopwatch_says() -> None:
    readings = iter(range(0, 10**12, 3_000_000))  # 3 ms a reading
    deadline = measure_deadline(CONFIG, obstacles=2, steps=5, stopwatch=lambda: next(readings))
    assert (deadline.p50_ms, deadline.p99_ms, deadline.max_ms) == (3.0, 3.0, 3.0)


def test_the_documentation_names_every_parameter_that_is_read() -> None:
    text = (Path(__file__).parents[2] / "docs" / "how-to" / "check-before-flight.md").read_text(encoding="utf-8")
    assert [name for names in NAMES.values() for name in names if f"| {name} (" not in text] == []
