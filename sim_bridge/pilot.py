"""A pilot with a remote control: moves the mode switch and the sticks, and lets go of them again.

The radio talks to the autopilot itself, past every link. Once it is on it stays on, sticks centred, as a transmitter
in the hands of a pilot does: switching it off would be another fault.
"""

from __future__ import annotations

from sim_bridge.craft import Craft
from sim_bridge.errors import ScenarioError
from sim_bridge.messages import Cmd, Command, Mode, Reply, Sender, Sticks

_PX4, _ARDUPILOT = 12, 3  # MAV_AUTOPILOT
_COPTER = {"STABILIZE": 0, "ALT_HOLD": 2, "AUTO": 3, "GUIDED": 4, "LOITER": 5, "RTL": 6, "LAND": 9, "BRAKE": 17}
STICKS = "STICKS"  # the sticks alone: whether that takes over is the autopilot's to say (COM_RC_OVERRIDE)
RADIO = Sender(255, 190)  # whom the autopilot takes sticks and switches from
_PUSH = 0.5  # of full deflection, forward


def switch_command(craft: Craft, mode: str | None) -> Command | None:
    """What the mode switch asks for; None: the switch stays.

    Args:
        mode: a mode's name, None: that in which a pilot flies (POSITION, LOITER), or `STICKS`.
    Raises:
        ScenarioError: the autopilot has no such mode.
    """
    if mode == STICKS:
        return None
    if craft.autopilot.kind == _ARDUPILOT:
        wanted = "LOITER" if mode is None else mode
        known: tuple[str, ...] = tuple(_COPTER)
        main, sub = _COPTER.get(wanted, 0), 0
    else:
        wanted = "POSITION" if mode is None else mode
        known = tuple(Mode.__members__)
        number = int(Mode.__members__.get(wanted, 0))
        main, sub = number >> 16 & 0xFF, number >> 24
    if wanted not in known:
        raise ScenarioError(f"faults: rc: value: expected one of {', '.join(known)} or {STICKS}, got {wanted}")
    target = (craft.system_id, 1)
    return Command(Cmd.DO_SET_MODE, (1.0, float(main), float(sub), 0.0, 0.0, 0.0, 0.0), RADIO, *target)


class Pilot:
    """One vehicle's pilot; `step` once a control period."""

    def __init__(self, craft: Craft) -> None:
        self._craft = craft
        self._hands_on = False

    def take_over(self, mode: str | None, t_ns: int) -> tuple[Reply, ...]:
        """Switch to ``mode`` and push the stick forward."""
        self._hands_on = True
        switch = switch_command(self._craft, mode)
        replies = () if switch is None else self._craft.autopilot.command(switch, self._craft.state, t_ns)
        return (*replies, *self.step(t_ns))

    def let_go(self) -> None:
        """Sticks centred; the mode stays."""
        self._hands_on = False

    def step(self, t_ns: int) -> tuple[Reply, ...]:
        push = _PUSH if self._hands_on else 0.0
        return self._craft.autopilot.manual(Sticks(push, 0.0, 0.0, 0.0, RADIO), t_ns)
