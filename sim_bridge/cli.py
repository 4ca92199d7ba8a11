"""`sim-bridge`: fly a scenario behind MAVLink and Zenoh, or print one as it will be flown."""

from __future__ import annotations

import argparse
import json
import math
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType, TracebackType
from typing import IO, Any

from sim_bridge import bench, render
from sim_bridge.check import check
from sim_bridge.errors import ScenarioError, SimError
from sim_bridge.flight import Flight
from sim_bridge.links import Address
from sim_bridge.lockstep_runner import Lockstep
from sim_bridge.messages import NS_PER_S
from sim_bridge.placement import Resolved, describe, resolve
from sim_bridge.runner import RealTime, Trace
from sim_bridge.scenario import load_scenario
from sim_bridge.scenario_schema import scenario_schema
from sim_bridge.wires import Wires

DONE, FAILED, USAGE = 0, 1, 2
_NO_ZENOH = "none"


def main(argv: Sequence[str] | None = None) -> int:
    """Exit status: 0 done, 1 the flight failed, 2 wrong usage or configuration."""
    arguments = _parser().parse_args(argv)
    try:
        status: int = arguments.run(arguments)
    except ScenarioError as error:
        print(f"sim-bridge: {error}", file=sys.stderr)
        return USAGE
    except SimError as error:
        print(f"sim-bridge: {error}", file=sys.stderr)
        return FAILED
    return status


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sim-bridge",
        description="A PyBullet Crazyflie behind a PX4-style MAVLink autopilot, among moving obstacles.",
        epilog="example: sim-bridge run --scenario demo --seed 1 --json",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    run = commands.add_parser(
        "run", help="fly a scenario", epilog="example: sim-bridge run --scenario linear --lockstep --trace flight.jsonl"
    )
    _add_scenario(run)
    run.add_argument("--lockstep", action="store_true", help="wait for the companion at each tick, not for the clock")
    run.add_argument(
        "--speed",
        type=_speed,
        default=1.0,
        metavar="F",
        help="vehicle time over wall time, 0.01 to 100 (default 1); what the machine cannot keep is late_s",
    )
    run.add_argument("--stay", action="store_true", help="fly on after the end of the flight, until a signal")
    run.add_argument("--must-reach", action="store_true", help="exit status 1 if the target has not been reached")
    run.add_argument("--onboard-port", type=_port, default=14540, help="UDP port of the companion (default 14540)")
    run.add_argument("--gcs-port", type=_port, default=14550, help="UDP port of the ground station (default 14550)")
    for link, example in (("onboard", 14580), ("gcs", 18570)):
        run.add_argument(
            f"--{link}-bind",
            type=_address,
            metavar="HOST:PORT",
            help="own address of that link, to which others may speak first, as with PX4 SITL: "
            f"0.0.0.0:{example} from other hosts too (default: the loopback, any port)",
        )
    bus = run.add_mutually_exclusive_group()
    bus.add_argument(
        "--zenoh-listen",
        default="tcp/127.0.0.1:7447",
        metavar="ENDPOINT",
        help="where Zenoh listens (default tcp/127.0.0.1:7447), or none",
    )
    bus.add_argument("--zenoh-connect", metavar="ENDPOINT", help="the Zenoh router to be a client of, instead")
    run.add_argument(
        "--check", action="store_true", help="fly with a daemon for each vehicle; which of the expectations failed?"
    )
    run.add_argument("--real-time", action="store_true", help="with --check: at the pace of the clock, not in lockstep")
    run.add_argument("--logs", type=Path, metavar="FOLDER", help="with --check: keep what the daemons log here")
    run.add_argument("--trace", type=Path, metavar="FILE", help="write true positions as JSON lines")
    run.set_defaults(run=_run)
    show = commands.add_parser(
        "scenario",
        help="print a scenario as it will be flown",
        epilog="example: sim-bridge scenario demo --seed 1 --json",
    )
    _add_scenario(show, positional=True)
    show.set_defaults(run=_show)
    bench.add_parser(commands)
    render.add_parser(commands)
    schema = commands.add_parser("schema", help="print the JSON Schema of scenario files")
    schema.set_defaults(run=_schema)
    return parser


