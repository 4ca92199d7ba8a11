"""The whole tick in flight: the real daemon beside the real simulator, each a process, at the pace of the clock.

A tick begins when the vehicle's state has been read off the socket; its setpoint has left at ``sent``, and all of its
work (records, log, hash) is over at ``done``. A deadline is missed by a tick that is done later than a period after
it began, and by a state that a newer one overtook. The log is written and every key has a subscriber, as in a flight
that is watched.
"""

from __future__ import annotations

import contextlib
import json
import socket
import tempfile
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import zenoh
from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.bench.processes import (
    Child,
    Links,
    daemon_settings,
    memory_mib,
    open_zenoh,
    scenario_text,
    simulator_words,
)
from companion.bench.tick_daemon import Pauses, TickNotes
from companion.bench.timing import Quantiles, quantiles
from companion.clock import SystemClock
from companion.errors import CompanionError
from companion.types import NS_PER_S

WARM_S = 2.0  # of flight that do not count
ACTIVE_S = 30.0  # for both processes to come up and the vehicle to be flown
ENGAGE_NS = 5 * NS_PER_S  # between two attempts
_POLL_S = 0.2
_ENGAGE, _COMPANION = 92, 196

Progress = Callable[[float], None]  # seconds flown


@dataclass(frozen=True, slots=True)
class TickRun:
    """One flight. Times in ms."""

    rate_hz: int
    obstacles: int
    seconds: float
    ticks: int
    to_setpoint: Quantiles  # state received to setpoint sent
    to_end: Quantiles  # state received to the end of the tick's work
    processor: Quantiles  # of the loop's thread in a tick: what others on the machine cost does not count
    interval_jitter: Quantiles  # |time between two setpoints - period|
    state_jitter: Quantiles  # the same of the states as they came: what the setpoints inherit
    misses: int  # ticks that outlasted their period, and states overtaken
    overtaken: int  # of the misses: a newer state came before this one was answered
    pauses: Pauses
    memory_mib: float
    threads: int
    verdicts: dict[str, int]
    simulator: dict[str, Any]  # collided, late_s: what the machine could not keep up with


def fly(rate_hz: int, obstacles: int, seconds: float, progress: Progress, *, settings: tuple[str, ...] = ()) -> TickRun:
    """Fly for ``seconds`` of wall time among ``obstacles``.

    Args:
        settings: of the daemon, each KEY=VALUE, on top.
    Raises:
        ConfigError: the simulator is not installed, or no physics fits the rate.
        CompanionError: a process ended or was not flown in time.
    """
    links, clock = Links.free(), SystemClock()
    with tempfile.TemporaryDirectory(prefix="companion-bench-") as name:
        folder = Path(name)
        scenario, config = folder / "tick.toml", folder / "daemon.toml"
        scenario.write_text(scenario_text(rate_hz, obstacles, None), encoding="utf-8")
        config.write_text("# everything at its default\n", encoding="utf-8")
        tied = (*daemon_settings(links, rate_hz, folder, lockstep=False), *settings)
        with (
            Child(simulator_words(links, scenario, "--stay"), folder / "sim.log") as simulator,
            Child(["companion.bench.tick_daemon", str(config), *tied], folder / "daemon.log") as daemon,
            watched(links.daemon) as states,
            contextlib.closing(Ground(links.ground)) as ground,
        ):
            await_active(ground, states, (simulator, daemon), clock)
            began_ns = clock.monotonic_ns()
            while (flown_s := (clock.monotonic_ns() - began_ns) / NS_PER_S) < WARM_S + seconds:
                states.wait(_POLL_S)
                ground.listen()
                simulator.check()
                daemon.check()
                progress(max(0.0, flown_s - WARM_S))
            memory = memory_mib(daemon.process.pid)["resident"]
            notes = msgspec.json.decode(daemon.stop(), type=TickNotes)
            outcome = json.loads(simulator.stop().splitlines()[-1])
    told = {key: outcome.get(key) for key in ("collided", "late_s")}
    return evaluate(notes, rate_hz, obstacles, seconds, memory=memory, simulator=told)


