"""Every failure has a name; each message names the file, key or field and what was expected."""

from __future__ import annotations


class CompanionError(Exception):
    """Base of all errors that this project raises on purpose."""


class ConfigError(CompanionError):
    """A configuration that cannot be flown; the command line exits with status 2."""


class ArtifactError(ConfigError):
    """A policy artefact that is missing, damaged or made for another contract."""


class FrameRejected(CompanionError):
    """An obstacle frame dropped whole. ``reason`` is the short token under which it is counted."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason = reason
        self.detail = detail


class PolicyOutputInvalid(CompanionError):
    """The policy answered with something that is not a finite action."""


class SolverError(CompanionError):
    """A quadratic program without a usable answer; the safety filter falls back, it never passes this on."""


class BrainFailure(CompanionError):
    """The brain could not answer a tick: the service goes to FAULT."""


class LockstepStalled(CompanionError):
    """No progress for one second of wall time in lockstep; the message names what was missing."""
