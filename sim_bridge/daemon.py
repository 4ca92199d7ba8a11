"""A `companion run` process that a check starts, signals and reads. Both sides share nothing but sockets and JSON."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from sim_bridge.errors import ScenarioError, SimError
from sim_bridge.scenario import Scenario, Vehicle

_PROFILES = {"px4": "crazyflie-sim", "ardupilot": "ardupilot"}  # vehicle.profile of a personality


class DaemonFailed(SimError):
    """The daemon ended in an unexpected way; the message carries its last words."""


def daemon_settings(
    scenario: Scenario, vehicle: Vehicle, *, onboard_port: int, endpoint: str, lockstep: bool
) -> tuple[str, ...]:
    """``KEY=VALUE`` for each `--set` of the daemon of ``vehicle``: what ties it to this simulator, then the scenario's.

    Values are JSON, which for what occurs here is also TOML.
    """
    sources = [sensor.source for _, sensor in scenario.carried(vehicle.name)]
    target = scenario.target_of(vehicle)
    settings: dict[str, Any] = {
        "vehicle.name": vehicle.name,
        "vehicle.profile": _PROFILES[vehicle.personality],
        "mavlink.url": f"udpin://127.0.0.1:{onboard_port}",
        "mavlink.system_id": vehicle.system_id,
        "zenoh.connect": [endpoint],
        "tick_hz": scenario.control_hz,
    }
    if target is not None:
        settings["target.position"] = list(target)
    if lockstep:
        settings |= {"sync": "lockstep", "lockstep_sources": sources}
    settings |= vehicle.daemon
    return tuple(f"{key}={json.dumps(value)}" for key, value in settings.items())


class Daemon:
    """One daemon; as a context manager it is gone afterwards, whatever happened.

    Args:
        settings: of its `--set` options.
        folder: for its configuration and its log, ``NAME.toml`` and ``NAME.log``.
        log_flight: write ``NAME/flight.mcap`` there too.
    """

    def __init__(self, name: str, settings: Sequence[str], folder: Path, *, log_flight: bool = False) -> None:
        self.name = name
        config = folder / f"{name}.toml"
        config.write_text(
            "# everything at its default: the check sets what differs on the command line\n", encoding="utf-8"
        )
        if log_flight:
            (folder / name).mkdir(exist_ok=True)
            settings = [*settings, f"log.directory={json.dumps(str(folder / name))}"]
        self._log = folder / f"{name}.log"
        self._log_file = self._log.open("wb")
        words = ["companion.cli", "run", "-c", str(config), "--json"]
        words += [word for setting in settings for word in ("--set", setting)]
        self._killed = False
        self._child = subprocess.Popen(
            [sys.executable, "-m", *words], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=self._log_file
        )

    def __enter__(self) -> Daemon:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, at: TracebackType | None) -> None:
        if self._child.poll() is None:
            self._child.kill()  # a stopped process too
        self._child.wait()
        assert self._child.stdout is not None
        self._child.stdout.close()
        self._log_file.close()

    @property
    def pid(self) -> int:
        return self._child.pid

    def freeze(self) -> None:
        """SIGSTOP."""
        self._signal(signal.SIGSTOP)

    def thaw(self) -> None:
        """SIGCONT."""
        self._signal(signal.SIGCONT)

    def kill(self) -> None:
        """SIGKILL; the process is gone when this returns."""
        self._killed = True
        self._child.kill()
        self._child.wait()

    def check_alive(self) -> None:
        """Raise where it has ended by itself.

        Raises:
            ScenarioError: it refused its configuration.
            DaemonFailed: anything else.
        """
        status = self._child.poll()
        if status is None or self._killed:
            return
        if status == 2:
            raise ScenarioError(f"daemon of {self.name}: {self.last_words().removeprefix('companion: ')}")
        raise DaemonFailed(f"daemon of {self.name}: ended with status {status}: {self.last_words()}")

    @property
    def running(self) -> bool:
        return self._child.poll() is None

    def ask_to_stop(self) -> None:
        """SIGTERM; a frozen one is woken for it."""
        self._signal(signal.SIGCONT)
        self._signal(signal.SIGTERM)

    def summary(self) -> dict[str, Any] | None:
        """What it reported when it ended; None of one that was killed.

        Raises:
            DaemonFailed: it has not ended, or without a summary.
        """
        if self._killed:
            return None
        if self.running:
            raise DaemonFailed(f"daemon of {self.name}: did not stop: {self.last_words()}")
        assert self._child.stdout is not None
        lines = self._child.stdout.read().decode(errors="replace").strip().splitlines()
        if self._child.returncode != 0 or not lines:
            status = self._child.returncode
            raise DaemonFailed(f"daemon of {self.name}: ended with status {status}: {self.last_words()}")
        summary: dict[str, Any] = json.loads(lines[-1])
        return summary

    def last_words(self) -> str:
        """The last line of its log."""
        lines = self._log.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it said nothing"

    def _signal(self, number: signal.Signals) -> None:
        if self._child.poll() is None:
            self._child.send_signal(number)
