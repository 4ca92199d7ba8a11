"""``[realtime]``: what the operating system is asked for, so that nothing else delays a tick. All off by default."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from companion.config_types import Section


class RealtimeConfig(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    cpu: Annotated[tuple[Annotated[int, Meta(ge=0, le=4095)], ...], Meta(max_length=64)] = ()  # cores; none: any
    priority: Annotated[int, Meta(ge=0, le=99)] = 0  # SCHED_FIFO; 0: an ordinary process
    lock_memory: bool = False  # no page of the daemon is ever swapped out
