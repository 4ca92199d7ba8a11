"""What `/metrics` answers, in Prometheus' text format, and the page that documents it.

Every number is read when it is asked for, from the counters that the daemon keeps anyway: ticks pay nothing for them
beyond one histogram bucket.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from prometheus_client import CollectorRegistry, GCCollector, ProcessCollector
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4, generate_latest
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector

from companion.instruments import METRICS, Reading
from companion.metrics import BUCKETS_MS

CONTENT_TYPE = CONTENT_TYPE_PLAIN_0_0_4
LATENCY = "companion_tick_latency_seconds"
LATENCY_MEANING = "From the arrival of a vehicle state to its setpoint on the wire."


class DaemonCollector(Collector):
    """Turns a `Reading`, taken at each scrape, into metric families."""

    def __init__(self, read: Callable[[], Reading]) -> None:
        self._read = read

    def describe(self) -> Iterator[Metric]:
        """Nothing: otherwise registering would read a daemon that is not up yet."""
        return iter(())

    def collect(self) -> Iterator[Metric]:
        """Every family, one after the other."""
        reading = self._read()
        for metric in METRICS:
            kind = CounterMetricFamily if metric.kind == "counter" else GaugeMetricFamily
            family = kind(metric.name, metric.meaning, labels=metric.labels)
            for labels, value in metric.read(reading):
                family.add_metric(labels, value)
            yield family
        yield _latency(reading)


def _latency(reading: Reading) -> Metric:
    buckets, ticks = [], 0
    for bound_ms, count in zip((*BUCKETS_MS, None), reading.bucket_counts, strict=True):
        ticks += count
        buckets.append(("+Inf" if bound_ms is None else str(bound_ms / 1e3), float(ticks)))
    family = HistogramMetricFamily(LATENCY, LATENCY_MEANING)
    family.add_metric([], buckets=buckets, sum_value=reading.latency_sum_s)
    return family


class Exposition:
    """What `/metrics` answers: the daemon's metrics, and those of its process and garbage collector.

    The registry is its own: nothing that another library registers shows here.
    """

    def __init__(self, read: Callable[[], Reading]) -> None:
        self._registry = CollectorRegistry()
        self._registry.register(DaemonCollector(read))
        ProcessCollector(registry=self._registry)
        GCCollector(registry=self._registry)

    def text(self) -> bytes:
        """Prometheus' text format, version 0.0.4."""
        return generate_latest(self._registry)


_HEAD = """\
# Metrics

This page is what `companion schema --metrics` prints; a test compares the two. `GET /metrics` of the daemon's HTTP
server answers in Prometheus' text format (0.0.4). Every number is read when it is asked for; a scrape takes about a
millisecond of the loop, so scrape every few seconds, not every tick. Counters begin at 0 with the process.
A scraper that calls this host by a name needs that name in `http.names`, or it is answered with status 421.
"""

_TAIL = """\
## The process

Beside these, prometheus_client's own: `process_resident_memory_bytes`, `process_virtual_memory_bytes`,
`process_cpu_seconds_total`, `process_start_time_seconds`, `process_open_fds`, `process_max_fds`, and
`python_gc_collections_total`, `python_gc_objects_collected_total`, `python_gc_objects_uncollectable_total` by
`generation`.

## Health

| path | 200 | 503 |
|---|---|---|
| `/livez` | the control task has made a turn within the last second | it has not: restart the daemon |
| `/healthz` | alive, the vehicle's state is fresh, the daemon is READY or better | the body says why |

Both answer with JSON: `healthy`, `reasons` (a list, empty where healthy), `state`, `reason`, `control_age_s`. A daemon
whose loop is blocked does not answer at all, so give the probe a time-out. A daemon that waits for its vehicle is alive
and not healthy: a liveness probe belongs on `/livez`, or the daemon is restarted for want of a vehicle.

## Questions and how to ask them

| question | PromQL |
|---|---|
| ticks a second in which the filter stepped in | `sum(rate(companion_ticks_total{verdict!~"nominal\\|silent"}[1m]))` |
| tick latency, 99th percentile | `histogram_quantile(0.99, rate(companion_tick_latency_seconds_bucket[5m]))` |
| deadlines missed | `increase(companion_deadline_misses_total[5m]) > 0` |
| a source has gone silent | `companion_obstacle_source_age_seconds > 1` |
| damaged packets | `rate(companion_mavlink_packets_damaged_total[1m])` |
| not ready | `companion_state{state=~"WAITING\\|FAULT"} == 1` |
"""


def metrics_page() -> str:
    """The documentation of every metric as Markdown."""
    lines = [_HEAD, "## The daemon", "", "| metric | type | labels | meaning |", "|---|---|---|---|"]
    for metric in METRICS:
        labels = ", ".join(f"`{label}`" for label in metric.labels)
        lines.append(f"| `{metric.exposed}` | {metric.kind} | {labels} | {metric.meaning} |")
    bounds = ", ".join(f"{bound:g}" for bound in BUCKETS_MS)
    lines.append(f"| `{LATENCY}` | histogram | | {LATENCY_MEANING} Buckets up to {bounds} ms. |")
    return "\n".join(lines) + "\n\n" + _TAIL
