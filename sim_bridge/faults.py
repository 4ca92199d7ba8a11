"""The scenario's faults, started and ended on their time.

A fault counts from its vehicle's entry into external control, or from a tick; one without ``vehicle`` hits each
vehicle, each from its own entry. Everything here happens at the beginning of a control period, before the vehicle's
messages leave, so that a flight in lockstep is the same for the same seed.

What a daemon is waited for: see `Companion`. A link's faults stand in both directions, each with a generator of its
own; commands, parameters and heartbeats are messages like any other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol, TypeVar

import numpy as np

from sim_bridge.craft import Craft
from sim_bridge.errors import ScenarioError
from sim_bridge.flight import Flight
from sim_bridge.impairments import Channel, Impairment, damage_message
from sim_bridge.messages import FORCE, NS_PER_S, Cmd, Command, Reply, Sender
from sim_bridge.pilot import Pilot, switch_command
from sim_bridge.scenario_faults import LINKS, Fault
from sim_bridge.station import Station
from sim_bridge.wires import CraftWires, Feed, damage_frame

T = TypeVar("T")

_FOREVER_S = 1e6
_FAULT_DRAWS = 2  # what these generators are for, beside the obstacles' jitter (0) and the sensors (1)


class Process(Protocol):
    """A daemon that the check has started."""

    def freeze(self) -> None:
        """SIGSTOP."""

    def thaw(self) -> None:
        """SIGCONT."""

    def kill(self) -> None:
        """SIGKILL."""

    def check_alive(self) -> None:
        """Raise SimError where it has ended by itself."""


@dataclass(slots=True)
class Companion:
    """What faults have made of one vehicle's daemon: lockstep does not wait for one that is frozen or dead."""

    process: Process | None = None
    frozen: bool = False
    dead: bool = False

    @property
    def answers(self) -> bool:
        return not (self.frozen or self.dead)


@dataclass(slots=True)
class Hit:
    """One fault on one vehicle."""

    index: int  # in the file
    fault: Fault
    craft: int
    started_ns: int | None = None
    ended_ns: int | None = None
    undo: list[Callable[[], None]] = field(default_factory=list)

    def due(self, t_ns: int, entered_ns: int | None, period_ns: int) -> bool:
        """Whether it starts by ``t_ns``, on a vehicle that entered external control at ``entered_ns``."""
        fault = self.fault
        if fault.at_tick is not None:
            return t_ns >= fault.at_tick * period_ns
        assert fault.at_s is not None, "checked when the scenario was parsed"
        return entered_ns is not None and t_ns >= entered_ns + round(fault.at_s * NS_PER_S)

    def over(self, t_ns: int) -> bool:
        """Whether its time is up by ``t_ns``."""
        for_s = self.fault.for_s
        return for_s is not None and self.started_ns is not None and t_ns >= self.started_ns + round(for_s * NS_PER_S)


