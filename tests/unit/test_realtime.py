"""What the system is asked for and what it may refuse; garbage is collected between ticks and never else."""

from __future__ import annotations

import gc
import os
import sys
import threading
from collections.abc import Iterator

import pytest

from companion import realtime
from companion.config import Config, config_hash, parse_config
from companion.config_realtime import RealtimeConfig
from companion.errors import ConfigError

MS = 1_000_000


@pytest.fixture
def collector() -> Iterator[realtime.Collector]:
    """In charge of the collector, on a stopwatch that stands still."""
    taken = realtime.Collector(lambda: 0)
    taken.take_over()
    yield taken
    taken.hand_back()


@pytest.fixture
def collections(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The generations that were collected; nothing is."""
    done: list[int] = []
    monkeypatch.setattr(realtime.gc, "collect", lambda generation=2: done.append(generation))
    return done


def made(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    monkeypatch.setattr(realtime.gc, "get_count", lambda: (count, 0, 0))


def test_nothing_is_collected_by_itself_and_all_is_as_before_afterwards() -> None:
    assert gc.isenabled()
    frozen, switch_s = gc.get_freeze_count(), sys.getswitchinterval()
    taken = realtime.Collector()
    taken.take_over()
    assert not gc.isenabled()
    assert sys.getswitchinterval() == pytest.approx(realtime.SWITCH_S)
    assert gc.get_freeze_count() > frozen
    taken.hand_back()
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0
    assert sys.getswitchinterval() == switch_s


def test_a_cycle_goes_in_an_idle_moment(collector: realtime.Collector) -> None:
    class Node:
        alive = 0

        def __init__(self) -> None:
            self.me = self
            Node.alive += 1

        def __del__(self) -> None:
            Node.alive -= 1

    kept = [[] for _ in range(realtime.YOUNG)]
    for _ in range(10):
        Node()
    assert Node.alive == 10
    collector.idle(-MS)  # the next state is due already
    assert Node.alive == 10
    collector.idle(40 * MS)
    assert Node.alive == 0
    assert len(kept) == realtime.YOUNG


def test_few_objects_are_not_worth_a_collection(
    collector: realtime.Collector, collections: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    made(monkeypatch, realtime.YOUNG - 1)
    collector.idle(1000 * MS)
    assert collections == []


def test_garbage_beyond_the_urgent_mark_waits_for_no_idle_moment(
    collector: realtime.Collector, collections: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    made(monkeypatch, realtime.URGENT)
    collector.idle(0)
    assert collections == [1]


def test_everything_is_collected_now_and_then(
    collector: realtime.Collector, collections: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    made(monkeypatch, realtime.YOUNG)
    for _ in range(2 * (realtime.FULL_EVERY + 1)):
        collector.idle(40 * MS)
    assert collections == 2 * ([1] * realtime.FULL_EVERY + [2])


def test_a_full_collection_needs_a_longer_idle_moment_than_it_last_took(
    collections: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    ticks = iter(range(0, 10**9, 10))  # every reading of the stopwatch is 10 ms later

    taken = realtime.Collector(lambda: next(ticks) * MS)
    made(monkeypatch, realtime.YOUNG)
    for _ in range(realtime.FULL_EVERY + 1):
        taken.idle(10**9 * MS)
    assert collections[-1] == 2
    collections.clear()
    for spare_ms, expected in ((29, []), (31, [1])):
        began = next(ticks) + 10
        taken.idle((began + spare_ms) * MS)
        assert collections == expected


@pytest.fixture
def slow_imports(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[list[str], threading.Event, threading.Event]]:
    """What was imported; set when the first of two is under way; it lasts until the second event."""
    told: list[str] = []
    begun, done = threading.Event(), threading.Event()

    def load(name: str) -> None:
        told.append(name)
        begun.set()
        done.wait()

    monkeypatch.setattr(realtime, "SELDOM", ("xdrlib_a", "xdrlib_b"))
    monkeypatch.setattr(realtime.importlib, "import_module", load)
    yield told, begun, done
    done.set()


def test_what_is_still_being_loaded_is_left_alone_and_then_lives_on(
    slow_imports: tuple[list[str], threading.Event, threading.Event],
    collections: list[int],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _, _, done = slow_imports
    loader = realtime.load_seldom()
    assert loader is not None
    taken = realtime.Collector(lambda: 0)
    taken.take_over(loader)
    try:
        collections.clear()
        made(monkeypatch, realtime.URGENT)
        taken.idle(40 * MS)
        assert collections == []
        done.set()
        loader.join()
        frozen = gc.get_freeze_count()
        taken.idle(40 * MS)
        assert collections == []
        assert gc.get_freeze_count() > frozen
        taken.idle(40 * MS)
        assert collections == [1]
    finally:
        taken.hand_back()


def test_a_daemon_that_ends_waits_for_one_module_only(
    slow_imports: tuple[list[str], threading.Event, threading.Event],
) -> None:
    told, begun, done = slow_imports
    loader = realtime.load_seldom()
    assert loader is not None
    taken = realtime.Collector()
    taken.take_over(loader)
    begun.wait()
    taken.hand_back()
    done.set()
    loader.join()
    assert told == ["xdrlib_a"]


def test_one_thread_unless_the_environment_says_otherwise() -> None:
    environ = {"OMP_NUM_THREADS": "4"}
    realtime.single_threads(environ)
    assert environ == {"OMP_NUM_THREADS": "4", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


def test_seldom_needed_modules_are_loaded_on_a_thread_or_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("xdrlib_a", "xdrlib_b")
    told: list[tuple[str, bool]] = []
    main = threading.main_thread()

    def load(name: str) -> None:
        told.append((name, threading.current_thread() is main))

    monkeypatch.setattr(realtime, "SELDOM", names)
    monkeypatch.setattr(realtime.importlib, "import_module", load)
    thread = realtime.load_seldom()
    assert thread is not None
    thread.join()
    assert realtime.load_seldom(wait=True) is None
    assert told == [(names[0], False), (names[1], False), (names[0], True), (names[1], True)]
    monkeypatch.setattr(realtime, "SELDOM", ("sys",))
    assert realtime.load_seldom() is None


def test_what_is_off_asks_for_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("sched_setaffinity", "sched_setscheduler"):
        monkeypatch.setattr(realtime.os, name, None)
    monkeypatch.setattr(realtime.ctypes, "CDLL", None)
    realtime.apply(RealtimeConfig(), pytest.fail)


@pytest.mark.skipif(sys.platform != "linux", reason="cores are chosen on Linux")
def test_the_daemon_stays_on_its_cores() -> None:
    before = os.sched_getaffinity(0)
    seen: list[set[int]] = []

    def run() -> None:  # on a thread of its own: cores are a thread's
        realtime.apply(RealtimeConfig(cpu=(min(before),)), pytest.fail)
        seen.append(os.sched_getaffinity(0))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert seen == [{min(before)}]
    assert os.sched_getaffinity(0) == before


def test_a_core_that_there_is_not_is_a_mistake() -> None:
    with pytest.raises(ConfigError, match=r"^realtime\.cpu: expected cores among \[.*\], got \[0, 4095\]$"):
        realtime.apply(RealtimeConfig(cpu=(4095, 0)), pytest.fail)


def test_a_priority_that_is_refused_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(pid: int, policy: int, param: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    said: list[str] = []
    monkeypatch.setattr(realtime.os, "sched_setscheduler", refuse)
    realtime.apply(RealtimeConfig(priority=50), said.append)
    (line,) = said
    assert line.startswith("realtime.priority: SCHED_FIFO 50 refused (Operation not permitted), expected CAP_SYS_NICE")


@pytest.mark.parametrize("fails", [False, True])
def test_memory_is_locked_or_one_line_says_why_not(fails: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    class Libc:
        def __init__(self, name: None, use_errno: bool) -> None:
            pass

        def mlockall(self, flags: int) -> int:
            asked.append(flags)
            return -1 if fails else 0

    said: list[str] = []
    monkeypatch.setattr(realtime.ctypes, "CDLL", Libc)
    realtime.apply(RealtimeConfig(lock_memory=True), said.append)
    assert asked == [7]
    assert [line.partition(":")[0] for line in said] == (["realtime.lock_memory"] if fails else [])


def test_a_system_without_these_calls_flies_on(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("sched_setaffinity", "sched_setscheduler"):
        monkeypatch.delattr(realtime.os, name, raising=False)

    def no_library(name: None, use_errno: bool) -> None:
        raise OSError("no such library")

    monkeypatch.setattr(realtime.ctypes, "CDLL", no_library)
    said: list[str] = []
    realtime.apply(RealtimeConfig(cpu=(0,), priority=1, lock_memory=True), said.append)
    assert [line.partition(":")[0] for line in said] == [f"realtime.{n}" for n in ("cpu", "priority", "lock_memory")]


@pytest.mark.parametrize(("key", "value"), [("priority", 100), ("priority", -1), ("cpu", [-1]), ("lock_memory", 1)])
def test_a_value_out_of_range_names_its_key(key: str, value: object) -> None:
    with pytest.raises(ConfigError, match=rf"^configuration: realtime\.{key}"):
        parse_config({"realtime": {key: value}})


def test_the_hash_of_the_configuration_does_not_depend_on_the_machine() -> None:
    assert config_hash(parse_config({"realtime": {"priority": 5}})) == config_hash(parse_config({}))
    assert config_hash(parse_config({"tick_hz": 50})) != config_hash(Config())
