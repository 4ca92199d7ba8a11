"""What the programs of a documented command are in a test: ours from this checkout, with the session's ports.

Only what is needed to start them is imported here, because every command of every page comes through.

- ``make TARGET`` is asked for what it would do (``make -n``);
- ``companion demo`` flies in lockstep;
- a measurement whose length the page leaves open is short (`_SHORT`).
"""

from __future__ import annotations

import os
import shlex
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
_SHORT = {"doctor": ["--duration", "1.5"]}
_MODULES = {"companion": "companion.cli", "sim-bridge": "sim_bridge.cli", "policies": "policies.cli"}


def become(program: str, arguments: list[str]) -> None:
    """What a program of the page is here: ours from this checkout, with this session's ports."""
    ports = dict(pair.split(":") for pair in os.environ["DOCS_PORTS"].split(","))
    if program == "make":
        command = ["/usr/bin/env", "-i", f"PATH={os.defpath}", "make", "-n", "-C", str(ROOT), *arguments]
    elif program == "python3":
        command = [sys.executable, *arguments]
    elif program == "pytest":
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *arguments]
    else:
        command = [sys.executable, "-m", _MODULES[program], *arguments, *_left_to_defaults(program, arguments, ports)]
    os.execv(command[0], command)


def _left_to_defaults(program: str, arguments: list[str], ports: dict[str, str]) -> list[str]:
    """The ports, and the length of a measurement, that a command leaves to the program."""
    added: list[str] = []
    text = shlex.join(arguments)
    match (program, arguments[:1]):
        case ("companion", ["run" | "doctor" as command]):
            if "mavlink.url" not in text and "url =" not in _configuration(arguments):
                added += ["--set", f"mavlink.url=udpin://127.0.0.1:{ports['14540']}"]
            if command in _SHORT and "--duration" not in text and "--help" not in text:
                added += _SHORT[command]
        case ("companion", ["demo"]) if "--lockstep" not in text:
            added.append("--lockstep")
        case ("sim-bridge", ["run"]) if "--check" not in text:
            for option, value in (
                ("--onboard-port", ports["14540"]),
                ("--gcs-port", ports["14550"]),
                ("--zenoh-listen", f"tcp/127.0.0.1:{ports['7447']}"),
            ):
                if option not in text:
                    added += [option, value]
    return added


def _configuration(arguments: list[str]) -> str:
    for word, following in zip(arguments, [*arguments[1:], ""], strict=True):
        if word in ("-c", "--config"):
            return Path(following).read_text(encoding="utf-8")
    return ""
