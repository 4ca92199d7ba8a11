"""Configuration: TOML decoded once into frozen typed values; defaults live here, files only override.

An unknown key, a wrong type or a value out of range is a `ConfigError` whose one line names the file and the key.
``preset = "paper"`` in ``[tracking]`` or ``[safety]`` starts that section from the paper's literal values.
"""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from companion.config_check import check_arena, check_confirmation, check_reserve, check_ros2, check_tick, pointed
from companion.config_links import MavlinkConfig, Ros2Config, ZenohConfig
from companion.config_realtime import RealtimeConfig
from companion.config_traffic import UNTRUSTED, TrafficConfig, check_traffic
from companion.config_types import Acceleration, Name, NonNegative, Point, Positive, Section, SourceName, Stay
from companion.errors import ConfigError
from companion.profiles import PROFILES, UNDECIDED, Profile


class VehicleConfig(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    name: Name = "uav1"  # the Zenoh prefix is uav/<name>
    profile: Literal["crazyflie-sim", "px4", "ardupilot", "auto"] = "crazyflie-sim"  # auto: px4 or ardupilot, as heard
    setpoint: Literal["acceleration", "velocity+acceleration"] = "acceleration"  # the latter for autopilots that damp
    source: Literal["mavlink", "zenoh"] = "mavlink"
    stale_s: Positive = 0.5  # a vehicle state older than this is no longer fresh


class TargetConfig(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    position: Point | None = None  # local ENU [m]; None: hold where engaged


class EngageConfig(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    by: Literal["profile", "command", "mode_switch"] = "profile"
    stream_s: NonNegative = 0.5  # setpoints streamed before the external mode is asked for
    timeout_s: Positive = 3.0


class ObstaclesConfig(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    required: tuple[str, ...] = ()  # sources whose silence while ACTIVE leads to HOLD
    silent_s: Positive = 1.0
    max_age_s: Positive = 0.5
    queue: Annotated[int, Meta(ge=1, le=4096)] = 64
    per_tick: Annotated[int, Meta(ge=1, le=4096)] = 3  # frames of a source that a tick uses; a faster one is thinned


class TrackingConfig(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Process noises in physical units: 1-sigma of the white input of each model, per sqrt(Hz)."""

    preset: Literal["default", "paper"] = "default"
    backend: Literal["batched", "reference"] = "batched"  # the same filter; reference: plainly on filterpy, and slow
    dt_s: Positive = 0.05  # the grid for which per-step constants are stated
    accel_psd_cv: Positive = 4e-4  # white acceleration PSD of CV [m^2/s^3]
    jerk_psd_ca: Positive = 32.0  # white jerk PSD of CA [m^2/s^5]
    accel_psd_ct: Positive = 0.006  # white acceleration PSD of CT [m^2/s^3]
    accel_memory_s: Annotated[float, Meta(ge=0.0, le=5.0)] = (
        0.2  # CA's acceleration dies out with it (Singer); 0: it lasts
    )
    turn_psd_ct: Positive = 0.05  # white turn acceleration PSD of CT [rad^2/s^3]
    q_paper: NonNegative = 0.0  # > 0: Q = q_paper I per dt_s for every model (Remark 1)
    measurement_variance_m2: Positive = 0.05  # used where a detection states no position_std (Remark 1)
    force_measurement_variance: bool = False  # True: ignore stated position_std
    stay_probability: tuple[Stay, Stay, Stay] = (0.9935, 0.997, 0.986)  # pi_jj of CV, CA, CT per dt_s, the rest shared
    turn_rate: Literal["state", "window"] = "state"  # of CT: an extended state, or the heading change over turn_window
    turn_window: Annotated[int, Meta(ge=2, le=200)] = 20  # updates
    turn_std_rad_s: Positive = 4.0  # turn rate of a new track, and what CV and CA know about it
    birth_speed_m_s: Positive = 3.0  # 1-sigma of each velocity axis of a new track
    birth_accel_m_s2: Positive = 3.0  # the same of its acceleration
    jump_sigma: Positive = 10.0  # a named detection farther off is skipped once, then the track restarts there
    likelihood_window: Annotated[int, Meta(ge=1, le=20)] = 1  # updates
    velocity_std_m_s: Positive = 0.5  # used where a detection states a velocity without its deviation
    nis_memory_s: Positive = 3.0  # over which the innovations of a track's predictions are averaged
    nis_bound: Positive = 0.97  # their root mean square, 1 for true models, above which a track breaks its own
    inflation_max: Annotated[float, Meta(ge=1.0, le=100.0)] = 10.0  # most that this widens its predictions; 1: never
    gate_sigma: Positive = 4.0
    coast_s: Positive = 1.0  # a track without measurement is dropped after this
    max_tracks: Annotated[int, Meta(ge=1, le=1024)] = 128  # trusted ones first, then the nearest to the vehicle
    replay_s: Annotated[float, Meta(ge=0.0, le=5.0)] = 0.5  # a frame this late is still used at its own stamp; 0: off
    confirm_hits: Annotated[int, Meta(ge=1, le=20)] = 2  # detections that confirm an anonymous track; 1: at once
    confirm_frames: Annotated[int, Meta(ge=1, le=100)] = 3  # of its source after the first in which they must come
    merge_s: Annotated[float, Meta(ge=0.0, le=60.0)] = 1.0  # tracks that agree for this long become one; 0: never
    untrusted: tuple[SourceName, ...] = UNTRUSTED  # they may add obstacles but never move or end those of others


class PolicyConfig(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    artifact: str = "builtin:default"  # a folder, or builtin:NAME
    backend: Literal["onnx", "torch"] = "onnx"
    capture_radius_m: NonNegative = 0.6  # inside it the documented hold law flies
    hold_kp: NonNegative = 2.0  # [1/s^2]
    hold_kd: NonNegative = 3.0  # [1/s]


class SafetyConfig(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Table 1 of the paper and the readings of the design, 5.1 to 5.10."""

    preset: Literal["default", "paper"] = "default"
    filter: Literal["acbf", "none"] = "acbf"
    form: Literal["sphere", "paper"] = "sphere"  # 1/2(|r|^2 - D^2), or (22) to the letter
    horizon: Annotated[int, Meta(ge=0, le=100)] = 20
    dt_s: Positive = 0.05
    alpha1: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.8
    alpha2: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.5
    epsilon_max: Positive = 2.0
    eta: Annotated[float, Meta(gt=0.0, lt=1.0)] = 0.5
    lambda_u: Positive = 1.0
    lambda_epsilon: Positive = 0.01
    lambda_delta: Positive = 0.01
    drone_radius_m: Positive = 0.2
    cushion_m: NonNegative = 0.1
    kappa: NonNegative = 2.0
    kappa_now: NonNegative = 1.0  # of the present sigma, on top: every tick has that error, a prediction is corrected
    sigma_growth_s: NonNegative = 0.7  # predicted sigma counts up to this far ahead; the next looks correct the rest
    sigma_cap_m: Positive = 2.0  # kappa sigma counts no further than this: a track just born is no wall
    sigma_delay_s: NonNegative = 0.01
    braking: bool = True  # brake before what is too large to swerve round within the horizon
    recovery: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.2  # least decay of psi per dt_s inside the keep-out distance
    solver: Literal["daqp", "osqp"] = "daqp"
    iterations: Annotated[int, Meta(ge=1, le=50)] = 4
    tolerance_m_s2: Positive = 1e-6


class LimitsConfig(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    acceleration_m_s2: Acceleration = 3.0  # each axis, net of gravity
    norm_m_s2: Positive | None = None  # of the whole net acceleration
    tilt_deg: Annotated[float, Meta(gt=0.0, lt=90.0)] | None = 45.0  # of the thrust (PX4: MPC_TILTMAX_AIR)
    slew_m_s3: Positive | None = None  # each axis, how fast a setpoint may change; None: the profile's
    speed_m_s: Positive = 6.0
    arena_min: Point = (-10.0, -10.0, 0.3)  # floor is the third component
    arena_max: Point = (10.0, 10.0, 10.0)


class DelayConfig(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    loop_s: NonNegative = 0.0  # configured time from state to setpoint at the autopilot
    actuation_s: NonNegative | None = None  # None: the profile's


class DisturbanceConfig(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    enabled: bool = True
    bandwidth_hz: Annotated[float, Meta(gt=0.0, le=0.5)] = 0.3
    bound_m_s2: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.3


class ParamsConfig(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    file: str | None = None  # live parameters that an operator has stored, beside this file; None: none can be


class LogConfig(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    directory: str | None = None  # None: no log
    max_mb: Annotated[float, Meta(ge=1.0, le=1e6)] = 512.0  # of one file; a longer flight goes on in the next
    keep_mb: Annotated[float, Meta(ge=1.0, le=1e8)] = 4096.0  # of all flights in the folder; the oldest are removed
    keep_files: Annotated[int, Meta(ge=1, le=1_000_000)] = 1000
    tlog: bool = True  # every MAVLink packet in flight.tlog beside it, for QGroundControl and mavlogdump
    scene_hz: Annotated[float, Meta(ge=0.0, le=100.0)] = 10.0  # pictures for Foxglove; 0: none


class Config(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    mode: Literal["normal", "monitor"] = "normal"
    sync: Literal["none", "lockstep"] = "none"
    lockstep_sources: tuple[str, ...] = ()  # sources whose markers each tick waits for
    tick_hz: Annotated[int, Meta(ge=1, le=400)] | None = None  # None: the profile's
    vehicle: VehicleConfig = VehicleConfig()
    mavlink: MavlinkConfig = MavlinkConfig()
    zenoh: ZenohConfig = ZenohConfig()
    target: TargetConfig = TargetConfig()
    engage: EngageConfig = EngageConfig()
    obstacles: ObstaclesConfig = ObstaclesConfig()
    ros2: Ros2Config = Ros2Config()
    traffic: TrafficConfig = TrafficConfig()
    tracking: TrackingConfig = TrackingConfig()
    policy: PolicyConfig = PolicyConfig()
    safety: SafetyConfig = SafetyConfig()
    limits: LimitsConfig = LimitsConfig()
    delay: DelayConfig = DelayConfig()
    disturbance: DisturbanceConfig = DisturbanceConfig()
    log: LogConfig = LogConfig()
    params: ParamsConfig = ParamsConfig()
    realtime: RealtimeConfig = RealtimeConfig()

    @property
    def profile(self) -> Profile:
        """The vehicle's; a stand-in under which nothing is sent while ``auto`` is open."""
        return PROFILES.get(self.vehicle.profile, UNDECIDED)

    @property
    def type_mask(self) -> int:
        return self.profile.mask(self.vehicle.setpoint)

    @property
    def rate_hz(self) -> int:
        return self.tick_hz if self.tick_hz is not None else self.profile.tick_hz

    @property
    def engage_by(self) -> str:
        return self.profile.engage_by if self.engage.by == "profile" else self.engage.by

    @property
    def actuation_s(self) -> float:
        return self.profile.actuation_lag_s if self.delay.actuation_s is None else self.delay.actuation_s

    @property
    def response_lag_s(self) -> float:
        return self.profile.response_lag_s if self.delay.actuation_s is None else self.delay.actuation_s

    @property
    def reference_limit_m_s2(self) -> float:
        """The acceleration limit of each axis less what the disturbance estimate may add on the wire."""
        reserve = self.disturbance.bound_m_s2 if self.disturbance.enabled else 0.0
        return self.limits.acceleration_m_s2 - reserve

    @property
    def prefix(self) -> str:
        return f"uav/{self.vehicle.name}"

    def flown_as(self, profile: str) -> Config:
        """This configuration for the vehicle ``profile``, whose defaults fill what is not set."""
        replace, limits = msgspec.structs.replace, self.limits
        if limits.slew_m_s3 is None:
            limits = replace(limits, slew_m_s3=PROFILES[profile].slew_m_s3)
        return replace(self, vehicle=replace(self.vehicle, profile=profile), limits=limits)


PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "safety": {
        "paper": {
            "form": "paper",
            "braking": False,
            "horizon": 5,
            "kappa": 0.0,
            "kappa_now": 0.0,
            "sigma_delay_s": 0.0,
            "recovery": 0.0,
            "lambda_epsilon": 10.0,
            "lambda_delta": 1e4,
            "iterations": 10,
        },
    },
    "tracking": {
        # Remark 1; 0.6 on the diagonal, 0.2 elsewhere
        "paper": {
            "q_paper": 0.05,
            "measurement_variance_m2": 0.05,
            "force_measurement_variance": True,
            "stay_probability": (0.6, 0.6, 0.6),
            "turn_rate": "window",
            "likelihood_window": 2,
            "accel_memory_s": 0.0,
            "inflation_max": 1.0,
        },
    },
}


def parse_config(raw: Mapping[str, Any], *, source: str = "configuration") -> Config:
    """Typed configuration from decoded TOML; ``source`` names the file in errors.

    Raises:
        ConfigError: one line ``source: key: expectation``.
    """
    merged: dict[str, Any] = dict(raw)
    for section, presets in PRESETS.items():
        table = merged.get(section)
        if isinstance(table, Mapping):
            base = presets.get(str(table.get("preset", "default")), {})
            merged[section] = {**base, **table}
    try:
        config = msgspec.convert(merged, Config)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{source}: {pointed(str(error))}") from None
    if config.vehicle.profile != "auto":
        config = config.flown_as(config.vehicle.profile)
    check_tick(config.rate_hz, source)
    if config.disturbance.enabled:
        check_reserve(config.limits.acceleration_m_s2, config.disturbance.bound_m_s2, source)
    check_confirmation(config.tracking.confirm_hits, config.tracking.confirm_frames, source)
    check_traffic(config.traffic, config.tracking.untrusted, source)
    check_arena(config.limits.arena_min, config.limits.arena_max, config.target.position, source)
    check_ros2((*config.ros2.detections, *config.ros2.tracked_objects), config.sync, source)
    if config.sync == "none" and config.lockstep_sources:
        raise ConfigError(f'{source}: lockstep_sources: expected only with sync = "lockstep"')
    return config


def load_config(path: Path, overrides: tuple[str, ...] = ()) -> Config:
    """The configuration in a TOML file, with ``section.key=value`` overrides (values in TOML syntax) on top."""
    try:
        raw = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}), expected a TOML file") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not TOML: {error}") from None
    config = parse_config(apply_overrides(raw, overrides), source=str(path))
    if config.params.file is not None:  # a relative name lies beside the configuration, wherever the daemon is started
        params = msgspec.structs.replace(config.params, file=str(path.parent / config.params.file))
        config = msgspec.structs.replace(config, params=params)
    return config


def apply_overrides(raw: dict[str, Any], overrides: tuple[str, ...]) -> dict[str, Any]:
    """``raw`` with each ``a.b=value`` set; a value that is not TOML is taken as a string."""
    for item in overrides:
        key, found, text = item.partition("=")
        if not found or not key:
            raise ConfigError(f"--set {item}: expected section.key=value")
        try:
            value = tomllib.loads(f"v = {text}")["v"]
        except tomllib.TOMLDecodeError:
            value = text
        table = raw
        *parents, leaf = key.split(".")
        for parent in parents:
            table = table.setdefault(parent, {})
            if not isinstance(table, dict):
                raise ConfigError(f"--set {item}: {parent} is not a section")
        table[leaf] = value
    return raw


def config_hash(config: Config) -> str:
    """SHA-256 of the resolved configuration without what does not change the flight: where files lie, [realtime]."""
    values = msgspec.to_builtins(config)
    for section in ("log", "params", "realtime"):
        values.pop(section)
    return hashlib.sha256(msgspec.json.encode(values, order="sorted")).hexdigest()
