"""The systemd unit and the udev rules: what systemd itself says, and that they fit the daemon."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from companion.cli import build_parser
from companion.health import BEAT_LIMIT_S

DEPLOY = Path(__file__).parents[2] / "configs" / "systemd"
UNIT = (DEPLOY / "companion.service").read_text(encoding="utf-8")
ANALYZE = shutil.which("systemd-analyze")


def settings() -> dict[str, list[str]]:
    """The unit's values by key, continued lines joined."""
    found: dict[str, list[str]] = {}
    for line in UNIT.replace("\\\n", " ").splitlines():
        if line and line[0] not in "#[":
            key, _, value = line.partition("=")
            found.setdefault(key, []).append(value)
    return found


def analyze(tmp_path: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """systemd-analyze on the unit with a command that exists on this computer."""
    unit = tmp_path / "companion.service"
    unit.write_text(UNIT.replace("/opt/companion/bin/companion", sys.executable), encoding="utf-8")
    assert ANALYZE is not None
    return subprocess.run([ANALYZE, *words, str(unit)], capture_output=True, text=True, timeout=60.0)


@pytest.mark.skipif(ANALYZE is None, reason="systemd is not installed")
def test_systemd_finds_nothing_wrong(tmp_path: Path) -> None:
    done = analyze(tmp_path, "verify", "--man=no")
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(ANALYZE is None, reason="systemd is not installed")
def test_systemd_rates_its_exposure_low(tmp_path: Path) -> None:
    done = analyze(tmp_path, "security", "--offline=true", "--threshold=20", "--no-pager")  # 2.0 of 10
    if "unrecognized option" in done.stderr:
        pytest.skip("this systemd-analyze cannot rate a file")
    assert done.returncode == 0, done.stdout[-200:] + done.stderr


def test_the_command_is_one_that_the_daemon_takes() -> None:
    (start,) = settings()["ExecStart"]
    program, *words = shlex.split(start)
    assert program.endswith("/companion")
    arguments = build_parser().parse_args(words)
    assert (arguments.command, arguments.log_format) == ("run", "json")
    assert f"log.directory=/var/log/{settings()['LogsDirectory'][0]}" in arguments.overrides


def test_the_watchdog_bears_more_than_a_slow_turn_and_the_daemon_is_started_again() -> None:
    unit = settings()
    assert unit["Type"] == ["notify"]
    assert unit["NotifyAccess"] == ["main"]
    assert float(unit["WatchdogSec"][0]) >= 2 * BEAT_LIMIT_S
    assert unit["Restart"] == ["on-failure"]
    assert unit["RestartPreventExitStatus"] == ["2"]  # a wrong configuration


def test_the_rules_are_well_formed_and_name_the_port_of_the_readme() -> None:
    """udev(7): KEY OP "value", separated by commas; matches end in ==, assignments in = or +=."""
    part = re.compile(r'(SUBSYSTEM|KERNEL|ATTRS\{\w+\})=="[^"]+"|(SYMLINK|TAG)\+="\w+"|(GROUP|MODE|ENV\{\w+\})="\w+"')
    lines = (DEPLOY / "99-companion.rules").read_text(encoding="utf-8").splitlines()
    rules = [line.removeprefix("#") for line in lines if re.match(r"#?SUBSYSTEM", line)]
    assert len(rules) >= 5
    for rule in rules:
        assert all(part.fullmatch(word) for word in rule.split(", ")), rule
    assert sum('SYMLINK+="autopilot"' in rule for rule in rules) >= 4
    assert "serial:///dev/autopilot:921600" in (DEPLOY / "README.md").read_text(encoding="utf-8")
