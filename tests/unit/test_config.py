"""Configuration: every mistake is one line that names the file, the key and the expectation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from companion.config import PRESETS, Config, apply_overrides, config_hash, load_config, parse_config
from companion.errors import ConfigError

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    ("raw", "key", "expectation"),
    [
        ({"nonsense": 1}, "nonsense", "unknown field"),
        ({"safety": {"alpha3": 1.0}}, "safety", "unknown field `alpha3`"),
        ({"safety": {"alpha1": 1.5}}, "safety.alpha1", "<= 1.0"),
        ({"safety": {"horizon": 2.5}}, "safety.horizon", "`int`"),
        ({"safety": {"preset": "papre"}}, "safety.preset", "enum"),
        ({"vehicle": {"name": "a/b"}}, "vehicle.name", "regex"),
        ({"vehicle": {"profile": "betaflight"}}, "vehicle.profile", "enum"),
        ({"mavlink": {"system_id": 0}}, "mavlink.system_id", ">= 1"),
        ({"mavlink": {"heartbeat_timeout_s": float("nan")}}, "mavlink.heartbeat_timeout_s", "> 0"),
        ({"target": {"position": [1.0, 2.0]}}, "target.position", "length 3"),
        ({"target": {"position": [50.0, 0.0, 1.0]}}, "target.position", "inside limits.arena"),
        ({"target": {"yaw": 0.5}}, "target", "unknown field `yaw`"),
        ({"tick_hz": 240}, "tick_hz", "whole milliseconds"),
        ({"limits": {"arena_min": [0.0, 0.0, 5.0], "arena_max": [1.0, 1.0, 4.0]}}, "limits.arena_min", "axis z"),
        ({"lockstep_sources": ["sim"]}, "lockstep_sources", "lockstep"),
        ({"obstacles": "radar"}, "obstacles", "object"),
    ],
)
def test_mistakes_are_pointed_at(raw: dict[str, Any], key: str, expectation: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_config(raw, source="vehicle.toml")
    message = str(caught.value)
    assert message.startswith("vehicle.toml: ")
    assert key in message
    assert expectation in message
    assert "\n" not in message


def test_missing_and_damaged_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"absent.toml: cannot be read"):
        load_config(tmp_path / "absent.toml")
    (tmp_path / "bad.toml").write_text("a = [1,", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"bad.toml: not TOML"):
        load_config(tmp_path / "bad.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match=r"binary.toml: not TOML"):
        load_config(tmp_path / "binary.toml")


def test_paper_preset_is_literal_and_can_be_overridden() -> None:
    paper = parse_config({"safety": {"preset": "paper"}, "tracking": {"preset": "paper"}})
    assert (paper.safety.form, paper.safety.horizon, paper.safety.kappa) == ("paper", 5, 0.0)
    assert (paper.safety.alpha1, paper.safety.alpha2, paper.safety.epsilon_max) == (0.8, 0.5, 2.0)
    assert (paper.safety.lambda_u, paper.safety.lambda_epsilon, paper.safety.lambda_delta) == (1.0, 10.0, 1e4)
    assert (paper.tracking.q_paper, paper.tracking.measurement_variance_m2) == (0.05, 0.05)
    assert paper.tracking.stay_probability == (0.6, 0.6, 0.6)
    assert parse_config({"safety": {"preset": "paper", "horizon": 7}}).safety.horizon == 7


def test_presets_name_existing_keys() -> None:
    for section, presets in PRESETS.items():
        for values in presets.values():
            assert set(values) <= set(getattr(Config(), section).__struct_fields__)


def test_overrides_take_toml_values_and_strings() -> None:
    raw = apply_overrides({}, ("safety.horizon=5", "mavlink.url=udpin://127.0.0.1:1", 'vehicle.name="x"'))
    assert raw == {"safety": {"horizon": 5}, "mavlink": {"url": "udpin://127.0.0.1:1"}, "vehicle": {"name": "x"}}
    with pytest.raises(ConfigError, match=r"section\.key=value"):
        apply_overrides({}, ("safety.horizon",))
    with pytest.raises(ConfigError, match="is not a section"):
        apply_overrides({"tick_hz": 20}, ("tick_hz.x=1",))


def test_profile_fills_what_the_file_leaves_out() -> None:
    assert parse_config({"vehicle": {"profile": "px4"}}).rate_hz == 50
    assert parse_config({"vehicle": {"profile": "px4"}}).engage_by == "mode_switch"
    assert parse_config({"vehicle": {"profile": "px4"}, "engage": {"by": "command"}}).engage_by == "command"
    assert parse_config({"delay": {"actuation_s": 0.0}}).actuation_s == 0.0


def test_hash_sees_every_value_but_the_log() -> None:
    base = config_hash(parse_config({}))
    assert config_hash(parse_config({"log": {"directory": "/tmp/x"}})) == base
    assert config_hash(parse_config({"safety": {"kappa": 3.0}})) != base


def test_default_file_is_the_defaults() -> None:
    """configs/default.toml documents every default; it must not drift from the code."""
    assert load_config(ROOT / "configs" / "default.toml") == Config()


def test_a_confirmation_that_can_never_come_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"tracking\.confirm_hits: expected at most confirm_frames \+ 1 = 4, got 5"):
        parse_config({"tracking": {"confirm_hits": 5, "confirm_frames": 3}})


def test_the_disturbance_estimate_must_leave_the_vehicle_something() -> None:
    """Reserves of the whole box would turn the reference round."""
    with pytest.raises(
        ConfigError, match=r"limits\.acceleration_m_s2: expected more than disturbance\.bound_m_s2 = 0\.3"
    ):
        parse_config({"limits": {"acceleration_m_s2": 0.3}})
    assert parse_config({"limits": {"acceleration_m_s2": 0.2}, "disturbance": {"enabled": False}})