class Faults:
    """All faults of one flight.

    Args:
        processes: the daemons by vehicle name, where this process has started them.
    Raises:
        ScenarioError: a fault on a daemon that nobody here has started.
    """

    def __init__(
        self,
        flight: Flight,
        wires: Sequence[CraftWires],
        stations: Sequence[Station],
        processes: Mapping[str, Process] | None = None,
    ) -> None:
        self._flight = flight
        self._wires = wires
        self._stations = stations
        started = processes or {}
        self.companions = tuple(Companion(started.get(craft.vehicle.name)) for craft in wires)
        self._processes = tuple(started.values())
        self.hits = tuple(self._planned())
        self._pilots: dict[int, Pilot] = {}
        for hit in self.hits:
            self._check(hit)
            self._open_channels(hit)

    def touches_onboard(self, craft: int) -> bool:
        """Whether messages to this vehicle's daemon may not arrive as they left, at some time of the flight."""
        return any(
            hit.craft == craft and (hit.fault.on == "onboard" or hit.fault.what in ("freeze", "clock_jump"))
            for hit in self.hits
        )

    def check_daemons(self) -> None:
        """Raise SimError where a daemon that this process has started has ended by itself."""
        for process in self._processes:
            process.check_alive()

    def step(self) -> None:
        """Start and end what is due now; once at the beginning of every control period."""
        t_ns = self._flight.t_ns
        for hit in self.hits:
            if hit.started_ns is None and hit.due(t_ns, self._entered_ns(hit), self._flight.resolved.period_ns):
                hit.started_ns = t_ns
                self._start(hit)
            if hit.started_ns is not None and hit.ended_ns is None and hit.over(t_ns):
                hit.ended_ns = t_ns
                for undo in hit.undo:
                    undo()
        for craft, pilot in self._pilots.items():
            self._say(craft, pilot.step(t_ns))

    # --- the plan

    def _planned(self) -> Iterable[Hit]:
        for index, fault in enumerate(self._flight.resolved.scenario.faults):
            if fault.on == "world":
                yield Hit(index, fault, 0)
                continue
            for craft, wires in enumerate(self._wires):
                if fault.vehicle in (None, wires.vehicle.name):
                    yield Hit(index, fault, craft)

    def _check(self, hit: Hit) -> None:
        if hit.fault.on == "daemon" and self.companions[hit.craft].process is None:
            raise ScenarioError(f"faults[{hit.index}]: expected --check, which starts the daemon, for {hit.fault.what}")
        if hit.fault.what == "rc":
            switch_command(self._flight.crafts[hit.craft], _mode_of(hit.fault))  # raises for a mode that is none

    def _open_channels(self, hit: Hit) -> None:
        """Channels stand for the whole flight, so that how messages leave does not change when a fault begins."""

        def clock() -> int:
            return self._flight.t_ns

        wires, fault = self._wires[hit.craft], hit.fault
        if fault.on in LINKS:
            link = wires.router.onboard if fault.on == "onboard" else wires.router.ground
            link.outbound = link.outbound or Channel(clock)
            link.inbound = link.inbound or Channel(clock)
        for feed in self._feeds(hit):
            feed.channel = feed.channel or Channel(clock)

    def _feeds(self, hit: Hit) -> list[Feed]:
        return [feed for feed in self._wires[hit.craft].feeds if hit.fault.on in ("obstacles", feed.source)]

    def _entered_ns(self, hit: Hit) -> int | None:
        """When the vehicle entered external control; for the world, when the first did."""
        crafts = self._flight.crafts if hit.fault.on == "world" else (self._flight.crafts[hit.craft],)
        return min((craft.judge.start_ns for craft in crafts if craft.judge is not None), default=None)

    # --- what starts

    def _start(self, hit: Hit) -> None:
        fault = hit.fault
        if fault.on == "daemon":
            self._hit_daemon(hit)
        elif fault.on in LINKS:
            self._hit_link(hit)
        elif fault.on == "autopilot":
            self._hit_autopilot(hit)
        elif fault.on == "world":
            self._hit_world(hit)
        else:
            self._hit_sources(hit)

    def _hit_daemon(self, hit: Hit) -> None:
        companion = self.companions[hit.craft]
        assert companion.process is not None, "checked when the flight began"
        if companion.dead:
            return
        if hit.fault.what == "kill":
            companion.dead = True
            companion.process.kill()
            return
        companion.frozen = True
        companion.process.freeze()
        hit.undo.append(lambda: self._thaw(companion))

    @staticmethod
    def _thaw(companion: Companion) -> None:
        companion.frozen = False
        if companion.process is not None and not companion.dead:
            companion.process.thaw()

    def _hit_link(self, hit: Hit) -> None:
        wires = self._wires[hit.craft]
        link = wires.router.onboard if hit.fault.on == "onboard" else wires.router.ground
        for way, channel in enumerate((link.outbound, link.inbound)):
            assert channel is not None, "opened when the flight began"
            self._impair(hit, channel, way, damage_message)

    def _hit_sources(self, hit: Hit) -> None:
        for way, feed in enumerate(self._feeds(hit)):
            if hit.fault.what == "clock_jump":
                _shift(feed, _value_ns(hit.fault))
                hit.undo.append(partial(_shift, feed, -_value_ns(hit.fault)))
                continue
            assert feed.channel is not None, "opened when the flight began"
            self._impair(hit, feed.channel, way, damage_frame)

    def _impair(
        self,
        hit: Hit,
        channel: Channel[T],
        way: int,
        damage: Callable[[T, np.random.Generator], T],
    ) -> None:
        fault = hit.fault
        timed_rng, wall_rng = (
            np.random.default_rng([self._flight.resolved.seed, _FAULT_DRAWS, hit.index, hit.craft, way, timed])
            for timed in (1, 0)
        )
        impairment = Impairment(
            fault.what,
            share=fault.share,
            delay_ns=_value_ns(fault),
            rng=timed_rng,
            wall_rng=wall_rng,
            damage=damage,
        )
        channel.impairments.append(impairment)
        hit.undo.append(lambda: channel.remove(impairment))

    def _hit_autopilot(self, hit: Hit) -> None:
        what = hit.fault.what
        if what == "kill":
            craft = self._flight.crafts[hit.craft]
            stop = Command(Cmd.COMPONENT_ARM_DISARM, (0.0, FORCE, 0, 0, 0, 0, 0), Sender(craft.system_id, 1))
            replies = craft.autopilot.command(stop, craft.state, self._flight.t_ns)
            self._say(hit.craft, replies)
        elif what == "clock_jump":
            self._jump_clock(hit)
            hit.undo.append(lambda: self._jump_clock(hit, back=True))
        elif what == "rc":
            self._take_over(hit)
        else:
            self._hit_sensors(hit, self._flight.crafts[hit.craft])

    def _take_over(self, hit: Hit) -> None:
        pilot = self._pilots.setdefault(hit.craft, Pilot(self._flight.crafts[hit.craft]))
        self._say(hit.craft, pilot.take_over(_mode_of(hit.fault), self._flight.t_ns))
        hit.undo.append(pilot.let_go)

    def _hit_sensors(self, hit: Hit, craft: Craft) -> None:
        """What the autopilot measures: its battery, its position."""
        value = hit.fault.value
        if hit.fault.what == "battery" and isinstance(value, float):
            craft.set_charge(value)

    def _hit_world(self, hit: Hit) -> None:
        world, value = self._flight.world, hit.fault.value
        if isinstance(value, tuple):
            world.gust(value, _FOREVER_S if hit.fault.for_s is None else hit.fault.for_s)

    # --- clocks

    def _jump_clock(self, hit: Hit, back: bool = False) -> None:
        """The vehicle's clock goes on from elsewhere; before 0 it does not go: then it has started anew."""
        station, t_ns = self._stations[hit.craft], self._flight.t_ns
        now_ns = max(0, t_ns + station.clock_offset_ns)
        station.clock_offset_ns = max(0, now_ns + _value_ns(hit.fault) * (-1 if back else 1)) - t_ns

    def _say(self, craft: int, replies: tuple[Reply, ...]) -> None:
        station = self._stations[craft]
        station.say(replies)
        station.announce()


def _value_ns(fault: Fault) -> int:
    return round(fault.value * NS_PER_S) if isinstance(fault.value, float) else 0


def _mode_of(fault: Fault) -> str | None:
    return fault.value if isinstance(fault.value, str) else None


def _shift(feed: Feed, by_ns: int) -> None:
    feed.offset_ns += by_ns
