"""`companion publish`: obstacle frames from a file, standard input or a made-up motion, as a sensor would send them.

    companion publish --key-source lidar --from frames.jsonl --connect tcp/127.0.0.1:7447
    companion publish --key-source demo --orbit "center=1,2,1.5 radius=2 speed=1.5" --connect tcp/127.0.0.1:7447

Every line of a file is one ObstacleFrame of the wire contract, checked before it leaves.
"""

from __future__ import annotations

import argparse
import asyncio
import math
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path

import msgspec
import zenoh

from companion.clock import Clock, SystemClock
from companion.config_links import ZenohConfig
from companion.errors import ConfigError, FrameRejected
from companion.link import ingress, wire
from companion.link.zenoh import open_session
from companion.types import NS_PER_S

MATCH_S = 3.0
_POLL_S = 0.02
_DEFAULT_RATE_HZ = 20.0

Motion = Callable[[float], wire.Vec]  # seconds -> position, ENU [m]
_EXAMPLES = {
    "orbit": "center=1,2,1.5 radius=2 speed=1.5",
    "line": "start=0,-3,1.5 end=0,3,1.5 speed=1",
    "eight": "center=0,0,1.5 size=2 speed=1",
}


@dataclass(frozen=True, slots=True)
class _Line:
    """One frame to send, or why it cannot be."""

    frame: wire.ObstacleFrame | None
    problem: str = ""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> argparse.ArgumentParser:
    """Add the `publish` command; ``run`` is its handler."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "publish",
        help="send obstacle frames from a file, standard input or a made-up motion",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--key-source", default="cli", metavar="NAME", help="the source in the key (default: cli)")
    parser.add_argument("--name", default="uav1", help="the vehicle: the key starts with uav/NAME (default: uav1)")
    parser.add_argument("--connect", action="append", default=[], metavar="ENDPOINT", help="e.g. tcp/127.0.0.1:7447")
    parser.add_argument("--listen", action="append", default=[], metavar="ENDPOINT", help="listen instead of connect")
    parser.add_argument("--zenoh-config", metavar="FILE", help="a stock Zenoh configuration, for TLS and passwords")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--from", dest="source", metavar="FILE", help="JSON lines, one frame each; - is standard input")
    for motion, example in _EXAMPLES.items():
        what.add_argument(f"--{motion}", metavar="SPEC", help=f'a sphere on this path, e.g. "{example}"')
    parser.add_argument("--rate", type=float, metavar="HZ", help="frames a second (motions: 20; a file: by its stamps)")
    parser.add_argument("--keep-stamps", action="store_true", help="send a file's stamps unchanged instead of now")
    parser.add_argument("--size", type=float, default=0.2, metavar="M", help="radius of the made-up sphere")
    parser.add_argument("--std", type=float, metavar="M", help="position_std stated for the made-up sphere")
    parser.add_argument("--duration", type=float, metavar="S", help="end a made-up motion after this long")
    parser.set_defaults(handler=run)
    return parser


def run(args: argparse.Namespace, *, clock: Clock | None = None) -> int:
    """Send the frames; 0 when all went to a subscriber, 1 when a line was bad or nobody listened.

    Raises:
        ConfigError: a wrong option, an unreadable file, an endpoint that cannot be used.
    """
    clock = clock or SystemClock()
    _check_options(args)
    key = f"uav/{args.name}/obstacles/{args.key_source}"
    config = ZenohConfig(config_file=args.zenoh_config, connect=tuple(args.connect), listen=tuple(args.listen))
    with ExitStack() as stack:
        lines = _lines(args, stack)
        runner = stack.enter_context(asyncio.Runner())
        session = stack.enter_context(closing(open_session(config)))
        sender = _Sender(session, key, runner, clock)
        heard = sender.wait_for_subscriber()
        if not heard:
            print(f"companion publish: no subscriber on {key} within {MATCH_S:g} s, sending anyway", file=sys.stderr)
        try:
            bad = sender.send_all(lines, rate_hz=args.rate, keep_stamps=args.keep_stamps)
        except KeyboardInterrupt:
            bad = sender.bad
        heard = heard or sender.matching
    lost = "" if heard else ", nobody listened"
    print(f"companion publish: {sender.sent} frames on {key}, {bad} bad lines skipped{lost}", file=sys.stderr)
    return 0 if heard and bad == 0 else 1


class _Sender:
    """Paces, stamps and sends. A publisher that blocks rather than drops: what a file holds shall arrive."""

    def __init__(self, session: zenoh.Session, key: str, runner: asyncio.Runner, clock: Clock) -> None:
        self.sent = 0
        self.bad = 0
        self._runner = runner
        self._clock = clock
        self._publisher = session.declare_publisher(
            key, encoding=wire.JSON, congestion_control=zenoh.CongestionControl.BLOCK
        )

    @property
    def matching(self) -> bool:
        status: zenoh.MatchingStatus = self._publisher.matching_status  # type: ignore[assignment]
        return status.matching

    def wait_for_subscriber(self) -> bool:
        for _ in range(round(MATCH_S / _POLL_S)):
            if self.matching:
                return True
            self._sleep(_POLL_S)
        return self.matching

    def send_all(self, lines: Iterator[_Line], *, rate_hz: float | None, keep_stamps: bool) -> int:
        """Send every good line in its time; returns how many were bad, each told on standard error."""
        start_ns = self._clock.monotonic_ns()
        first_stamp_ns: int | None = None
        for line in lines:
            frame = line.frame
            if frame is None:
                print(f"companion publish: {line.problem}", file=sys.stderr)
                self.bad += 1
                continue
            first_stamp_ns = frame.stamp_ns if first_stamp_ns is None else first_stamp_ns
            due_ns = round(self.sent * NS_PER_S / rate_hz) if rate_hz else frame.stamp_ns - first_stamp_ns
            self._sleep((start_ns + due_ns - self._clock.monotonic_ns()) / NS_PER_S)
            if not keep_stamps:
                frame = msgspec.structs.replace(frame, stamp_ns=self._clock.unix_ns(), clock="unix")
            self._publisher.put(wire.encode(frame))
            self.sent += 1
        return self.bad

    def _sleep(self, seconds: float) -> None:
        if seconds > 0.0:
            self._runner.run(self._clock.sleep(seconds))


def parse_motion(kind: str, spec: str) -> Motion:
    """The path named ``kind`` ("orbit", "line", "eight") from ``key=value`` pairs [m], [m/s].

    orbit: a circle in the horizontal plane; line: to and fro; eight: (s sin wt, s/2 sin 2wt), fastest at its centre.

    >>> parse_motion("orbit", "center=1,2,1.5 radius=2 speed=1.5")(0.0)
    (3.0, 2.0, 1.5)

    Raises:
        ConfigError: naming the option and the expectation.
    """
    expected = f'--{kind} "{spec}": expected "{_EXAMPLES[kind]}"'
    wanted = {pair.split("=")[0]: "," in pair for pair in _EXAMPLES[kind].split()}
    values: dict[str, tuple[float, ...]] = {}
    for pair in spec.split():
        name, _, text = pair.partition("=")
        try:
            values[name] = tuple(float(part) for part in text.split(","))
        except ValueError:
            raise ConfigError(f"{expected}, got {pair}") from None
        finite = all(math.isfinite(value) for value in values[name])
        if name not in wanted or not finite or len(values[name]) != (3 if wanted[name] else 1):
            raise ConfigError(f"{expected}, got {pair}")
        if not wanted[name] and values[name][0] <= 0.0:
            raise ConfigError(f"{expected}, {name} above 0, got {pair}")
    if missing := wanted.keys() - values.keys():
        raise ConfigError(f"{expected}, {', '.join(sorted(missing))} is missing")
    return _motion(kind, values)


def _motion(kind: str, values: dict[str, tuple[float, ...]]) -> Motion:
    (speed,) = values["speed"]
    if kind == "line":
        start, end = values["start"], values["end"]
        length = math.dist(start, end)

        def along(t: float) -> wire.Vec:
            way = (speed * t / length) % 2.0 if length else 0.0
            share = min(way, 2.0 - way)
            x, y, z = (a + share * (b - a) for a, b in zip(start, end, strict=True))
            return x, y, z

        return along
    x, y, z = values["center"]
    if kind == "orbit":
        (r,) = values["radius"]
        return lambda t: (x + r * math.cos(speed / r * t), y + r * math.sin(speed / r * t), z)
    (s,) = values["size"]
    w = speed / (math.sqrt(2.0) * s)  # |v| at the centre is sqrt(2) s w
    return lambda t: (x + s * math.sin(w * t), y + 0.5 * s * math.sin(2.0 * w * t), z)


def _check_options(args: argparse.Namespace) -> None:
    for option in ("rate", "size", "std", "duration"):
        value = getattr(args, option)
        if value is not None and not (math.isfinite(value) and value > 0.0):
            raise ConfigError(f"--{option} {value}: expected a number above 0")
    for option, name in (("--name", args.name), ("--key-source", args.key_source)):
        if not name or any(character in name for character in "/*$?#"):
            raise ConfigError(f"{option} {name}: expected one chunk of a Zenoh key, without / * $ ? #")


def _lines(args: argparse.Namespace, stack: ExitStack) -> Iterator[_Line]:
    """The frames to send; sets the rate that the kind of source implies. A file is closed by ``stack``."""
    if args.source == "-":
        args.rate = args.rate or math.inf  # standard input sets its own pace
        return _parsed(sys.stdin.buffer, "<stdin>")
    if args.source is not None:
        try:
            file = stack.enter_context(Path(args.source).open("rb"))  # noqa: SIM115 - the stack closes it
        except OSError as error:
            raise ConfigError(f"--from {args.source}: cannot be read ({error.strerror}), expected JSON lines") from None
        return _parsed(file, args.source)
    kind = next(kind for kind in _EXAMPLES if getattr(args, kind) is not None)
    args.rate = args.rate or _DEFAULT_RATE_HZ
    return _made_up(parse_motion(kind, getattr(args, kind)), args)


def _parsed(lines: Iterable[bytes], name: str) -> Iterator[_Line]:
    for number, text in enumerate(lines, start=1):
        if not text.strip():
            continue
        try:
            frame = wire.decode(text, wire.ObstacleFrame, wire.JSON)
            ingress.detections_from_frame(
                frame, source="file", sequence=0, now_ns=frame.stamp_ns, unix_minus_vehicle_ns=0, max_age_s=1.0
            )
        except FrameRejected as error:
            yield _Line(None, f"{name}:{number}: {error}")
        else:
            yield _Line(frame)


def _made_up(motion: Motion, args: argparse.Namespace) -> Iterator[_Line]:
    frames = math.inf if args.duration is None else args.duration * args.rate
    number = 0
    while number < frames:
        obstacle = wire.Obstacle(
            id=args.key_source[:64], position=motion(number / args.rate), radius=args.size, position_std=args.std
        )
        stamp_ns = round(number * NS_PER_S / args.rate)
        yield _Line(wire.ObstacleFrame(stamp_ns=stamp_ns, clock="unix", obstacles=[obstacle]))
        number += 1
