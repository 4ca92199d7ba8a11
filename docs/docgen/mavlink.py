"""docs/reference/mavlink.md: the messages that the daemon reads and writes, and the commands that it answers.

Which messages there are is read from the code: its decoders, and the pymavlink classes that its modules build. What
each is for is said here, and a message of which nothing is said is an error.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from pymavlink.dialects.v20 import ardupilotmega as dialect

import companion
from companion import microservices
from companion.link import mav, params
from companion.link.decode import DECODERS
from companion.link.decode_traffic import TRAFFIC_DECODERS
from docgen.pages import table

_PACKAGE = Path(companion.__file__).parent
_BUILT = re.compile(r"MAVLink_(\w+)_message\(")
_NOT_FLYING = ("bench", "doctor")  # folders of `companion` that are no part of the daemon

READ = {
    "HEARTBEAT": "finds the autopilot, its kind, its mode, and whether it is armed",
    "LOCAL_POSITION_NED": "position and velocity; asked for at the tick rate, and each one begins a tick",
    "ATTITUDE_QUATERNION": "attitude; asked for at the tick rate",
    "ODOMETRY": "position, velocity and attitude in one message; velocity in its child frame; resets of the estimator",
    "EXTENDED_SYS_STATE": "on the ground, taking off, in the air; asked for at 2 Hz",
    "COMMAND_ACK": "what came of our mode and stream requests",
    "COMMAND_LONG": "commands to component 196, see below",
    "COMMAND_INT": "commands to component 196, see below",
    "TIMESYNC": "offset between the autopilot's clock and ours; requests are answered",
    "SYSTEM_TIME": "the autopilot's date and boot time, read by the doctor",
    "POSITION_TARGET_LOCAL_NED": "what the autopilot follows, compared with what was sent; asked for at 4 Hz",
    "SET_POSITION_TARGET_LOCAL_NED": "of another sender: told, and counted",
    "SET_POSITION_TARGET_GLOBAL_INT": "of another sender: told, and counted",
    "SET_ATTITUDE_TARGET": "of another sender: told, and counted",
    "STATUSTEXT": "joined from its chunks; nothing in the daemon depends on one",
    "PARAM_REQUEST_LIST": "all live parameters of component 196",
    "PARAM_REQUEST_READ": "one live parameter, by name or index",
    "PARAM_SET": "changes a live parameter",
    "GPS_GLOBAL_ORIGIN": "where the local frame lies; asked for until it is known",
    "GPS_RAW_INT": "height of the geoid",
    "GLOBAL_POSITION_INT": "of other systems: obstacles of the door `neighbours`",
    "ADSB_VEHICLE": "obstacles of the door `adsb`",
    "UTM_GLOBAL_POSITION": "obstacles of the door `utm`; our own id",
    "OBSTACLE_DISTANCE": "obstacles of the door `obstacle_distance`",
    "OBSTACLE_DISTANCE_3D": "obstacles of the door `obstacle_distance_3d`",
}
WRITTEN = {
    "HEARTBEAT": "1 Hz, from the control task, so that a stuck daemon goes quiet; `system_status` tells the state",
    "SET_POSITION_TARGET_LOCAL_NED": "each tick that sends; acceleration in MAV_FRAME_LOCAL_NED, gravity excluded, "
    "`time_boot_ms` that of the state it answers, `type_mask` by [profile](states.md#vehicle-profiles)",
    "COMMAND_LONG": "to the autopilot: SET_MESSAGE_INTERVAL, REQUEST_MESSAGE, DO_SET_MODE",
    "COMMAND_ACK": "to whoever commanded component 196",
    "STATUSTEXT": "on change, each text at most once in 10 s; longer than 50 bytes in chunks",
    "TIMESYNC": "requests of ours; answers once our own clock has settled",
    "COLLISION": "1 Hz for each threat while in the air, the soonest first",
    "ONBOARD_COMPUTER_STATUS": "0.5 Hz: processor and memory of this computer",
    "PARAM_VALUE": "on request and on every change",
    "AUTOPILOT_VERSION": "on request: version and capabilities of component 196",
    "COMPONENT_INFORMATION_BASIC": "on request",
}
COMMANDS = {
    mav.CMD_NAV_GUIDED_ENABLE: "param1 1 engages, 0 releases; TEMPORARILY_REJECTED where the daemon cannot engage now",
    mav.CMD_DO_REPOSITION: "a new target: COMMAND_INT, in a global frame or MAV_FRAME_LOCAL_NED with x, y in 1e-4 m; "
    "COMMAND_LONG is answered with COMMAND_INT_ONLY",
    mav.CMD_REQUEST_MESSAGE: "one of HEARTBEAT, AUTOPILOT_VERSION, COMPONENT_INFORMATION_BASIC, "
    "ONBOARD_COMPUTER_STATUS",
    microservices.CMD_REQUEST_AUTOPILOT_CAPABILITIES: "AUTOPILOT_VERSION, for older ground stations",
    microservices.CMD_PREFLIGHT_STORAGE: "param1 0 takes, 1 stores, 2 resets the live parameters; disarmed only",
}


def read() -> str:
    """Every message that the daemon decodes."""
    ids = {*DECODERS, *TRAFFIC_DECODERS, *params.REQUESTS}
    ids |= {mav.MSG_STATUSTEXT, mav.MSG_COMMAND_LONG, mav.MSG_COMMAND_INT}
    return _messages({mav.message_name(number) for number in ids}, READ)


def written() -> str:
    """Every message that the daemon builds."""
    built = {
        name.upper()
        for path in sorted(_PACKAGE.rglob("*.py"))
        if path.relative_to(_PACKAGE).parts[0] not in _NOT_FLYING
        for name in _BUILT.findall(path.read_text(encoding="utf-8"))
    }
    if "component_information_basic" in (_PACKAGE / "link" / "identity.py").read_text(encoding="utf-8"):
        built.add("COMPONENT_INFORMATION_BASIC")  # not in pymavlink's dialect: packed by hand
    return _messages(built, WRITTEN)


def commands() -> str:
    """Every command to component 196 that is not answered with UNSUPPORTED."""
    names = {number: dialect.enums["MAV_CMD"][number].name for number in COMMANDS}
    return table(("command", "id", "what"), [(f"`{names[n]}`", str(n), COMMANDS[n]) for n in sorted(COMMANDS)])


def _messages(names: set[str], meaning: Mapping[str, str]) -> str:
    if names != set(meaning):
        unsaid, gone = sorted(names - set(meaning)), sorted(set(meaning) - names)
        raise ValueError(f"MAVLink messages: nothing is said of {unsaid}, gone are {gone}")
    numbers = {name: getattr(dialect, f"MAVLINK_MSG_ID_{name}", 396) for name in names}
    rows = [(f"`{name}`", str(numbers[name]), meaning[name]) for name in sorted(names, key=lambda n: numbers[n])]
    return table(("message", "id", "use"), rows)
