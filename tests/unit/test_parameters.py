"""The file of stored parameters, and the configuration that holds."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.config import Config, load_config, parse_config
from companion.errors import ConfigError
from companion.parameters import LiveParameters, load, store, with_stored
from companion.tunables import as_float32


class Rig:
    def __init__(self, file: Path | None) -> None:
        self.base = parse_config({"params": {"file": None if file is None else str(file)}})
        self.announced: list[str] = []
        self.applied: list[Config] = []
        self.refuses = ""
        start = with_stored(self.base)
        self.live = LiveParameters(self.base, start, apply=self._apply, announce=self.announced.append)

    def _apply(self, config: Config) -> None:
        if self.refuses:
            raise ConfigError(self.refuses)
        self.applied.append(config)


def test_a_write_is_applied_announced_and_typed_as_a_decimal() -> None:
    rig = Rig(None)
    assert rig.live.write("CA_CUSHION", as_float32(0.3)) is None
    assert rig.applied[-1].safety.cushion_m == 0.3
    assert rig.live.config is rig.applied[-1]
    assert rig.announced == ["CA_CUSHION"]


def test_what_holds_already_changes_nothing() -> None:
    rig = Rig(None)
    rig.live.config = parse_config({"safety": {"cushion_m": 0.123456789012}})
    assert rig.live.write("CA_CUSHION", as_float32(0.123456789012)) is None
    assert rig.applied == []
    assert rig.live.config.safety.cushion_m == 0.123456789012  # more digits than the wire carries


@pytest.mark.parametrize(("name", "value"), [("CA_CUSHION", -1.0), ("CA_FLOOR", 50.0), ("CA_KAPPA", float("nan"))])
def test_a_refused_write_changes_nothing(name: str, value: float) -> None:
    rig = Rig(None)
    why = rig.live.write(name, value)
    assert why is not None
    assert why.startswith("PARAM_SET: ")
    assert rig.live.config == rig.base
    assert rig.applied == rig.announced == []


def test_what_the_pilot_refuses_does_not_hold() -> None:
    rig = Rig(None)
    rig.refuses = "the policy asks for more"
    assert rig.live.write("CA_ACC_MAX", 2.0) == "the policy asks for more"
    assert rig.live.config == rig.base


def test_stored_and_loaded_again(tmp_path: Path) -> None:
    file = tmp_path / "parameters.toml"
    rig = Rig(file)
    rig.live.write("CA_CUSHION", as_float32(0.3))
    rig.live.write("CA_FLOOR", 1.0)
    assert rig.live.save() is None
    assert load(file) == {"CA_CUSHION": 0.3, "CA_FLOOR": 1.0}  # what differs, nothing else
    assert sorted(path.name for path in tmp_path.iterdir()) == ["parameters.toml"]  # no leftovers
    again = Rig(file)
    assert again.live.config == rig.live.config

    again.announced.clear()
    assert again.live.reset() is None
    assert again.live.config == again.base
    assert again.announced == ["CA_CUSHION", "CA_FLOOR"]
    assert again.live.restore() is None
    assert again.live.config == rig.live.config
    again.live.reset()
    assert again.live.save() is None
    assert load(file) == {}


def test_without_a_file_nothing_can_be_stored(tmp_path: Path) -> None:
    rig = Rig(None)
    assert rig.live.save() == "params.file: not configured, nothing can be stored"
    assert rig.live.restore() == "params.file: nothing is stored"
    assert Rig(tmp_path / "none.toml").live.restore() == "params.file: nothing is stored"


def test_a_folder_that_is_gone_is_told(tmp_path: Path) -> None:
    why = Rig(tmp_path / "gone" / "parameters.toml").live.save()
    assert why is not None
    assert "cannot be written (No such file or directory)" in why


def test_a_write_that_fails_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "parameters.toml"
    store(file, {"CA_CUSHION": 0.3})

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("companion.parameters.os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        store(file, {"CA_CUSHION": 0.5})
    assert load(file) == {"CA_CUSHION": 0.3}
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize(
    ("content", "expectation"),
    [
        (b"CA_CUSHION = ", "not TOML"),
        (b"\xff\xfe", "not TOML"),
        (b"CA_CUSHION = -1.0", r"CA_CUSHION: expected a number in \[0, 1e\+06\], got -1.0"),
        (b"CA_CUSHION = 'much'", "CA_CUSHION: expected a number"),
        (b"CA_CUSHION = true", "CA_CUSHION: expected a number"),
        (b"CA_CUSHION = nan", "CA_CUSHION: expected a number"),
        (b"[safety]\ncushion_m = 0.3", "safety: expected one of the parameters"),
        (b"CA_FLOOR = 50.0", r"limits\.arena_min: expected below arena_max"),
        (b"# " + b"x" * 70000, "at most 65536 bytes"),
    ],
)
def test_a_broken_file_is_one_line(tmp_path: Path, content: bytes, expectation: str) -> None:
    file = tmp_path / "parameters.toml"
    file.write_bytes(content)
    with pytest.raises(ConfigError, match=expectation) as caught:
        Rig(file)
    assert str(caught.value).startswith(f"{file}: ")
    assert "\n" not in str(caught.value)


def test_a_folder_in_its_place_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        Rig(tmp_path)


def test_a_relative_name_lies_beside_the_configuration(tmp_path: Path) -> None:
    (tmp_path / "vehicle.toml").write_text('[params]\nfile = "stored.toml"\n')
    assert load_config(tmp_path / "vehicle.toml").params.file == str(tmp_path / "stored.toml")
    (tmp_path / "vehicle.toml").write_text('[params]\nfile = "/var/lib/companion.toml"\n')
    assert load_config(tmp_path / "vehicle.toml").params.file == "/var/lib/companion.toml"
