"""Every failure of the simulator has a name; each message names the key or value and what was expected."""

from __future__ import annotations


class SimError(Exception):
    """Base of all errors that the simulator raises on purpose."""


class ScenarioError(SimError):
    """A scenario that cannot be flown; the command line exits with status 2."""