def evaluate(
    notes: TickNotes, rate_hz: int, obstacles: int, seconds: float, *, memory: float, simulator: dict[str, Any]
) -> TickRun:
    """The figures of a flight: of the ticks between its first ``WARM_S`` and ``seconds`` later.

    Raises:
        CompanionError: it holds fewer than two such ticks.
    """
    period_ns = NS_PER_S // rate_hz
    begin_ns = (notes.ticks[0].arrived_ns if notes.ticks else 0) + round(WARM_S * NS_PER_S)
    end_ns = begin_ns + round(seconds * NS_PER_S)
    counted = [tick for tick in notes.ticks if begin_ns <= tick.arrived_ns < end_ns]
    ticks = np.array([(tick.arrived_ns, tick.sent_ns, tick.done_ns, tick.processor_ns) for tick in counted])
    if len(ticks) < 2:
        raise CompanionError(f"bench tick: the daemon flew {len(ticks)} ticks at {rate_hz} Hz, expected more")
    arrived, sent, done, processor = ticks.T
    overtaken = sum(begin_ns <= t < end_ns for t in notes.skipped)
    return TickRun(
        rate_hz=rate_hz,
        obstacles=obstacles,
        seconds=seconds,
        ticks=len(ticks),
        to_setpoint=quantiles((sent - arrived).tolist()),
        to_end=quantiles((done - arrived).tolist()),
        processor=quantiles(processor.tolist()),
        interval_jitter=quantiles(np.abs(np.diff(sent) - period_ns).tolist()),
        state_jitter=quantiles(np.abs(np.diff(arrived) - period_ns).tolist()),
        misses=int(np.count_nonzero(done - arrived > period_ns)) + overtaken,
        overtaken=overtaken,
        pauses=notes.pauses,
        memory_mib=memory,
        threads=notes.threads,
        verdicts=notes.verdicts,
        simulator=simulator,
    )


class States:
    """The daemon's state as it publishes it, and a subscriber of everything else."""

    def __init__(self, session: zenoh.Session) -> None:
        self.newest = ""
        self._came = threading.Event()
        self._all = session.declare_subscriber("uav/uav1/companion/*", self._on_sample)

    def _on_sample(self, sample: zenoh.Sample) -> None:
        if str(sample.key_expr).endswith("/status"):
            self.newest = json.loads(sample.payload.to_bytes())["state"]
            self._came.set()

    def wait(self, seconds: float) -> None:
        """For ``seconds``, or less where the state is told."""
        self._came.wait(seconds)
        self._came.clear()


@contextlib.contextmanager
def watched(endpoint: str) -> Iterator[States]:
    """The states of the daemon that listens on ``endpoint``."""
    with open_zenoh(endpoint) as session:
        yield States(session)


class Ground:
    """A ground station that can engage; the simulator sends to its port."""

    def __init__(self, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", port))
        self._socket.setblocking(False)
        self._peer: tuple[str, int] | None = None
        self._codec = dialect.MAVLink(None, 245, 190)

    def close(self) -> None:
        self._socket.close()

    def listen(self) -> None:
        """Throw away what has come; whom to answer is remembered."""
        with contextlib.suppress(BlockingIOError):
            while True:
                _, self._peer = self._socket.recvfrom(4096)

    def engage(self) -> bool:
        """MAV_CMD_NAV_GUIDED_ENABLE to component 196; whether it could be sent."""
        self.listen()
        if self._peer is not None:
            message = dialect.MAVLink_command_long_message(1, _COMPANION, _ENGAGE, 0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            self._socket.sendto(message.pack(self._codec), self._peer)
        return self._peer is not None


def await_active(ground: Ground, states: States, children: tuple[Child, ...], clock: SystemClock) -> None:
    """Engage as a ground station does, again and again, until the daemon flies.

    Raises:
        CompanionError: it did not within ``ACTIVE_S``, or a process ended.
    """
    began_ns, engaged_ns = clock.monotonic_ns(), -ENGAGE_NS
    while states.newest != "ACTIVE":
        for child in children:
            child.check()
        now_ns = clock.monotonic_ns()
        if now_ns - began_ns > ACTIVE_S * NS_PER_S:
            raise children[-1].failed(f"was not flying after {ACTIVE_S:g} s (state {states.newest or 'unknown'})")
        if states.newest == "READY" and now_ns - engaged_ns >= ENGAGE_NS:  # each one begins the daemon's stream anew
            engaged_ns = now_ns if ground.engage() else engaged_ns
        states.wait(_POLL_S)
