"""The live parameters of a running daemon: the configuration that holds now, and the file that keeps it.

The file holds one line a parameter that differs from the configuration, ``CA_CUSHION = 0.3``. At the start it is laid
over the configuration; nothing but these parameters can be in it.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
import tomllib
from collections.abc import Callable
from pathlib import Path

from companion.config import Config
from companion.errors import ConfigError
from companion.tunables import BY_NAME, as_float32, changed, from_float32, values

_HEAD = "# Live parameters of companion that differ from its configuration; written on MAV_CMD_PREFLIGHT_STORAGE.\n"
MAX_FILE_BYTES = 65536


def with_stored(config: Config) -> Config:
    """``config`` with what its ``params.file`` holds laid over it; the same where there is none yet.

    Raises:
        ConfigError: a file that cannot be read or is not what `store` writes; one line that names file and parameter.
    """
    if config.params.file is None or not Path(config.params.file).exists():
        return config
    return changed(config, load(Path(config.params.file)), source=config.params.file)


def load(path: Path) -> dict[str, float]:
    """The parameters in a file, unchecked but for their number. Raises ConfigError."""
    try:
        with path.open("rb") as file:
            data = file.read(MAX_FILE_BYTES + 1)
        raw = tomllib.loads(data.decode("utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}), expected a TOML file") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not TOML: {' '.join(str(error).split())}") from None
    if len(data) > MAX_FILE_BYTES:
        raise ConfigError(f"{path}: expected at most {MAX_FILE_BYTES} bytes")
    return raw


def store(path: Path, overrides: dict[str, float]) -> None:
    """Replace the file at once or not at all: whoever reads it, after a power cut too, finds the old or the new one.

    Raises:
        OSError: it could not be written; the old one stands.
    """
    text = _HEAD + "".join(f"{name} = {value!r}\n" for name, value in overrides.items())
    descriptor, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with open(descriptor, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        Path(name).replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            Path(name).unlink()
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


class LiveParameters:
    """Changes the configuration that holds, one immutable value after the other.

    Args:
        base: the configuration without what was stored.
        config: what holds at the start.
        apply: puts a new configuration into force, at once and as a whole, or raises ConfigError and changes nothing.
        announce: called with the name of each parameter that has changed.
    """

    def __init__(
        self,
        base: Config,
        config: Config,
        *,
        apply: Callable[[Config], None],
        announce: Callable[[str], None],
    ) -> None:
        self._base = base
        self.config = config
        self._apply = apply
        self._announce = announce

    def adopt(self, profile: str) -> None:
        """The vehicle's profile is settled: its defaults hold from here on."""
        self._base, self.config = self._base.flown_as(profile), self.config.flown_as(profile)

    def read(self, name: str) -> float:
        return BY_NAME[name].of(self.config)

    def write(self, name: str, value: float) -> str | None:
        """Set one parameter to a float32; why it is refused, or None."""
        if as_float32(self.read(name)) == value:
            return None  # what holds may have more digits than the message carried
        return self._attempt(lambda: changed(self.config, {name: from_float32(value)}, source="PARAM_SET"))

    def save(self) -> str | None:
        """Write what differs from the configuration to ``params.file``; why not, or None."""
        file = self._base.params.file
        if file is None:
            return "params.file: not configured, nothing can be stored"
        base, now = values(self._base), values(self.config)
        overrides = {name: now[name] for name in now if as_float32(now[name]) != as_float32(base[name])}
        try:
            store(Path(file), overrides)
        except OSError as error:
            return f"params.file {file}: cannot be written ({error.strerror})"
        return None

    def restore(self) -> str | None:
        """Take what is stored; why not, or None."""
        file = self._base.params.file
        if file is None or not Path(file).exists():
            return "params.file: nothing is stored"
        return self._attempt(lambda: with_stored(self._base))

    def reset(self) -> str | None:
        """Take the configuration's own values; why not, or None. What is stored stays until the next `save`."""
        return self._attempt(lambda: self._base)

    def _attempt(self, make: Callable[[], Config]) -> str | None:
        before = self.config
        try:
            config = make()
            self._apply(config)
        except ConfigError as error:
            return str(error)
        self.config = config
        was, now = values(before), values(config)
        for name, value in now.items():
            if value != was[name]:
                self._announce(name)
        return None
