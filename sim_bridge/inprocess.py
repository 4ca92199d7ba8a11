"""Fly a scenario in this process, without wires: any law that answers a tick's state and frames with an acceleration.

What `sim-bridge bench` times. The vehicle is armed in the air (`start` above the ground), streams, enters offboard and
flies what the law answers, tick by tick.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import pybullet

from sim_bridge import body, physics
from sim_bridge.flight import Flight
from sim_bridge.messages import NS_PER_S, Cmd, Command, LocalSetpoint, Sender, Vec3
from sim_bridge.placement import Resolved
from sim_bridge.sections import Case, Sections, case
from sim_bridge.sensors import Frame

LEAD_TICKS = 12  # of stream before offboard is asked for, half a second and a little at 20 Hz
_MASK = 0x0C3F  # acceleration only
_COMPANION = Sender(1, 196)

Law = Callable[[Flight, Sequence[Frame]], Vec3]  # net acceleration, ENU [m/s^2]


def fly(flight: Flight, law: Law, seconds: float) -> list[int]:
    """Wall time of each control tick [ns], from offboard on, for ``seconds`` of vehicle time."""
    ticks_ns: list[int] = []
    lead, flown = LEAD_TICKS, round(seconds * flight.resolved.scenario.control_hz)
    for number in range(lead + flown):
        began_ns = time.perf_counter_ns()
        tick(flight, law)
        if number == lead - 1:
            _enter_offboard(flight)
        elif number >= lead:
            ticks_ns.append(time.perf_counter_ns() - began_ns)
    return ticks_ns


def tick(flight: Flight, law: Law) -> None:
    """One control period: frames, the law's answer, the autopilot, its physics steps."""
    t_ns = flight.t_ns
    craft = flight.crafts[0]
    frames = [frame for source in craft.sensors for frame in craft.frames(source, t_ns)]
    setpoint = LocalSetpoint(
        time_boot_ms=t_ns // 1_000_000,
        frame=1,
        type_mask=_MASK,
        p_enu=(0.0, 0.0, 0.0),
        v_enu=(0.0, 0.0, 0.0),
        a_enu=law(flight, frames),
        yaw_rad=0.0,
        yaw_rate_rad_s=0.0,
        sender=_COMPANION,
    )
    craft.autopilot.setpoint(setpoint, t_ns)
    flight.control()
    for _ in range(flight.resolved.control_steps):
        flight.advance()


def measure(
    name: str,
    resolved: Resolved,
    make_law: Callable[[], Law],
    seconds: float,
    *,
    demand: float,
    claim: Callable[[Sections, Law], Law] = lambda sections, law: sections.timed("law", law),
    acting: Callable[[Law], float] | None = None,
) -> Case:
    """The case of ``seconds`` of vehicle time, and a second flight for where the time goes.

    Args:
        claim: wraps the law for that second flight.
        acting: the share of its ticks in which a law's filter acted.
    """
    flight = Flight(resolved)
    flown = make_law()
    fly(flight, flown, 1.0)  # warm
    ticks_ns = fly(flight, flown, seconds)
    flight.close()
    sections = Sections()
    with sectioned(sections, resolved) as flight:
        law = claim(sections, make_law())
        fly(flight, law, 1.0)
        sections.start()
        spent = sections.ms_per(len(fly(flight, law, min(seconds, 10.0))) + LEAD_TICKS)
    factor = len(ticks_ns) / resolved.scenario.control_hz * NS_PER_S / sum(ticks_ns)
    acted = None if acting is None else acting(flown)
    return case(name, ticks_ns, factor, demand=demand, sections=spent, acting=acted)


@contextmanager
def sectioned(sections: Sections, resolved: Resolved) -> Iterator[Flight]:
    """A flight whose parts count their time; PyBullet's calls of this process do meanwhile."""
    modules = (body, physics)
    plain = pybullet
    for module in modules:
        module.pybullet = sections.module("PyBullet", plain)  # type: ignore[attr-defined]
    try:
        flight = Flight(resolved)
        try:
            sections.wrap(flight, "flight", "advance")
            sections.wrap(flight.world, "physics around PyBullet", "step")
            for craft in flight.crafts:
                sections.wrap(craft, "controller", "command")
                sections.wrap(craft, "autopilot", "control")
                sections.wrap(craft, "sensors and judge", "follow", "frames")
            yield flight
        finally:
            flight.close()
    finally:
        for module in modules:
            module.pybullet = plain  # type: ignore[attr-defined]


def _enter_offboard(flight: Flight) -> None:
    craft = flight.crafts[0]
    command = Command(int(Cmd.DO_SET_MODE), (1.0, 6.0, 0.0, 0.0, 0.0, 0.0, 0.0), _COMPANION)
    craft.autopilot.command(command, craft.state, flight.t_ns)
