"""Feeds recorded calls to a pilot of this version."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeAlias

import msgspec

from companion.config import Config
from companion.errors import ConfigError
from companion.journal_format import Configure, Construct, Observe, Reset, Retune, Step, inputs_of
from companion.pilot import Pilot, PilotInput, PilotOutput, ReferenceLaw
from companion.policy import Policy, load_policy
from companion.replay.journal_reader import Entry, JournalReader
from companion.types import NS_PER_S, TrackTable

Variant: TypeAlias = Callable[[Config], Config]  # what is flown instead of a configuration of the log


@dataclass(frozen=True, slots=True)
class Played:
    """One tick again. ``output`` is None, and ``error`` the name of what was raised, where the brain failed."""

    entry: Entry
    step: Step
    inputs: PilotInput
    config: Config
    output: PilotOutput | None
    error: str | None
    table: TrackTable


class Player:
    """A pilot that is called as the log says.

    Args:
        variant: what to fly in place of each configuration of the log; None: that itself.
        artifact: a policy to fly in place of the recorded one, which is then not compared.
        law: a reference law in place of any policy.
    """

    def __init__(
        self,
        reader: JournalReader,
        *,
        variant: Variant | None = None,
        artifact: str | None = None,
        law: ReferenceLaw | None = None,
    ) -> None:
        self.reader = reader
        self.retunes: list[tuple[int, str]] = []  # (stamp, what happened) of every change of the configuration
        self.construct: Construct | None = None
        self._variant = variant
        self._artifact = artifact
        self._law = law
        self._stamp_ns = 0
        self.logged_config = Config()  # what the log flew at the tick just played

    def ticks(self, until_ns: int | None = None) -> Iterator[Played]:
        """Every tick of the log, up to the one of ``until_ns``.

        Raises:
            ConfigError: the log cannot be replayed here: no journal, a configuration or an artefact that is not there.
        """
        pilot: Pilot | None = None
        config = Config()
        for entry in self.reader.entries():
            call = entry.call
            if isinstance(call, Construct):
                self.construct = call
                config = self._config(call.config)
                pilot = Pilot(config, self._policy(call, config) if self._law is None else self._law)
                continue
            assert pilot is not None  # the reader begins with `construct` or not at all
            if isinstance(call, Step):
                self._stamp_ns = call.stamp_ns
                yield self._step(entry, call, pilot, config)
                if until_ns is not None and call.stamp_ns >= until_ns:
                    return
            elif isinstance(call, Observe):
                self._observe(entry, call, pilot)
            elif isinstance(call, Reset):
                pilot.reset()
            elif isinstance(call, Configure):
                config = self._changed(config, call.config, "the vehicle's profile is settled")
                pilot = pilot.configured(config)
            elif isinstance(call, Retune):
                config = self._changed(config, call.config, "live parameters changed")
                pilot.retune(config)

    def _step(self, entry: Entry, call: Step, pilot: Pilot, config: Config) -> Played:
        inputs = inputs_of(call, entry.frames)
        output, error = None, None
        try:
            output = pilot.step(inputs, sent=call.sent)
        except Exception as raised:  # noqa: BLE001 whatever the brain raises is an answer to compare
            error = type(raised).__name__
        return Played(entry, call, inputs, config, output, error, pilot.tracks())

    def _observe(self, entry: Entry, call: Observe, pilot: Pilot) -> None:
        error = None
        try:
            pilot.observe(entry.frames, call.stamp_ns)
        except Exception as raised:  # noqa: BLE001 as in a step
            error = type(raised).__name__
        if error != call.error:
            self.reader.notes.append(f"observing for {call.stamp_ns} ns: {error or 'no error'}, log: {call.error}")

    def _config(self, name: str) -> Config:
        config = self.logged_config = self.reader.config(name)
        return config if self._variant is None else self._variant(config)

    def _changed(self, before: Config, name: str, why: str) -> Config:
        config = self._config(name)
        self.retunes.append((self._stamp_ns, f"{why}: {changes(before, config)}"))
        return config

    def _policy(self, call: Construct, config: Config) -> Policy:
        """The recorded artefact, or the one given."""
        chosen = (
            config.policy if self._artifact is None else msgspec.structs.replace(config.policy, artifact=self._artifact)
        )
        flown_as_recorded = self._artifact is None and self._variant is None
        if flown_as_recorded and call.artifact is None:
            raise ConfigError(
                f"{self.reader.log.path}: flown with a reference law that is no artefact, expected --artifact"
            )
        policy = load_policy(chosen, config.limits)
        if flown_as_recorded and policy.digest != call.artifact:
            raise ConfigError(
                f"{self.reader.log.path}: policy.artifact {chosen.artifact}: expected the manifest of SHA-256 "
                f"{str(call.artifact)[:12]}..., here it is {policy.digest[:12]}... (--artifact flies another)"
            )
        return policy


def changes(before: Config, after: Config) -> str:
    """What differs between two configurations, as ``section.key old -> new``."""
    one, other = msgspec.to_builtins(before), msgspec.to_builtins(after)
    told = []
    for section, values in other.items():
        was = one[section]
        if not isinstance(values, dict):
            told += [f"{section} {was} -> {values}"] if was != values else []
            continue
        told += [f"{section}.{key} {was[key]} -> {now}" for key, now in values.items() if was.get(key) != now]
    return ", ".join(told) or "nothing that is configured"


def seconds(stamp_ns: int, origin_ns: int) -> float:
    """Time of a stamp after ``origin_ns`` [s]."""
    return (stamp_ns - origin_ns) / NS_PER_S
