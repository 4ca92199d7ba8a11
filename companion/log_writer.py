"""Writes a log off the control path: one thread behind a bounded queue.

Whoever appends does no more than that: `put` takes a microsecond, never waits, and never raises. What does not fit is
dropped, the newest first, and counted. In lockstep nothing may be missing and nobody is in a hurry: there `put` waits
for room instead. The thread is woken at the end of a tick (`kick`), when the control path is idle, so that the two
compete for the interpreter as little as possible; it writes what has collected, and once a second hands all of it to
the disk. A disk that fails ends the log and not the flight.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter, deque
from collections.abc import Callable
from typing import TypeAlias

from companion.clock import stopwatch_ns
from companion.log_files import LogFiles
from companion.types import NS_PER_S

log = logging.getLogger("companion")

MAX_ITEMS = 8192
MAX_BYTES = 32 << 20
FLUSH_S = 1.0

Write: TypeAlias = Callable[[LogFiles], None]


class LogWriter:
    """The thread. ``counts``: dropped (the queue was full), lost (after a failure), broken (could not be
    encoded). ``failure``: why nothing is written any more, or None.

    Args:
        files: started; the thread's own from now on.
        lossless: wait for room instead of dropping.
    """

    def __init__(self, files: LogFiles, *, lossless: bool, max_items: int = MAX_ITEMS, max_bytes: int = MAX_BYTES):
        self.counts: Counter[str] = Counter()
        self.failure: str | None = None
        self._files = files
        self._lossless = lossless
        self._max_items = max_items
        self._max_bytes = max_bytes
        self._queue: deque[tuple[Write | threading.Event, int]] = (
            deque()
        )  # append and popleft are atomic: no lock is needed
        self._bytes_in = self._bytes_out = 0  # each written by one thread only; their difference is what waits
        self._wake = threading.Event()
        self._room = threading.Event()
        self._stopping = False
        self._flushed_ns = stopwatch_ns()
        self._thread = threading.Thread(target=self._run, name="log", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def put(self, write: Write, size: int) -> None:
        """Have ``write`` called with the files by and by; ``size`` is about what it holds on to [bytes]."""
        if self._stopping or self.failure is not None:
            self.counts["lost"] += self.failure is not None
            return
        if self._is_full(size) and not self._wait_for_room(size):
            self.counts["dropped"] += 1
            return
        self._bytes_in += size
        self._queue.append((write, size))

    def kick(self) -> None:
        """Now is a good time to write."""
        if self._queue:
            self._wake.set()

    def flush(self) -> None:
        """Wait until everything put so far is with the system. Not for the control path."""
        if self._stopping or not self._thread.is_alive():
            return
        flushed = threading.Event()
        self._queue.append((flushed, 0))
        self._wake.set()
        flushed.wait()

    def close(self) -> None:
        """Write what waits and the index, and end the thread; putting afterwards does nothing."""
        if self._stopping:
            return
        self._stopping = True
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join()

    def fail(self, error: OSError) -> None:
        """The disk said no: nothing is written any more."""
        if self.failure is None:
            self.failure = f"{self._files.path}: the log ends here ({error.strerror or error})"
            self._files.abandon()

    def _is_full(self, size: int) -> bool:
        waiting = len(self._queue)
        return waiting >= self._max_items or (waiting > 0 and self._bytes_in - self._bytes_out + size > self._max_bytes)

    def _wait_for_room(self, size: int) -> bool:
        """In lockstep, until the thread has made some; otherwise there is none."""
        while self._lossless and self._is_full(size) and self._thread.is_alive():
            self._room.clear()
            self._wake.set()
            if self._is_full(size):
                self._room.wait(FLUSH_S)
        self._wake.set()
        return not self._is_full(size)

    def _run(self) -> None:
        while not self._stopping:
            self._wake.wait(FLUSH_S)
            self._wake.clear()
            self._drain()
            self._guarded(self._keep)
        self._drain()  # `put` takes nothing since `close`
        self._guarded(LogFiles.close)

    def _drain(self) -> None:
        for _ in range(len(self._queue)):  # what comes meanwhile waits for the flush that is due
            write, size = self._queue.popleft()
            if isinstance(write, threading.Event):  # somebody waits for a flush
                self._guarded(LogFiles.flush)
                write.set()
                continue
            self._guarded(write)
            self._bytes_out += size
            self._room.set()

    def _keep(self, files: LogFiles) -> None:
        """Once a second to the disk; then the next part, if this one is large."""
        now_ns = stopwatch_ns()
        if now_ns - self._flushed_ns >= FLUSH_S * NS_PER_S:
            self._flushed_ns = now_ns
            files.flush(sync=not self._lossless)  # a simulator's log need not outlive a power cut
        files.rotate_if_large()

    def _guarded(self, write: Write) -> None:
        """Nothing ends the thread: a disk that fails ends the log, a message that cannot be built only itself."""
        if self.failure is not None:
            return
        try:
            write(self._files)
        except OSError as error:
            self.fail(error)
        except Exception:
            if not self.counts["broken"]:
                log.exception("a message of the log could not be built")
            self.counts["broken"] += 1
