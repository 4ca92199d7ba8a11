"""What interpreter and system may do to a tick, kept out of it (``[realtime]``, docs/explanation/realtime.md).

Garbage is collected in the idle part of a period, libraries compute on one thread, what takes long to load and is
seldom needed is loaded beside the wait for the vehicle; cores, SCHED_FIFO and locked memory are asked for where
configured. None of it changes what the brain answers. Standard library only: it runs before numpy is imported.
"""

from __future__ import annotations

import ctypes
import gc
import importlib
import os
import sys
import threading
from collections.abc import Callable, MutableMapping, Sequence

from companion.clock import stopwatch_ns
from companion.config_realtime import RealtimeConfig
from companion.errors import ConfigError

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
# the second solver and the assignment of anonymous detections, in pieces: what they load, then they themselves
SELDOM = (
    "scipy.sparse",
    "osqp",
    "scipy.linalg",
    "scipy.special",
    "scipy.fft",
    "scipy.spatial",
    "scipy.optimize",
)

SWITCH_S = 0.001  # for which the thread of the log may keep the interpreter from the control thread; Python's: 0.005
YOUNG = 1_000  # containers made and not freed since the last collection, from which one is worth its time
URGENT = 50_000  # from which it no longer waits for an idle moment
FULL_EVERY = 64  # collections of the young between two of everything
MARGIN = 3.0  # an idle moment must be so many times longer than what such a collection last took
_FIRST_NS = 500_000  # what a collection is taken to last before one was measured

_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4  # mlockall(2)

Say = Callable[[str], None]


def single_threads(environ: MutableMapping[str, str] = os.environ) -> None:
    """Linear algebra on one thread, unless the environment says otherwise; takes effect before numpy is imported.

    The brain's matrices are small: a second thread only adds the wait for it.
    """
    for name in ONE_THREAD:
        environ.setdefault(name, "1")


class Loader(threading.Thread):
    """Imports modules one by one beside everything else, until `stop`."""

    def __init__(self, names: Sequence[str]) -> None:
        super().__init__(name="load")
        self._names = names
        self._stopped = False

    def run(self) -> None:
        for name in self._names:
            if self._stopped:
                return
            importlib.import_module(name)

    def stop(self) -> None:
        """Nothing more after the module in progress: the process does not end before its threads."""
        self._stopped = True


def load_seldom(*, wait: bool = False) -> Loader | None:
    """Import `SELDOM` on a thread of its own, or with ``wait`` here; returns the thread, None where none is needed.

    Loaded on first use instead, they would cost that tick a third of a second.
    """
    missing = [name for name in SELDOM if name not in sys.modules]
    loader = Loader(missing)
    if wait:
        loader.run()
    if wait or not missing:
        return None
    loader.start()
    return loader


def apply(config: RealtimeConfig, say: Say) -> None:
    """Ask for cores, priority and locked memory, for this thread and those that it starts from now on.

    Args:
        say: given one line for each that the system does not grant; the daemon flies on without it.
    Raises:
        ConfigError: ``realtime.cpu`` names a core that there is not.
    """
    if config.cpu:
        _choose_cores(config.cpu, say)
    if config.priority:
        _raise_priority(config.priority, say)
    if config.lock_memory:
        _lock_memory(say)


def _choose_cores(cores: tuple[int, ...], say: Say) -> None:
    if not hasattr(os, "sched_setaffinity"):
        say("realtime.cpu: this system has no sched_setaffinity, running on any core")
        return
    here = os.sched_getaffinity(0)
    if not set(cores) <= here:
        raise ConfigError(f"realtime.cpu: expected cores among {sorted(here)}, got {sorted(cores)}")
    os.sched_setaffinity(0, cores)


def _raise_priority(priority: int, say: Say) -> None:
    if not hasattr(os, "sched_setscheduler"):
        say("realtime.priority: this system has no SCHED_FIFO, running as an ordinary process")
        return
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        say(
            f"realtime.priority: SCHED_FIFO {priority} refused ({error.strerror}), expected CAP_SYS_NICE or an"
            f" RTPRIO limit of {priority} (systemd: LimitRTPRIO={priority}); running as an ordinary process"
        )


def _lock_memory(say: Say) -> None:
    """Pages are locked as they are first touched: all at once would also fill what is only reserved, such as stacks."""
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        failed = libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) != 0
    except (OSError, AttributeError):
        say("realtime.lock_memory: this system has no mlockall, memory is not locked")
        return
    if failed:
        say(
            f"realtime.lock_memory: refused ({os.strerror(ctypes.get_errno())}), expected CAP_IPC_LOCK or an unlimited"
            " MEMLOCK limit (systemd: LimitMEMLOCK=infinity); memory is not locked"
        )


class Collector:
    """Python's garbage collector, run between ticks instead of whenever enough was allocated; and the lock of threads.

    Reference counting frees nearly all that a tick makes; the collector finds cycles, which need not be found at once.
    """

    def __init__(self, stopwatch: Callable[[], int] = stopwatch_ns) -> None:
        self._stopwatch = stopwatch
        self._took_ns = [_FIRST_NS, 4 * _FIRST_NS]  # of the young, of everything
        self._young = 0  # collections since the last full one
        self._was_enabled, self._switch_s = False, sys.getswitchinterval()
        self._loading: Loader | None = None

    def take_over(self, loading: Loader | None = None) -> None:
        """From here on nothing is collected by itself, and what exists now is never walked: it lives to the end.

        So does what ``loading`` has made when it is done. A waiting thread gets the interpreter within `SWITCH_S`.
        """
        self._was_enabled = gc.isenabled()
        self._loading = loading
        self._switch_s = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_S)
        gc.collect()
        gc.freeze()
        gc.disable()

    def hand_back(self) -> None:
        """As it was before `take_over`; what is still being loaded is given up."""
        if self._loading is not None:
            self._loading.stop()
        sys.setswitchinterval(self._switch_s)
        gc.unfreeze()
        if self._was_enabled:
            gc.enable()

    def idle(self, until_ns: int) -> None:
        """Nothing to do until about ``until_ns`` on the stopwatch: collect if it is worth it and fits."""
        if self._loading is not None:
            if not self._loading.is_alive():
                self._loading = None
                gc.freeze()
            return
        made = gc.get_count()[0]
        if made < YOUNG:
            return
        began_ns = self._stopwatch()
        spare_ns = until_ns - began_ns
        full = self._young >= FULL_EVERY and spare_ns >= MARGIN * self._took_ns[1]
        if not full and made < URGENT and spare_ns < MARGIN * self._took_ns[0]:
            return
        gc.collect(2 if full else 1)
        self._took_ns[full] = self._stopwatch() - began_ns
        self._young = 0 if full else self._young + 1
