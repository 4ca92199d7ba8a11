"""Processor and memory from text as Linux writes it."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.hostload import CpuTicks, HostLoad, cpu_percent, parse_meminfo, parse_stat

STAT = """\
cpu  2255 34 2290 22625563 6290 127 456 0 0 0
cpu0 1132 34 1441 11311718 3675 127 438 0 100 0
cpu1 1123 0 849 11313845 2614 0 18 0 0 0
intr 114930548 113199788 3 0 5 263 0 4 [...]
ctxt 1990473
btime 1062191376
processes 2915
"""
MEMINFO = """\
MemTotal:        8148048 kB
MemFree:         3012345 kB
MemAvailable:    6100000 kB
Buffers:          123456 kB
"""


def test_stat() -> None:
    cores = parse_stat(STAT)
    assert list(cores) == ["cpu0", "cpu1"]
    assert cores["cpu0"] == CpuTicks(busy=1132 + 34 + 1441 + 127 + 438, total=11318565)
    assert cores["cpu1"].busy == 1123 + 849 + 18


def test_share_between_two_readings() -> None:
    before = {"cpu0": CpuTicks(100, 1000), "cpu1": CpuTicks(0, 1000), "cpu2": CpuTicks(5, 10)}
    after = {"cpu0": CpuTicks(150, 1200), "cpu1": CpuTicks(200, 1200), "cpu3": CpuTicks(1, 2), "cpu2": CpuTicks(5, 10)}
    assert cpu_percent(before, after) == (25, 100, 0)  # a core that came is left out, one that stood still is idle


def test_memory() -> None:
    assert parse_meminfo(MEMINFO) == ((8148048 - 6100000) // 1024, 8148048 // 1024)
    with pytest.raises(ValueError, match="MemAvailable"):
        parse_meminfo("MemTotal: 1 kB\n")


def test_readings(tmp_path: Path) -> None:
    load = HostLoad(tmp_path)
    assert load.read() is None  # no such system
    (tmp_path / "stat").write_text("cpu 0 0 0 0 0\ncpu0 10 0 0 90 0 0 0 0\n")
    (tmp_path / "meminfo").write_text(MEMINFO)
    (tmp_path / "uptime").write_text("350735.47 234388.90\n")
    first = load.read()
    assert first is not None
    assert (first.cpu_percent, first.ram_total_mib, first.uptime_ms) == ((), 7957, 350_735_470)
    (tmp_path / "stat").write_text("cpu 0 0 0 0 0\ncpu0 40 0 0 160 0 0 0 0\n")
    second = load.read()
    assert second is not None
    assert second.cpu_percent == (30,)
    (tmp_path / "stat").write_text("cpu0 what is this\n")
    assert load.read() is None
