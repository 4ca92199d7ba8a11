"""The MAVLink numbers that the daemon uses, by their names in common.xml (prefix MAV_ dropped)."""

from __future__ import annotations

from pymavlink.dialects.v20 import ardupilotmega as dialect

COMPONENT = 196  # MAV_COMP_ID_OBSTACLE_AVOIDANCE: this daemon
AUTOPILOT_COMPONENT = 1  # MAV_COMP_ID_AUTOPILOT1
TYPE_ONBOARD_CONTROLLER = 18

AUTOPILOT_INVALID = 8  # the sender is no autopilot

CMD_NAV_GUIDED_ENABLE = 92
CMD_DO_SET_MODE = 176
CMD_DO_REPOSITION = 192
CMD_SET_MESSAGE_INTERVAL = 511
CMD_REQUEST_MESSAGE = 512

MSG_HEARTBEAT = 0
MSG_SYSTEM_TIME = 2
MSG_GPS_RAW_INT = 24
MSG_ATTITUDE_QUATERNION = 31
MSG_LOCAL_POSITION_NED = 32
MSG_GLOBAL_POSITION_INT = 33
MSG_GPS_GLOBAL_ORIGIN = 49
MSG_COMMAND_INT = 75
MSG_COMMAND_LONG = 76
MSG_COMMAND_ACK = 77
MSG_SET_ATTITUDE_TARGET = 82
MSG_SET_POSITION_TARGET_LOCAL_NED = 84
MSG_POSITION_TARGET_LOCAL_NED = 85
MSG_SET_POSITION_TARGET_GLOBAL_INT = 86
MSG_TIMESYNC = 111
MSG_EXTENDED_SYS_STATE = 245
MSG_ADSB_VEHICLE = 246
MSG_STATUSTEXT = 253
MSG_OBSTACLE_DISTANCE = 330
MSG_ODOMETRY = 331
MSG_UTM_GLOBAL_POSITION = 340
MSG_OBSTACLE_DISTANCE_3D = 11037

RESULT_ACCEPTED = 0
RESULT_TEMPORARILY_REJECTED = 1
RESULT_DENIED = 2
RESULT_UNSUPPORTED = 3
RESULT_COMMAND_INT_ONLY = 8
RESULT_COMMAND_UNSUPPORTED_MAV_FRAME = 9

STATE_BOOT = 1
STATE_STANDBY = 3
STATE_ACTIVE = 4
STATE_CRITICAL = 5

SEVERITY_CRITICAL = 2
SEVERITY_WARNING = 4
SEVERITY_NOTICE = 5
SEVERITY_INFO = 6

FRAME_GLOBAL = 0
FRAME_LOCAL_NED = 1
FRAME_GLOBAL_INT = 5
FRAME_LOCAL_OFFSET_NED = 7
FRAME_BODY_NED = 8  # deprecated name of BODY_FRD
FRAME_BODY_FRD = 12

MODE_FLAG_CUSTOM_ENABLED = 0x01
MODE_FLAG_SAFETY_ARMED = 0x80

LANDED_ON_GROUND = 1
LANDED_IN_AIR = 2
LANDED_TAKEOFF = 3
LANDED_LANDING = 4

# POSITION_TARGET_TYPEMASK
IGNORE_POSITION = 0x0007
IGNORE_VELOCITY = 0x0038
IGNORE_ACCELERATION = 0x01C0
IGNORE_YAW = 0x0400
IGNORE_YAW_RATE = 0x0800
FORCE = 0x0200


def autopilot_name(autopilot: int) -> str:
    """A MAV_AUTOPILOT in words.

    >>> autopilot_name(12), autopilot_name(200)
    ('PX4', 'autopilot 200')
    """
    if autopilot == 3:
        return "ArduPilot"  # the dialect still calls it ARDUPILOTMEGA
    entry = dialect.enums["MAV_AUTOPILOT"].get(autopilot)
    return f"autopilot {autopilot}" if entry is None else str(entry.name).removeprefix("MAV_AUTOPILOT_")


def message_name(message: int) -> str:
    """The name of a message of the dialect.

    >>> message_name(32)
    'LOCAL_POSITION_NED'
    """
    return str(dialect.mavlink_map[message].msgname)


_PX4_MAIN = {1: "MANUAL", 2: "ALTITUDE", 3: "POSITION", 5: "ACRO", 6: "OFFBOARD", 7: "STABILIZED"}
_PX4_AUTO = {2: "TAKEOFF", 3: "HOLD", 4: "MISSION", 5: "RETURN", 6: "LAND", 8: "FOLLOW", 9: "PRECISION LAND"}


def mode_name(autopilot: int, custom_mode: int) -> str:
    """A heartbeat's custom_mode in words (px4_custom_mode.h; COPTER_MODE of the dialect), else its number.

    >>> mode_name(12, 6 << 16), mode_name(12, 4 << 16 | 3 << 24), mode_name(3, 17), mode_name(12, 99)
    ('OFFBOARD', 'HOLD', 'BRAKE', '99')
    """
    if autopilot == 3:
        entry = dialect.enums["COPTER_MODE"].get(custom_mode)
        return str(custom_mode) if entry is None else str(entry.name).removeprefix("COPTER_MODE_")
    main, sub = custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF
    named = _PX4_AUTO.get(sub) if main == 4 else _PX4_MAIN.get(main)
    return str(custom_mode) if named is None else named
