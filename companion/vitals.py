"""How the daemon is: the control task's pulse, what systemd is told, and the reading behind the metrics."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from companion import __version__
from companion.clock import Clock
from companion.config import Config, config_hash
from companion.health import Pulse, report
from companion.instruments import Reading
from companion.link.inbox import ObstacleInbox
from companion.link.router import Router
from companion.metrics import TickMeter
from companion.publisher import Publisher
from companion.sdnotify import Notifier
from companion.session import VehicleSession
from companion.types import Verdict

Groups = Mapping[str, Mapping[str, int]]


class Vitals:
    """One daemon's pulse and instruments. Only ``beat``, which the control task calls, says that it lives.

    Args:
        groups: every counter that is not asked of the other parts, by part of the daemon.
        vehicle_ns: the stamp of the newest vehicle state.
    """

    def __init__(
        self,
        clock: Clock,
        notifier: Notifier,
        session: VehicleSession,
        meter: TickMeter,
        inbox: ObstacleInbox,
        router: Router,
        groups: Callable[[], Groups],
        vehicle_ns: Callable[[], int],
    ) -> None:
        self._pulse = Pulse(clock)
        self._notifier = notifier
        self._session = session
        self._meter = meter
        self._inbox = inbox
        self._router = router
        self._groups = groups
        self._vehicle_ns = vehicle_ns
        self._publisher: Publisher | None = None
        self._hashed: tuple[Config, str] | None = None

    def up(self, publisher: Publisher) -> None:
        """Every link is open."""
        self._publisher = publisher
        self._notifier.ready()

    def beat(self) -> None:
        """The control task has made a turn."""
        situation = self._session.situation
        self._notifier.alive(self._pulse.beat(), f"{situation.state.value}: {situation.reason}")

    def stopping(self) -> None:
        self._notifier.stopping()

    def close(self) -> None:
        self._notifier.close()

    def health(self, *, live_only: bool = False) -> tuple[int, dict[str, Any]]:
        """HTTP status and body of `/healthz`, or of `/livez`."""
        return report(self._pulse.age_s, self._session.situation, live_only=live_only)

    def reading(self) -> Reading:
        """The daemon's numbers now."""
        session, meter, publisher = self._session, self._meter, self._publisher
        config = session.config
        return Reading(
            version=__version__,
            config_hash=self._hash(config),
            vehicle=config.vehicle.name,
            profile=config.vehicle.profile,
            situation=session.situation,
            armed=session.armed,
            beat_age_s=self._pulse.age_s,
            verdicts={verdict.value: 0 for verdict in Verdict} | meter.verdicts,
            bucket_counts=tuple(meter.bucket_counts),
            latency_sum_s=meter.latency_sum_ms / 1e3,
            deadline_misses=meter.deadline_misses,
            states_skipped=meter.states_skipped,
            tracks=0 if publisher is None else publisher.tracks,
            agile=0 if publisher is None else len(publisher.agile),
            warnings=len(session.watch.notices.standing),
            accepted=self._inbox.accepted,
            source_age_s={n: s for n, s in self._inbox.ages_s(self._vehicle_ns()).items() if s is not None},
            groups={
                **self._groups(),
                "router": self._router.counts,
                "zenoh": {} if publisher is None else publisher.zenoh_counts,
                "log": {} if publisher is None else publisher.log_counts,
            },
            links=tuple(link.counts for link in self._router.links),
            log_failed=publisher is not None and publisher.log_failure is not None,
        )

    def _hash(self, config: Config) -> str:
        """Worked out once a configuration: live parameters bring a new one."""
        if self._hashed is None or self._hashed[0] is not config:
            self._hashed = config, config_hash(config)
        return self._hashed[1]
