"""`companion monitor`: its command line, the Zenoh session it listens on, and the loop that shows what came.

    companion monitor --connect tcp/127.0.0.1:7447
    companion monitor --connect tcp/10.0.0.5:7447 --name uav2 --json

In a terminal it draws; into a pipe it writes one line a vehicle and second, with --json one object a second. It
subscribes and asks, and never publishes.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import re
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from typing import Any

import msgspec
import zenoh

from companion.clock import Clock, SystemClock
from companion.config_links import ZenohConfig
from companion.errors import ConfigError
from companion.link.zenoh import open_session
from companion.monitor.essentials import Sight, essentials
from companion.monitor.fleet import KINDS, Fleet

DRAW_S = 0.2  # between two pictures
TELL_S = 1.0  # between two lines
ASK_S = 2.0  # for an answer to a query
_NAMES = {"A": "up", "B": "down"}  # the last letter of what an arrow key sends


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `monitor` to the command line."""
    parser = commands.add_parser(
        "monitor",
        help="show the vehicles on the network in this terminal",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--connect", action="append", default=[], metavar="ENDPOINT", help="e.g. tcp/127.0.0.1:7447")
    parser.add_argument("--listen", action="append", default=[], metavar="ENDPOINT", help="listen as well")
    parser.add_argument("--zenoh-config", metavar="FILE", help="a stock Zenoh configuration, for TLS and passwords")
    parser.add_argument("--name", default="all", help="one vehicle, or all (default)")
    parser.add_argument("--json", action="store_true", help="one JSON object a second, all vehicles in it")
    parser.add_argument("--count", type=int, metavar="N", help="end after N lines of a pipe or objects")
    parser.set_defaults(handler=run)


def run(arguments: argparse.Namespace, *, clock: Clock | None = None) -> int:
    """Listen and show until interrupted; 0.

    Without an endpoint or a configuration it looks for routers and peers by multicast.

    Raises:
        ConfigError: a wrong option, an endpoint or a file that cannot be used.
    """
    name = arguments.name
    if not name or any(character in name for character in "/*$?#"):
        raise ConfigError(f"--name {name}: expected the name of a vehicle, or all")
    if arguments.count is not None and arguments.count < 1:
        raise ConfigError(f"--count {arguments.count}: expected a number above 0")
    clock = clock or SystemClock()
    fleet = Fleet()
    with ExitStack() as stack:
        session = stack.enter_context(closing(open_session(_zenoh_config(arguments))))
        listener = Listener(session, "*" if name == "all" else name, fleet, clock)
        where = ", ".join(arguments.connect) or arguments.zenoh_config or "looking by multicast"
        drawn = not arguments.json and sys.stdout.isatty()
        showing = _draw(listener, clock, where) if drawn else _tell(listener, clock, arguments)
        with contextlib.suppress(KeyboardInterrupt):
            asyncio.run(showing)
    return 0


class Listener:
    """The subscriptions of a monitor; ``look`` is what came of them so far."""

    def __init__(self, session: zenoh.Session, name: str, fleet: Fleet, clock: Clock) -> None:
        self._session = session
        self._fleet = fleet
        self._clock = clock
        self._declared: list[Any] = []  # Zenoh ends what is no longer referenced
        for kind in KINDS:
            self._declared.append(session.declare_subscriber(f"uav/{name}/companion/{kind}", self._received))
        alive = session.liveliness().declare_subscriber(f"uav/{name}/companion/alive", self._token, history=True)
        self._declared.append(alive)

    def look(self) -> list[Sight]:
        """Every vehicle as it is known now; asks new ones for their configuration."""
        for name in self._fleet.unasked():
            self._session.get(f"uav/{name}/companion/config", self._answered, timeout=ASK_S)
        return self._fleet.look(self._clock.monotonic_ns())

    def _received(self, sample: zenoh.Sample) -> None:
        self._fleet.take(str(sample.key_expr), sample.payload.to_bytes(), self._clock.monotonic_ns())

    def _token(self, sample: zenoh.Sample) -> None:
        self._fleet.token(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

    def _answered(self, reply: zenoh.Reply) -> None:
        if (sample := reply.ok) is not None:
            self._fleet.configured(str(sample.key_expr), sample.payload.to_bytes())


async def _tell(listener: Listener, clock: Clock, arguments: argparse.Namespace) -> None:
    """Lines or objects to standard output, one turn a second."""
    from companion.monitor.view import line

    written = 0
    while arguments.count is None or written < arguments.count:
        await clock.sleep(TELL_S)
        found = [essentials(sight) for sight in listener.look()]
        if arguments.json:
            lines = [msgspec.json.encode({"unix_ns": clock.unix_ns(), "vehicles": found}).decode()]
        else:
            lines = [line(each) for each in found] or ["no vehicle heard yet"]
        print("\n".join(lines), flush=True)
        written += 1


class Choice:
    """Which vehicle is shown in full, and whether that is enough."""

    def __init__(self) -> None:
        self.index = 0
        self.ended = False

    def press(self, key: str) -> None:
        self.ended = self.ended or key in ("q", "Q")
        self.index += {"up": -1, "k": -1, "down": 1, "j": 1}.get(key, 0)

    def among(self, vehicles: int) -> int:
        """The index, brought back into the list."""
        self.index = max(0, min(vehicles - 1, self.index))
        return self.index


async def _draw(listener: Listener, clock: Clock, where: str) -> None:
    """The screen, redrawn five times a second, until q."""
    from rich.console import Console  # imported here: the daemon's own command line shall not wait for it
    from rich.live import Live

    from companion.monitor.view import screen

    console, choice = Console(), Choice()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, choice.press, "q")  # the terminal is given back
    with Live(console=console, screen=True, auto_refresh=False) as live, _keys(choice.press):
        while not choice.ended:
            sights = listener.look()
            columns, rows = console.size
            picture = screen(sights, choice.among(len(sights)), columns=columns, rows=rows, endpoint=where)
            live.update(picture, refresh=True)
            await clock.sleep(DRAW_S)


@contextlib.contextmanager
def _keys(pressed: Callable[[str], None]) -> Iterator[None]:
    """Keys as they are pressed, without Enter and unseen; nothing where standard input is no terminal."""
    import termios
    import tty

    if not sys.stdin.isatty():
        yield
        return
    number = sys.stdin.fileno()
    before = termios.tcgetattr(number)

    def read() -> None:
        for key in keys_in(os.read(number, 64)):
            pressed(key)

    loop = asyncio.get_running_loop()
    tty.setcbreak(number)
    loop.add_reader(number, read)
    try:
        yield
    finally:
        loop.remove_reader(number)
        termios.tcsetattr(number, termios.TCSADRAIN, before)


def keys_in(data: bytes) -> list[str]:
    """What was pressed, by name.

    >>> keys_in(b"q\\x1b[Aj\\x1b[B")
    ['q', 'up', 'j', 'down']
    """
    found = re.findall(r"\x1b[\[O].|.", data.decode("ascii", "replace"))
    return [_NAMES.get(key[2], key) if len(key) == 3 else key for key in found]


def _zenoh_config(arguments: argparse.Namespace) -> ZenohConfig:
    reaches = bool(arguments.connect or arguments.listen or arguments.zenoh_config)
    return ZenohConfig(
        config_file=arguments.zenoh_config,
        connect=tuple(arguments.connect),
        listen=tuple(arguments.listen),
        multicast_scouting=None if reaches else True,
    )