def _add_scenario(parser: argparse.ArgumentParser, *, positional: bool = False) -> None:
    if positional:
        parser.add_argument("scenario", help="a shipped scenario's name, or a TOML file")
    else:
        parser.add_argument("--scenario", default="demo", help="a shipped scenario, or a TOML file (default demo)")
    parser.add_argument("--seed", type=_seed, default=0, help="fixes every draw (default 0)")
    parser.add_argument("--no-obstacles", action="store_true", help="leave the obstacles out")
    parser.add_argument("--name", help="name of the one vehicle, Zenoh prefix uav/NAME (default: the scenario's)")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")


def _port(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 65535:
        raise argparse.ArgumentTypeError(f"expected a port, 1 to 65535, got {text}")
    return int(text)


def _address(text: str) -> Address:
    host, _, port = text.rpartition(":")
    if not host:
        raise argparse.ArgumentTypeError(f"expected HOST:PORT, got {text}")
    return host, _port(port)


def _speed(text: str) -> float:
    try:
        speed = float(text)
    except ValueError:
        speed = math.nan
    if not 0.01 <= speed <= 100.0:
        raise argparse.ArgumentTypeError(f"expected a factor, 0.01 to 100, got {text}")
    return speed


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"expected a whole number, 0 or above, got {text}")
    return int(text)


def _resolved(arguments: argparse.Namespace) -> Resolved:
    name, scenario = load_scenario(arguments.scenario)
    if arguments.name is not None and len(scenario.fleet) > 1:
        raise ScenarioError(f"--name {arguments.name}: expected none, {name} has {len(scenario.fleet)} vehicles")
    return resolve(name, scenario, arguments.seed, obstacles=not arguments.no_obstacles)


def _show(arguments: argparse.Namespace) -> int:
    described = describe(_resolved(arguments), arguments.name)
    print(json.dumps(described, indent=None if arguments.json else 2))
    return DONE


def _schema(arguments: argparse.Namespace) -> int:
    print(json.dumps(scenario_schema(), indent=2))
    return DONE


def _run(arguments: argparse.Namespace) -> int:
    if arguments.check:
        return _check(arguments)
    for option in ("real_time", "logs"):
        if getattr(arguments, option):
            raise ScenarioError(f"--{option.replace('_', '-')}: expected --check with it")
    resolved = _resolved(arguments)
    endpoint = arguments.zenoh_connect or (None if arguments.zenoh_listen == _NO_ZENOH else arguments.zenoh_listen)
    if arguments.lockstep and endpoint is None:
        raise ScenarioError("--zenoh-listen none: expected an endpoint with --lockstep")
    if arguments.lockstep and arguments.speed != 1.0:
        raise ScenarioError("--speed: expected none with --lockstep, which runs as fast as it can")
    if arguments.onboard_port == arguments.gcs_port:
        raise ScenarioError(f"--gcs-port {arguments.gcs_port}: expected another port than --onboard-port")
    with ExitStack() as stack:
        trace = Trace(stack.enter_context(_opened(arguments.trace)))
        wires = Wires(
            resolved,
            onboard_port=arguments.onboard_port,
            ground_port=arguments.gcs_port,
            endpoint=endpoint,
            prefix=None if arguments.name is None else f"uav/{arguments.name}",
            lockstep=arguments.lockstep,
            onboard_bind=arguments.onboard_bind,
            ground_bind=arguments.gcs_bind,
            connect=arguments.zenoh_connect is not None,
        )
        stack.callback(wires.close)
        flight = Flight(resolved)
        stack.callback(flight.close)
        runner: Lockstep | RealTime
        if arguments.lockstep:
            runner = Lockstep(flight, wires, trace=trace, progress=_progress(), stay=arguments.stay)
        else:
            runner = RealTime(
                flight, wires, trace=trace, progress=_progress(), stay=arguments.stay, speed=arguments.speed
            )
        with _StoppedBySignals() as stop:
            stop.listen(runner.stop)
            summary = runner.run()
    _report(summary, as_json=arguments.json)
    missed = arguments.must_reach and not summary["reached"]
    return FAILED if summary["collided"] or summary["ended"] == "timeout" or missed else DONE


