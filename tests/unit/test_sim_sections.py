"""Where the time goes: exclusive, and adding up to the whole, against a clock that the test moves."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from sim_bridge import sections
from sim_bridge.sections import Sections, case


class Clock:
    ns = 0

    def perf_counter_ns(self) -> int:
        return self.ns

    def spend(self, ms: float) -> None:
        self.ns += round(ms * 1e6)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(sections, "time", clock)
    return clock


def test_time_counts_for_the_innermost_section_alone(clock: Clock) -> None:
    counted = Sections()
    library = SimpleNamespace(call=lambda: clock.spend(3.0), CONSTANT=7)
    timed = counted.module("library", library)

    def work() -> int:
        clock.spend(2.0)
        timed.call()
        clock.spend(1.0)
        return int(timed.CONSTANT)

    worker = SimpleNamespace(work=work)
    counted.wrap(worker, "work", "work")
    clock.spend(50.0)
    counted.start()
    for _ in range(4):
        clock.spend(0.5)
        assert worker.work() == 7
    assert counted.ms_per(4) == {"work": 3.0, "library": 3.0, "rest": 0.5}


def test_a_call_that_raises_ends_its_section(clock: Clock) -> None:
    counted = Sections()

    def fail() -> None:
        clock.spend(1.0)
        raise ValueError

    counted.start()
    with pytest.raises(ValueError):
        counted.timed("failing", fail)()
    clock.spend(2.0)
    assert counted.ms_per(1) == {"rest": 2.0, "failing": 1.0}


@pytest.mark.parametrize(("count", "p99", "p999"), [(99, False, False), (100, True, False), (1000, True, True)])
def test_a_quantile_of_too_few_ticks_is_none(count: int, p99: bool, p999: bool) -> None:
    told = case("some", [1_000_000 * (k + 1) for k in range(count)], 60.0, demand=60.0)
    assert (told.p99 is not None, told.p999 is not None) == (p99, p999)
    assert (told.n, told.max, told.met) == (count, float(count), True)
    assert told.p50 == pytest.approx((count + 1) / 2)
