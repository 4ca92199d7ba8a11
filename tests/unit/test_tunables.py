"""The table of live parameters: names, ranges, what a change may and may not do."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from companion.config import Config, parse_config
from companion.errors import ConfigError
from companion.link.mavlink import MavlinkCodec
from companion.tunables import (
    BY_NAME,
    TUNABLES,
    Bounds,
    as_float32,
    changed,
    from_float32,
    only_tunables_differ,
    reference,
    values,
)

ROOT = Path(__file__).parents[2]


def test_names_fit_the_protocol_and_are_sorted() -> None:
    names = [tunable.name for tunable in TUNABLES]
    assert names == sorted(set(names))  # the order of the indices does not depend on who edits the table
    assert all(1 <= len(name) <= 16 and name.isascii() and name.upper() == name for name in names)
    assert len({tunable.path for tunable in TUNABLES}) == len(TUNABLES)


def test_every_parameter_reads_and_writes_its_own_setting() -> None:
    config = Config()
    for tunable in TUNABLES:
        value = tunable.of(config) + 0.125
        new = changed(config, {tunable.name: value})
        assert values(new) == {**values(config), tunable.name: value}
        assert new != config
        assert only_tunables_differ(config, new)


def test_ranges_are_those_of_the_configuration() -> None:
    assert BY_NAME["CA_CUSHION"].bounds == Bounds(0.0, 1e6)
    assert BY_NAME["CA_RADIUS"].bounds == Bounds(0.0, 1e6, low_open=True)
    assert BY_NAME["CA_FLOOR"].bounds == Bounds(-1e4, 1e4)
    assert str(BY_NAME["CA_RADIUS"].bounds) == "(0, 1e+06]"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("CA_CUSHION", -0.001),
        ("CA_CUSHION", 1.0001e6),
        ("CA_RADIUS", 0.0),
        ("CA_KAPPA", math.nan),
        ("CA_KAPPA", math.inf),
        ("CA_ARENA_W", -math.inf),
        ("CA_SPEED_MAX", True),
    ],
)
def test_a_value_out_of_range_is_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(ConfigError, match=rf"^PARAM_SET: {name}: expected a number in [\[(]"):
        changed(Config(), {name: value}, source="PARAM_SET")


def test_what_the_configuration_refuses_as_a_whole_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"limits\.arena_min: expected below arena_max on axis z"):
        changed(Config(), {"CA_FLOOR": 20.0})
    assert changed(Config(), {"CA_FLOOR": 20.0, "CA_CEILING": 30.0}).limits.arena_min[2] == 20.0  # together they can
    with pytest.raises(ConfigError, match=r"limits\.acceleration_m_s2: expected more than disturbance\.bound_m_s2"):
        changed(Config(), {"CA_ACC_MAX": 0.25})
    with pytest.raises(ConfigError, match=r"target\.position: expected x inside"):
        changed(parse_config({"target": {"position": [5.0, 0.0, 2.0]}}), {"CA_ARENA_E": 4.0})
    with pytest.raises(ConfigError, match=r"CA_NOTHING: expected one of the parameters CA_ACC_MAX"):
        changed(Config(), {"CA_NOTHING": 1.0})


def test_a_preset_survives_a_change() -> None:
    paper = parse_config({"safety": {"preset": "paper"}, "tracking": {"preset": "paper"}})
    new = changed(paper, {"CA_KAPPA": 1.5})
    assert (new.safety.kappa, new.safety.horizon, new.tracking.turn_rate) == (1.5, 5, "window")
    assert only_tunables_differ(paper, new)


def test_other_settings_are_told_apart() -> None:
    assert not only_tunables_differ(Config(), parse_config({"safety": {"horizon": 10}}))
    assert not only_tunables_differ(Config(), parse_config({"limits": {"tilt_deg": 30.0}}))


def test_a_float32_comes_back_as_the_decimal_that_was_typed() -> None:
    for text in ("0.1", "0.3", "6", "1e-05", "9999.5", "-0.25", "123456.78"):
        assert from_float32(as_float32(float(text))) == pytest.approx(float(text), rel=1e-7)
    assert [from_float32(as_float32(x)) for x in (0.1, 0.3, 1e-05, 9999.5)] == [0.1, 0.3, 1e-05, 9999.5]
    assert math.isnan(from_float32(math.nan))


def test_the_page_is_the_table() -> None:
    """docs/reference/parameters.md is generated; it must not drift from the code."""
    assert reference() in (ROOT / "docs" / "reference" / "parameters.md").read_text(encoding="utf-8")


def test_the_largest_acceleration_is_one_that_can_be_sent() -> None:
    """A setpoint that the wire refuses means FAULT."""
    largest = BY_NAME["CA_ACC_MAX"].bounds.high
    assert MavlinkCodec(system=1).encode_setpoint(0, np.full(3, largest), 0x0C3F)
