"""`companion`: its commands. Exit status 0 done, 1 the thing failed, 2 wrong usage or configuration."""

from __future__ import annotations

import argparse
import asyncio
import logging
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

import msgspec

from companion import __version__, realtime
from companion.errors import CompanionError, ConfigError

_EPILOG = """\
examples:
  companion demo                              fly the simulated vehicle through crossing obstacles
  companion run -c configs/default.toml       the daemon, beside an autopilot
  companion doctor -c configs/default.toml    is everything fit to fly, and what if the daemon dies?
  companion publish --orbit "center=1,2,1.5 radius=2 speed=1.5" --connect tcp/127.0.0.1:7447
                                              publish a made-up obstacle
"""


def build_parser() -> argparse.ArgumentParser:
    """The whole command line."""
    parser = argparse.ArgumentParser(
        prog="companion",
        description="Keeps a drone clear of moving obstacles: reads MAVLink and Zenoh, streams safe accelerations.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"companion {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_run(commands)
    from companion import publish
    from companion.bench import command as bench
    from companion.demo import command as demo
    from companion.doctor import command as doctor
    from companion.logbook import command as logbook

    demo.add_parser(commands)
    publish.add_parser(commands)
    doctor.add_parser(commands)
    logbook.add_parser(commands)
    bench.add_parser(commands)
    schema = commands.add_parser("schema", help="print the JSON Schema of every Zenoh payload")
    schema.add_argument("key", nargs="?", help="one key suffix, such as companion/setpoint; all where left out")
    schema.add_argument("--keys", action="store_true", help="print every Zenoh key with its quality of service instead")
    schema.set_defaults(handler=_schema)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    realtime.single_threads()  # before anything imports numpy
    arguments = build_parser().parse_args(argv)
    try:
        return int(arguments.handler(arguments))
    except ConfigError as error:
        print(f"companion: {error}", file=sys.stderr)
        return 2
    except CompanionError as error:
        print(f"companion: {error}", file=sys.stderr)
        return 1
    except BrokenPipeError:  # the reader, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _add_run(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    run = commands.add_parser(
        "run",
        help="run the daemon",
        description="Run the daemon until SIGINT or SIGTERM.",
        epilog="example:\n  companion run -c configs/default.toml --set mavlink.url=udpin://0.0.0.0:14541",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    run.add_argument("-c", "--config", type=Path, required=True, metavar="FILE", help="TOML configuration")
    run.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="overrides", help="override a key (repeatable)"
    )
    run.add_argument("--json", action="store_true", help="print a summary as one JSON object on stdout at the end")
    run.add_argument("-v", "--verbose", action="store_true", help="log at debug level")
    run.set_defaults(handler=_run)


def _run(arguments: argparse.Namespace) -> int:
    from companion.clock import SystemClock
    from companion.config import load_config
    from companion.service import Service

    config = load_config(arguments.config, tuple(arguments.overrides))
    logging.basicConfig(
        level=logging.DEBUG if arguments.verbose else logging.INFO,
        stream=sys.stderr,
        format="%(asctime)s %(levelname)s %(message)s",
    )

    async def serve() -> None:
        service = Service(config, SystemClock())
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, service.stop)
        summary = await service.run()
        if arguments.json:
            print(msgspec.json.encode(summary).decode(), flush=True)

    asyncio.run(serve())
    return 0


def _schema(arguments: argparse.Namespace) -> int:
    if arguments.keys:
        from companion.link.keys import key_page

        print(key_page(), end="")
        return 0
    from companion.link.wire import json_schemas

    schemas = json_schemas()
    if arguments.key is not None and arguments.key not in schemas:
        raise ConfigError(f"schema: {arguments.key}: expected one of {', '.join(sorted(schemas))}")
    wanted = schemas if arguments.key is None else schemas[arguments.key]
    print(msgspec.json.format(msgspec.json.encode(wanted), indent=2).decode())
    return 0


if __name__ == "__main__":
    sys.exit(main())
