"""The fixture that users get: a flying pair, in real time, over real sockets."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from sim_bridge.testing import FlyingPair

pytestmark = pytest.mark.integration


def test_engage_fly_and_release(flying_pair: Callable[..., FlyingPair]) -> None:
    pair = flying_pair(target=(1.0, 0.0, 2.0))
    pair.engage()
    status = pair.wait_status(lambda s: s["state"] == "ACTIVE")
    assert status["engaged"]
    assert status["target"] == [1.0, 0.0, 2.0]
    pair.ground_station.command(92, 0.0, component=196)  # release
    status = pair.wait_status(lambda s: s["state"] == "READY")
    assert not status["engaged"]


def test_a_pilot_who_takes_over_is_not_fought(flying_pair: Callable[..., FlyingPair]) -> None:
    pair = flying_pair()
    pair.engage()
    pair.wait_status(lambda s: s["state"] == "ACTIVE")
    pair.ground_station.command(176, 1.0, 4.0, 3.0)  # DO_SET_MODE to Hold
    status = pair.wait_status(lambda s: s["state"] == "OVERRIDDEN")
    assert not status["engaged"]
    pair.engage()
    pair.wait_status(lambda s: s["state"] == "ACTIVE")


def test_a_required_source_that_falls_silent_leads_to_hold(flying_pair: Callable[..., FlyingPair]) -> None:
    pair = flying_pair(overrides=['obstacles.required=["radar"]'])
    for _ in range(20):
        pair.publish("radar", [{"id": "ball", "position": [5.0, 5.0, 2.0], "radius": 0.2, "position_std": 0.1}])
    pair.engage()
    status = pair.wait_status(lambda s: s["state"] == "HOLD")
    assert "radar" in status["reason"]
