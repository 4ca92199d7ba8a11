"""The files of packet signing: the key, readable by its owner alone, and the timestamps kept over restarts."""

from __future__ import annotations

import contextlib
import hashlib
import os
import stat
from collections.abc import Callable
from pathlib import Path

import msgspec
from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.config_links import SigningConfig
from companion.errors import ConfigError
from companion.link.signing import KEY_BYTES, Signing, SigningState

_EXPECTED = f"expected {KEY_BYTES} bytes, {2 * KEY_BYTES} hex digits, or one line passphrase:TEXT"
_PASSPHRASE = b"passphrase:"
_MAX_FILE = 4096  # [bytes]


def open_signing(config: SigningConfig, unix_ns: Callable[[], int], on_report: Callable[[str], None]) -> Signing | None:
    """Signing as configured, None where no key is.

    Raises:
        ConfigError: the key file is missing, readable by others, or holds no key.
    """
    if config.key_file is None:
        if config.state_file is not None:
            raise ConfigError("mavlink.signing.state_file: expected only together with mavlink.signing.key_file")
        return None
    key = read_key(Path(config.key_file))
    keeper = None if config.state_file is None else StateFile(Path(config.state_file), on_report)
    return Signing(
        key,
        unix_ns,
        link_id=config.link_id,
        allow_unsigned=[getattr(dialect, f"MAVLINK_MSG_ID_{name}") for name in config.allow_unsigned],
        state=None if keeper is None else keeper.read(),
        persist=None if keeper is None else keeper.write,
        on_report=on_report,
    )


def read_key(path: Path) -> bytes:
    """The 32 bytes of a key file: raw, as 64 hex digits, or SHA-256 of a passphrase as ground stations do it.

    Raises:
        ConfigError: one line naming the file and the expectation; never what the file holds.
    """
    name = f"mavlink.signing.key_file {path}"
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)  # not even a FIFO keeps us waiting
    except OSError as error:
        raise ConfigError(f"{name}: cannot be read ({error.strerror}), expected a file of mode 0600") from None
    try:
        status = os.fstat(fd)
        if not stat.S_ISREG(status.st_mode):
            raise ConfigError(f"{name}: expected a regular file of mode 0600")
        if status.st_mode & 0o177:
            mode = stat.S_IMODE(status.st_mode)
            raise ConfigError(f"{name}: expected mode 0600 or less (owner only), got {mode:04o}")
        content = os.read(fd, _MAX_FILE + 1)
    finally:
        os.close(fd)
    key = _key_in(content)
    if key is None:
        raise ConfigError(f"{name}: {_EXPECTED}")
    return key


def _key_in(content: bytes) -> bytes | None:
    if content.startswith(_PASSPHRASE):
        phrase = content.removeprefix(_PASSPHRASE).removesuffix(b"\n").removesuffix(b"\r")
        one_line = len(content) <= _MAX_FILE and b"\n" not in phrase
        return hashlib.sha256(phrase).digest() if phrase and one_line else None
    if len(content) == KEY_BYTES:
        return content
    text = content.strip()
    if len(text) == 2 * KEY_BYTES and not set(text) - set(b"0123456789abcdefABCDEF"):
        return bytes.fromhex(text.decode("ascii"))
    return None


class StateFile:
    """A small JSON file, replaced whole. Signing works without it, so trouble with it is told once and flown with."""

    def __init__(self, path: Path, on_report: Callable[[str], None]) -> None:
        self._path = path
        self._on_report = on_report
        self._told = False

    def read(self) -> SigningState | None:
        """What an earlier run left, None where there is nothing usable."""
        try:
            return msgspec.json.decode(self._path.read_bytes(), type=SigningState)
        except FileNotFoundError:
            return None
        except OSError as error:
            self._tell(f"cannot be read ({error.strerror})")
        except msgspec.MsgspecError:
            self._tell("holds no signing state, it is replaced")
        return None

    def write(self, state: SigningState) -> None:
        """Replace the file. The disk is not waited for: losing the last write costs 10 s of memory, no more."""
        fresh = self._path.with_name(self._path.name + ".new")
        try:
            fd = os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
            with os.fdopen(fd, "wb") as file:
                file.write(msgspec.json.encode(state))
            fresh.replace(self._path)
        except OSError as error:
            with contextlib.suppress(OSError):
                fresh.unlink()
            self._tell(f"cannot be written ({error.strerror}): after a restart others may refuse what we sign")

    def _tell(self, what: str) -> None:
        if not self._told:
            self._told = True
            self._on_report(f"mavlink.signing.state_file {self._path}: {what}")
