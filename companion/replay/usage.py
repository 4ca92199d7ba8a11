"""What the commands that read a log call wrong usage."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from companion.errors import CompanionError, ConfigError


@contextmanager
def as_usage() -> Iterator[None]:
    """A log that cannot be read is wrong usage, as a configuration is: status 1 means something else here.

    Raises:
        ConfigError: in the place of any CompanionError.
    """
    try:
        yield
    except CompanionError as error:
        raise ConfigError(str(error)) from None
