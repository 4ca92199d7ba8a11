"""How busy this computer is: processor and memory from Linux's /proc; None where there is no such thing.

Sources: proc(5): ``cpuN user nice system idle iowait irq softirq steal ...`` in ticks since boot; ``MemTotal`` and
``MemAvailable`` in kB; ``uptime`` in seconds first.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

_IDLE, _IOWAIT, _STEAL = 3, 4, 7


@dataclass(frozen=True, slots=True)
class CpuTicks:
    """One core since boot."""

    busy: int
    total: int


@dataclass(frozen=True, slots=True)
class Load:
    """One reading."""

    cpu_percent: tuple[int, ...]  # each core since the reading before, empty at the first
    ram_used_mib: int
    ram_total_mib: int
    uptime_ms: int


def parse_stat(text: str) -> dict[str, CpuTicks]:
    """Ticks of each core (``cpu0``, ``cpu1``, ...) of /proc/stat; the line of all together is left out.

    Guest time is part of user time already, so only the first eight columns count. Raises ValueError on anything else.

    >>> parse_stat("cpu 1 1 1 1\\ncpu0 30 0 10 50 10 0 0 0 7 0\\nintr 5\\n")
    {'cpu0': CpuTicks(busy=40, total=100)}
    """
    cores = {}
    for line in text.splitlines():
        name, *columns = line.split() or [""]
        if name.startswith("cpu") and name != "cpu":
            ticks = [int(column) for column in columns[: _STEAL + 1]]
            if len(ticks) <= _IOWAIT:
                raise ValueError(f"/proc/stat: expected at least 5 columns, got {line!r}")
            total = sum(ticks)
            cores[name] = CpuTicks(total - ticks[_IDLE] - ticks[_IOWAIT], total)
    return cores


def cpu_percent(before: dict[str, CpuTicks], after: dict[str, CpuTicks]) -> tuple[int, ...]:
    """Busy share of each core that is in both readings, in the order of ``after``, 0 to 100."""
    shares = []
    for name, now in after.items():
        if (then := before.get(name)) is None:
            continue
        busy, total = now.busy - then.busy, now.total - then.total
        shares.append(max(0, min(100, round(100.0 * busy / total))) if total > 0 else 0)
    return tuple(shares)


def parse_meminfo(text: str) -> tuple[int, int]:
    """(used, total) [MiB]; used is what is not available to a new program.

    >>> parse_meminfo("MemTotal: 4096 kB\\nMemFree: 100 kB\\nMemAvailable: 1024 kB\\n")
    (3, 4)
    """
    kib = {}
    for line in text.splitlines():
        name, found, rest = line.partition(":")
        if found and name in ("MemTotal", "MemAvailable"):
            kib[name] = int(rest.split()[0])
    if len(kib) != 2:
        raise ValueError("/proc/meminfo: expected MemTotal and MemAvailable")
    return (kib["MemTotal"] - kib["MemAvailable"]) // 1024, kib["MemTotal"] // 1024


class HostLoad:
    """Reads /proc; keeps the last processor ticks, because a share needs two readings."""

    def __init__(self, proc: Path = Path("/proc")) -> None:
        self._proc = proc
        self._before: dict[str, CpuTicks] = {}

    def read(self) -> Load | None:
        """The load now, None where it cannot be told. Never raises."""
        try:
            cores = parse_stat((self._proc / "stat").read_text(encoding="ascii"))
            used_mib, total_mib = parse_meminfo((self._proc / "meminfo").read_text(encoding="ascii"))
            uptime_ms = round(1e3 * float((self._proc / "uptime").read_text(encoding="ascii").split()[0]))
        except (OSError, ValueError, IndexError):
            return None
        shares = cpu_percent(self._before, cores) if self._before else ()
        self._before = cores
        return Load(shares, used_mib, total_mib, uptime_ms)
