"""What a log says about its flight in a few numbers."""

from __future__ import annotations

import datetime
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from companion.link.wire import SetpointRecord
from companion.logbook.reader import FlightLog
from companion.logbook.series import Series
from companion.tlog import read_tlog


def info(log: FlightLog, series: Series) -> dict[str, Any]:
    """The object of `companion log info --json`."""
    records, metadata = series.records, log.metadata
    closest = series.closest()
    return {
        "file": str(log.path),
        "parts": [path.name for path in log.paths],
        "cut": log.cut,
        "version": log.version,
        "commit": metadata.get("commit"),
        "python": metadata.get("python"),
        "packages": metadata.get("packages", {}),
        "artifact": metadata.get("artifact"),
        "artifact_digest": metadata.get("artifact_digest"),
        "config_hash": log.config_hash,
        "config_changes": len(log.configs) - 1,
        "vehicle": log.configs[-1].values.get("vehicle", {}).get("name"),
        "profile": log.configs[-1].values.get("vehicle", {}).get("profile"),
        "started": _iso(metadata.get("started_unix_ns")),
        "duration_s": round(float(series.t_s[-1]), 3) if len(series.t_s) else 0.0,
        "clock_restarts": series.restarts,
        "ticks": len(records),
        "sent": sum(record.sent for record in records),
        "verdicts": dict(Counter(record.verdict for record in records)),
        "detours": sum(record.detour for record in records),
        "states_s": _seconds_in_states(records, series),
        "minimum_clearance": None
        if closest is None
        else {"m": round(closest[0], 4), "track": closest[1], "t_s": round(closest[2], 3)},
        "tracks": len(series.tracks),
        "latency_ms": {name: quantiles(_timings(records, name)) for name in ("total", "brain", "queue")},
        "topics": dict(sorted(series.topics.items())),
        "texts": [{"t_s": round(t_s, 3), "severity": text.severity, "text": text.text} for t_s, text in series.texts],
        "lost_messages": _lost(series),
        "tlog": _tlog(log.paths),
    }


def quantiles(values: Sequence[float]) -> dict[str, float]:
    """p50, p99, p99.9 and max; empty where there are none."""
    if not values:
        return {}
    p50, p99, p999 = np.quantile(values, [0.5, 0.99, 0.999])
    return {
        name: round(float(value), 4)
        for name, value in (("p50", p50), ("p99", p99), ("p99.9", p999), ("max", max(values)))
    }


def _timings(records: Iterable[SetpointRecord], name: str) -> list[float]:
    return [record.timings_ms[name] for record in records if name in record.timings_ms]


def _seconds_in_states(records: list[SetpointRecord], series: Series) -> dict[str, float]:
    """Each tick's state lasts until the next tick."""
    seconds: dict[str, float] = {}
    for record, length_s in zip(records, np.diff(series.t_s, append=series.t_s[-1:]).tolist(), strict=True):
        seconds[record.state] = seconds.get(record.state, 0.0) + length_s
    return {state: round(length_s, 3) for state, length_s in seconds.items()}


def _lost(series: Series) -> dict[str, int]:
    """Messages that the daemon could not log, by why, as its last status says."""
    counts = {} if series.last_status is None else series.last_status.counts
    return {name.removeprefix("log."): count for name, count in counts.items() if name.startswith("log.") and count}


def _tlog(parts: tuple[Path, ...]) -> dict[str, Any] | None:
    """The MAVLink packets beside the log's parts."""
    files = [path.with_suffix(".tlog") for path in parts if path.with_suffix(".tlog").exists()]
    if not files:
        return None
    packets = [unix_us for path in files for unix_us, _ in read_tlog(path)]
    length_s = (packets[-1] - packets[0]) / 1e6 if packets else 0.0
    return {"files": [path.name for path in files], "packets": len(packets), "duration_s": round(length_s, 3)}


def _iso(unix_ns: int | None) -> str | None:
    if unix_ns is None:
        return None
    return datetime.datetime.fromtimestamp(unix_ns / 1e9, datetime.UTC).isoformat(timespec="milliseconds")
