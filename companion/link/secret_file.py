"""Files that hold a secret: passwords, tokens, private keys."""

from __future__ import annotations

import os
import stat

from companion.errors import ConfigError

MAX_SECRET_BYTES = 1 << 20


def read_secret(path: str, name: str) -> str:
    """The text of a file that only its owner may read. ``name`` heads the error; the content is never shown.

    Raises:
        ConfigError: it cannot be read, is no regular file of mode 0600 or less, or no text.
    """
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)  # not even a FIFO keeps us waiting
    except OSError as error:
        raise ConfigError(f"{name}: cannot be read ({error.strerror}), expected a file of mode 0600") from None
    with os.fdopen(fd, "rb") as file:
        status = os.fstat(fd)
        if not stat.S_ISREG(status.st_mode):
            raise ConfigError(f"{name}: expected a regular file of mode 0600")
        if status.st_mode & 0o177:
            mode = stat.S_IMODE(status.st_mode)
            raise ConfigError(f"{name}: expected mode 0600 or less (owner only), got {mode:04o}")
        content = file.read(MAX_SECRET_BYTES + 1)
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        text = "\0"
    if len(content) > MAX_SECRET_BYTES or "\0" in text:
        raise ConfigError(f"{name}: expected text of at most {MAX_SECRET_BYTES} bytes")
    return text
