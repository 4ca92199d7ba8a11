"""What the types of the configuration cannot say, and how a mistake is put: one line ``source: key: expectation``."""

from __future__ import annotations

from companion.errors import ConfigError

Point = tuple[float, float, float]


def pointed(message: str) -> str:
    """``Expected `float`... - at `$.safety.alpha1` `` -> ``safety.alpha1: Expected `float`...``."""
    text, at, path = message.rpartition(" - at `$")
    if not at:
        return message
    return f"{path.rstrip('`').lstrip('.')}: {text}" if path.rstrip("`") else text


def check_arena(low: Point, high: Point, target: Point | None, source: str) -> None:
    """Raise ConfigError unless the arena is a box and the target, where there is one, lies in it."""
    for axis, lower, upper in zip("xyz", low, high, strict=True):
        if lower >= upper:
            raise ConfigError(
                f"{source}: limits.arena_min: expected below arena_max on axis {axis}, got {lower} >= {upper}"
            )
    if target is None:
        return
    for axis, lower, value, upper in zip("xyz", low, target, high, strict=True):
        if not lower <= value <= upper:
            raise ConfigError(
                f"{source}: target.position: expected {axis} inside limits.arena [{lower}, {upper}], got {value}"
            )


def check_tick(rate_hz: int, source: str) -> None:
    """Raise ConfigError unless the control period is whole milliseconds: setpoints carry such stamps."""
    if 1000 % rate_hz:
        raise ConfigError(f"{source}: tick_hz: expected a control period of whole milliseconds, got {rate_hz} Hz")


def check_confirmation(hits: int, frames: int, source: str) -> None:
    """Raise ConfigError where no anonymous obstacle could ever be confirmed."""
    if hits > frames + 1:
        raise ConfigError(
            f"{source}: tracking.confirm_hits: expected at most confirm_frames + 1 = {frames + 1}, got {hits}"
        )


def check_reserve(acceleration_m_s2: float, bound_m_s2: float, source: str) -> None:
    """Raise ConfigError where the disturbance estimate may take all that the vehicle has."""
    if acceleration_m_s2 <= bound_m_s2:
        raise ConfigError(
            f"{source}: limits.acceleration_m_s2: expected more than disturbance.bound_m_s2 = {bound_m_s2}, "
            f"got {acceleration_m_s2}"
        )


def check_ros2(topics: tuple[str, ...], sync: str, source: str) -> None:
    """Raise ConfigError for a topic named twice, and in lockstep: ROS stamps are unix time, which lockstep has not."""
    names = [topic.strip("/") for topic in topics]
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"{source}: ros2: expected each topic once, got /{name} {names.count(name)} times")
    if names and sync == "lockstep":
        raise ConfigError(f'{source}: ros2: expected no topics with sync = "lockstep"')


def check_http(commands: bool, token_file: str | None, source: str) -> None:
    """Raise ConfigError where anyone at all could command the vehicle by HTTP."""
    if commands and token_file is None:
        raise ConfigError(f"{source}: http.token_file: expected a file, http.commands = true needs a token")
