"""`companion doctor -c FILE`: one line a check, and what happens if the daemon dies now."""

from __future__ import annotations

import argparse
import asyncio
import math
import re
from pathlib import Path
from typing import Any

import msgspec

from companion.config import Config, load_config
from companion.doctor.observation import Observation
from companion.doctor.verdict import Check, Level, worst
from companion.errors import ConfigError

DURATION_S = 5.0
_NAME = re.compile(r"[A-Z][A-Z0-9_]{0,15}")

_SUMMARY = {Level.PASS: "fit to fly", Level.WARN: "fit to fly, mind the warnings", Level.FAIL: "not fit to fly"}

_DESCRIPTION = """\
Connects to the configured autopilot as the daemon would (component 196), reads the parameters that decide what a lost
daemon means, measures streams, time and obstacle sources for a few seconds, and times the brain on this machine.
Sends no setpoint, no mode and no arming command. Nothing is changed unless --fix names it; the message rates of this
link are asked for as the daemon asks for them.
"""

_EPILOG = """\
examples:
  companion doctor -c configs/default.toml
  companion doctor -c flight.toml --json > doctor.json
  companion doctor -c flight.toml --fix COM_OBL_RC_ACT=5      land is 4, hold is 5; read back before it counts

exit status: 0 no FAIL, 1 a FAIL, 2 wrong usage or configuration
"""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    doctor = commands.add_parser(
        "doctor",
        help="check autopilot, sensors and this machine before a flight",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    doctor.add_argument("-c", "--config", type=Path, required=True, metavar="FILE", help="TOML configuration")
    doctor.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="overrides", help="override a key (repeatable)"
    )
    doctor.add_argument(
        "--duration", type=float, default=DURATION_S, metavar="S", help="of the measurement (default %(default)g s)"
    )
    doctor.add_argument(
        "--fix",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        dest="fixes",
        help="set this parameter of the autopilot, disarmed only, and read it back (repeatable)",
    )
    doctor.add_argument("--json", action="store_true", help="one JSON object on stdout, nothing else there")
    doctor.set_defaults(handler=_doctor)


def parse_fix(text: str) -> tuple[str, float]:
    """NAME=VALUE of ``--fix``.

    >>> parse_fix("COM_OBL_RC_ACT=5")
    ('COM_OBL_RC_ACT', 5.0)

    Raises:
        ConfigError: not a parameter name of at most 16 characters, or not a finite number.
    """
    name, _, value = text.partition("=")
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if _NAME.fullmatch(name) is None or not math.isfinite(number):
        raise ConfigError(f"--fix {text}: expected NAME=VALUE such as COM_OBL_RC_ACT=5")
    return name, number


def _doctor(arguments: argparse.Namespace) -> int:
    duration_s = arguments.duration
    if not (math.isfinite(duration_s) and 0.5 <= duration_s <= 600.0):
        raise ConfigError(f"--duration {duration_s:g}: expected 0.5 .. 600 s")
    fixes = [parse_fix(text) for text in arguments.fixes]
    if len({name for name, _ in fixes}) != len(fixes):
        raise ConfigError("--fix: expected each name once")
    config = load_config(arguments.config, tuple(arguments.overrides))
    seen = observe(config, duration_s, fixes)
    from companion.doctor.checks import run_checks

    checks = run_checks(seen, config)
    dies = if_it_dies(seen, config)
    if arguments.json:
        print(msgspec.json.encode(as_json(seen, checks, dies)).decode())
    else:
        print_checks(checks, dies)
    return 1 if worst(checks) is Level.FAIL else 0


def observe(config: Config, duration_s: float, fixes: list[tuple[str, float]]) -> Observation:
    """Look at everything; a line of progress on a terminal."""
    from rich.console import Console

    from companion.clock import SystemClock
    from companion.doctor import machine as host
    from companion.doctor.listen import listen
    from companion.link.transports import parse_url

    parse_url(config.mavlink.url)  # wrong configuration is told before anything is measured
    console = Console(stderr=True)
    with console.status("timing the brain on this machine") as status:
        machine = host.examine(config, steps=host.STEPS)
        status.update(f"listening to {config.mavlink.url} and Zenoh, at least {duration_s:g} s")
        link, zenoh = asyncio.run(listen(config, SystemClock(), duration_s=duration_s, fixes=fixes))
    return Observation(duration_s, link, zenoh, machine)


def if_it_dies(seen: Observation, config: Config) -> str:
    """What happens if the daemon dies now, in plain words."""
    from companion.doctor import failsafe

    if seen.link.autopilot is None:
        return "unknown: no autopilot was heard"
    return failsafe.if_it_dies(seen.link.autopilot, config)


def as_json(seen: Observation, checks: list[Check], dies: str) -> dict[str, Any]:
    """One object: the verdict, every check, and everything that was measured."""
    return {
        "status": worst(checks).value,
        "checks": [msgspec.to_builtins(check) for check in checks],
        "if_daemon_dies": dies,
        "observation": msgspec.to_builtins(seen),
    }


def print_checks(checks: list[Check], dies: str) -> None:
    """For people: one line a check, the sentence, the count."""
    width = max(len(check.name) for check in checks)
    for check in checks:
        expected = f"  (expected {check.expected})" if check.expected else ""
        print(f"{check.level.value}  {check.name:<{width}}  {check.found}{expected}")
    print(f"\nIf the daemon dies now: {dies}.")
    counts = ", ".join(f"{sum(c.level is level for c in checks)} {level.value}" for level in Level)
    print(f"{counts}: {_SUMMARY[worst(checks)]}")
