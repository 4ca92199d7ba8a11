"""Live parameters in the brain: the next tick uses them, everything remembered stays."""

from __future__ import annotations

import numpy as np
import pytest

from companion.config import Config, parse_config
from companion.errors import ConfigError
from companion.pilot import Pilot, PilotInput, PilotOutput
from companion.tunables import TUNABLES, Tunable, changed
from companion.types import Detection, DetectionFrame, DetectionKind, VehicleState, frozen

TICK_NS = 50_000_000
TARGET = frozen([6.0, 0.0, 2.0])


def inputs(tick: int, *, v: float = 1.0) -> PilotInput:
    """Flying east past a ball that stands a little aside of the way."""
    stamp_ns = tick * TICK_NS
    seen = Detection("ball", frozen([4.0, 0.15, 2.0]), 0.2, p_std_m=0.05)
    frame = DetectionFrame(stamp_ns, "test", tick, DetectionKind.DETECTION, (seen,))
    vehicle = VehicleState(stamp_ns, frozen([0.05 * v * tick, 0.0, 2.0]), frozen([v, 0.0, 0.0]))
    return PilotInput(vehicle, (frame,), target_enu=TARGET)


def fly(pilot: Pilot, first: int, last: int) -> list[PilotOutput]:
    return [pilot.step(inputs(tick)) for tick in range(first, last)]


def same(one: list[PilotOutput], other: list[PilotOutput]) -> bool:
    return all(np.array_equal(a.result.a_safe, b.result.a_safe) for a, b in zip(one, other, strict=True))


def test_the_same_configuration_again_changes_not_a_bit() -> None:
    plain, retuned = Pilot(Config()), Pilot(Config())
    fly(plain, 1, 30)
    fly(retuned, 1, 30)
    retuned.retune(Config())
    assert same(fly(plain, 30, 60), fly(retuned, 30, 60))


def test_a_larger_cushion_is_in_the_rows_of_the_next_tick_and_tracks_stay() -> None:
    pilot = Pilot(Config())
    fly(pilot, 1, 20)
    before = pilot.tracks()
    pilot.retune(changed(Config(), {"CA_CUSHION": 0.75, "CA_RADIUS": 0.5}))
    assert pilot.tracks().ids == before.ids == ("test/ball",)
    (output,) = fly(pilot, 20, 21)
    (row,) = [row for row in output.result.rows if row.track == "test/ball" and row.step >= 0]
    assert row.margin is not None
    assert row.margin.cushion == 0.75
    assert row.margin.radii == pytest.approx(0.7)
    assert pilot.tracks().age_s[0] == 0.0


def test_retuned_in_flight_it_equals_a_pilot_that_knew_from_the_start() -> None:
    """Where nothing remembered depends on the margins (no obstacle near), only the constants count."""
    new = changed(Config(), {"CA_SPEED_MAX": 1.5, "CA_CEILING": 2.5, "CA_KAPPA": 3.0})
    knew, learnt = Pilot(new), Pilot(Config())
    for tick in range(1, 11):
        learnt.step(PilotInput(inputs(tick).vehicle))
        knew.step(PilotInput(inputs(tick).vehicle))
    learnt.retune(new)
    assert same(
        [knew.step(PilotInput(inputs(tick, v=1.4).vehicle, target_enu=TARGET)) for tick in range(11, 40)],
        [learnt.step(PilotInput(inputs(tick, v=1.4).vehicle, target_enu=TARGET)) for tick in range(11, 40)],
    )


def test_less_acceleration_holds_at_once_for_a_law_of_ones_own() -> None:
    class Full:
        def act(self, v_enu: object, error_enu: object) -> object:
            return frozen([3.0, 3.0, 3.0])

    pilot = Pilot(Config(), Full())  # type: ignore[arg-type]
    fly(pilot, 1, 5)
    pilot.retune(changed(Config(), {"CA_ACC_MAX": 1.0}))
    for output in fly(pilot, 5, 40):
        assert np.abs(output.wire).max() <= 1.0 + 1e-9


def test_less_acceleration_than_the_policy_asks_for_is_refused_and_nothing_changes() -> None:
    plain, refused = Pilot(Config()), Pilot(Config())
    fly(plain, 1, 10)
    fly(refused, 1, 10)
    with pytest.raises(ConfigError, match=r"k_ma_m_s2: expected at most limits\.acceleration_m_s2 2\.0, got"):
        refused.retune(changed(Config(), {"CA_ACC_MAX": 2.0, "CA_CUSHION": 1.0}))
    assert same(fly(plain, 10, 40), fly(refused, 10, 40))


def test_what_shapes_the_state_cannot_be_retuned() -> None:
    pilot = Pilot(Config())
    for raw in ({"safety": {"horizon": 10}}, {"tracking": {"coast_s": 2.0}}, {"delay": {"loop_s": 0.1}}):
        with pytest.raises(ConfigError, match="live parameters only"):
            pilot.retune(parse_config(raw))


@pytest.mark.parametrize("tunable", TUNABLES, ids=lambda tunable: tunable.name)
def test_no_value_that_is_accepted_makes_the_brain_fail(tunable: Tunable) -> None:
    """FAULT in flight because of a typing error would be worse than the typing error."""
    bounds, smallest = tunable.bounds, 1.401298464324817e-45  # of the float32 above 0
    accepted = 0
    for value in (bounds.low, bounds.low + smallest, 1e-3, 1.0, 1e3, bounds.high - 1.0, bounds.high):
        pilot = Pilot(Config())
        fly(pilot, 1, 6)
        try:
            pilot.retune(changed(Config(), {tunable.name: value}))
        except ConfigError:
            continue
        accepted += 1
        for output in fly(pilot, 6, 12):
            assert np.isfinite(output.wire).all()
            assert np.abs(output.wire).max() <= max(3.0, value) + 1e-9
    assert accepted >= 2