def _check(arguments: argparse.Namespace) -> int:
    for option in ("lockstep", "stay", "name"):
        if getattr(arguments, option):
            raise ScenarioError(f"--{option}: expected none with --check, which flies in lockstep unless --real-time")
    name, scenario = load_scenario(arguments.scenario)
    with ExitStack() as stack:
        folder: Path = arguments.logs or Path(stack.enter_context(TemporaryDirectory(prefix="sim-bridge-check-")))
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ScenarioError(f"--logs {folder}: cannot be made ({error.strerror})") from None
        stop = stack.enter_context(_StoppedBySignals())  # from the first daemon on: none may outlive this process
        result = check(
            name,
            scenario,
            arguments.seed,
            folder=folder,
            lockstep=not arguments.real_time,
            trace=stack.enter_context(_opened(arguments.trace)),
            progress=_progress(),
            log_flight=arguments.logs is not None,
            obstacles=not arguments.no_obstacles,
            on_stop=stop.listen,
        )
    if sys.stderr.isatty():
        print(file=sys.stderr)
    if arguments.json:
        print(json.dumps(result.report()))
    else:
        for finding in result.findings:
            print(finding.line())
        met = sum(finding.met for finding in result.findings)
        print(f"{name}, seed {arguments.seed}: {met} of {len(result.findings)} expectations met")
    return DONE if result.passed else FAILED


@contextmanager
def _opened(path: Path | None) -> Iterator[IO[bytes] | None]:
    if path is None:
        yield None
        return
    try:
        file = path.open("wb")
    except OSError as error:
        raise ScenarioError(f"--trace {path}: cannot be written ({error.strerror})") from None
    with file:
        yield file


class _StoppedBySignals:
    """SIGINT and SIGTERM end the run instead of the process; the coming run, where there is none yet."""

    def __init__(self) -> None:
        self._stop: Callable[[], None] | None = None
        self._asked = False

    def listen(self, stop: Callable[[], None]) -> None:
        """``stop`` ends the run; at once if it was asked for."""
        self._stop = stop
        if self._asked:
            stop()

    def __enter__(self) -> _StoppedBySignals:
        self._before = {number: signal.signal(number, self._on_signal) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._asked = True
        if self._stop is not None:
            self._stop()


def _progress() -> Callable[[Flight], None]:
    """One line that is rewritten, on a terminal; twice a second of vehicle time."""
    if not sys.stderr.isatty():
        return lambda flight: None

    def show(flight: Flight) -> None:
        if flight.t_ns % (NS_PER_S // 2):
            return
        line = flight.trace_line()
        clearance_m = line["clearance_m"]
        nearest = "" if clearance_m is None else f"  nearest obstacle {clearance_m:5.2f} m"
        x, y, z = line["position"]
        text = f"{flight.t_ns / NS_PER_S:7.1f} s  {line['mode']:8s} ({x:6.2f} {y:6.2f} {z:6.2f}) m{nearest}"
        print(f"\r{text}\033[K", end="", file=sys.stderr, flush=True)

    return show


def _report(summary: dict[str, Any], *, as_json: bool) -> None:
    if sys.stderr.isatty():
        print(file=sys.stderr)
    if as_json:
        print(json.dumps(summary))
        return
    for key, value in summary.items():
        print(f"{key:18s} {json.dumps(value)}")


if __name__ == "__main__":
    sys.exit(main())
