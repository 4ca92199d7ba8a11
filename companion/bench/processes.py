"""What the benches of the whole daemon start: the simulator and the daemon as processes, their links, their memory."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import zenoh

from companion.errors import CompanionError, ConfigError

STOP_S = 30.0
PHYSICS_HZ = (240, 300, 500, 400, 600, 1000)  # the first with a whole number of steps a tick, and at least:
STEPS = 4
# centre [m], axis, tilt and phase [deg]: as in the simulator's own bench
EIGHTS = (
    ((-3.12, 2.5, 1.5), 90.0, 0.0, 0.0),
    ((3.12, -2.5, 1.5), 90.0, 0.0, 90.0),
    ((3.12, 3.12, 1.8), 0.0, 20.0, 0.0),
    ((-2.08, -3.74, 1.4), 0.0, 0.0, 180.0),
)


@dataclass(frozen=True, slots=True)
class Links:
    """Where simulator, daemon and bench meet, on the loopback."""

    onboard: int
    ground: int
    simulator: str  # Zenoh endpoint that the simulator listens on
    daemon: str  # and the daemon

    @classmethod
    def free(cls) -> Links:
        """On ports that nobody holds now."""
        udp = [free_port(socket.SOCK_DGRAM) for _ in range(2)]
        tcp = [f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}" for _ in range(2)]
        return cls(udp[0], udp[1], tcp[0], tcp[1])


class Child:
    """A Python module as a process; its words go to a file, and it is gone when the block ends."""

    def __init__(self, words: Sequence[str], log: Path) -> None:
        self.name = words[0].removesuffix(".cli")
        self._log = log
        with log.open("wb") as stderr:
            self.process = subprocess.Popen(
                [sys.executable, "-m", *words], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=stderr
            )

    def __enter__(self) -> Child:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, at: TracebackType | None) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.communicate()

    @property
    def running(self) -> bool:
        return self.process.poll() is None

    def wait(self, seconds: float) -> None:
        """Until it has ended, for at most ``seconds``."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(seconds)

    def check(self) -> None:
        """Raise CompanionError with its last words where it has ended by itself."""
        if not self.running:
            raise self.failed(f"ended with status {self.process.returncode}")

    def stop(self) -> bytes:
        """Its output, after SIGTERM."""
        if self.running:
            self.process.send_signal(signal.SIGTERM)
        try:
            out, _ = self.process.communicate(timeout=STOP_S)
        except subprocess.TimeoutExpired:
            raise self.failed(f"did not stop within {STOP_S:g} s of SIGTERM") from None
        return out

    def failed(self, what: str) -> CompanionError:
        words = self._log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        last = words[-1] if words else "it said nothing"
        if "No module named" in last:
            return ConfigError(f"bench: {self.name}: the simulator is not installed ({last}), expected: the sim extra")
        return CompanionError(f"bench: {self.name} {what}: {last}")


def scenario_text(rate_hz: int, obstacles: int, seconds: float | None) -> str:
    """A vehicle that holds 1.5 m above the ground while figure eights sweep past it, over after ``seconds``.

    Raises:
        ConfigError: no rate of physics fits ``rate_hz``.
    """
    lines = [
        f'description = "{obstacles} figure eights about the target, for timing"',
        f"physics_hz = {physics_hz(rate_hz)}\ncontrol_hz = {rate_hz}",
        "[vehicle]\nstart = [-3.0, 0.0, 1.5]  # in the air: it starts armed, in Hold",
        "[target]\nposition = [0.0, 0.0, 1.5]",
    ]
    for m in range(obstacles):
        (x, y, z), yaw, tilt, phase = EIGHTS[m % 4]
        away = 1.0 + 0.5 * (m // 4)  # the further ones pass farther from the target
        lines.append(
            f'[[obstacles]]\nid = "eight-{m + 1}"\nmotion = "figure_eight"\nsize_m = 3.2\nperiod_s = {8.0 + m}\n'
            f"origin = [{away * x:.2f}, {away * y:.2f}, {z}]\naxis_yaw_deg = {yaw}\ntilt_deg = {tilt}\n"
            f"phase_deg = {phase}"
        )
    lines.append('[[operator]]\ndo = "engage"\nafter = "airborne_hover"')
    lines.append("[end]\nhold_s = 10000.0\n" + ("stop = false" if seconds is None else f"timeout_s = {seconds}"))
    return "\n\n".join(lines) + "\n"


def physics_hz(rate_hz: int) -> int:
    """Physics steps a second for so many control ticks.

    Raises:
        ConfigError: none of `PHYSICS_HZ` fits.
    """
    for hz in PHYSICS_HZ:
        if hz % rate_hz == 0 and hz >= STEPS * rate_hz and 1000 % rate_hz == 0:
            return hz
    raise ConfigError(
        f"bench: expected a rate that divides 1000 and, {STEPS} times or more, one of {PHYSICS_HZ}, got {rate_hz} Hz"
    )


def daemon_settings(links: Links, rate_hz: int, log: Path, *, lockstep: bool) -> tuple[str, ...]:
    """The daemon's ``KEY=VALUE`` for the simulator on ``links``."""
    settings: dict[str, Any] = {
        "mavlink.url": f"udpin://127.0.0.1:{links.onboard}",
        "mavlink.system_id": 1,
        "zenoh.connect": [links.simulator],
        "zenoh.listen": [links.daemon],
        "target.position": [0.0, 0.0, 1.5],
        "tick_hz": rate_hz,
        "log.directory": str(log),
    }
    if lockstep:
        settings |= {"sync": "lockstep", "lockstep_sources": ["sim"]}
    return tuple(f"{key}={json.dumps(value)}" for key, value in settings.items())


def simulator_words(links: Links, scenario: Path, *flags: str) -> list[str]:
    """The simulator's command line."""
    words = ["sim_bridge.cli", "run", "--scenario", str(scenario), "--seed", "0", "--json"]
    words += ["--onboard-port", str(links.onboard), "--gcs-port", str(links.ground)]
    return [*words, "--zenoh-listen", links.simulator, *flags]


def open_zenoh(endpoint: str) -> zenoh.Session:
    """A session that knows ``endpoint`` and nobody else."""
    settings = zenoh.Config()
    settings.insert_json5("connect/endpoints", json.dumps([endpoint]))
    settings.insert_json5("connect/retry", '{"period_init_ms": 100, "period_max_ms": 200}')
    settings.insert_json5("scouting/multicast/enabled", "false")
    settings.insert_json5("scouting/gossip/enabled", "false")
    return zenoh.open(settings)


def memory_mib(pid: int) -> dict[str, float]:
    """Resident memory now and at its highest (VmRSS and VmHWM of /proc/PID/status)."""
    wanted = {"VmRSS": "resident", "VmHWM": "peak"}
    told = {}
    for line in Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines():
        name, _, rest = line.partition(":")
        if name in wanted:
            told[wanted[name]] = int(rest.split()[0]) / 1024.0
    return told


def processor_s(pid: int) -> float:
    """Processor time that a process has used, user and system (/proc/PID/stat)."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
