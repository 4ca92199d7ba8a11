"""The `[physics]` table: which effects act in the world, and how strongly. What the defaults leave off is off."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from sim_bridge.scenario_types import NonNegative, Table

Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Wind_m_s = Annotated[float, Meta(ge=-50.0, le=50.0)]
Small = Annotated[float, Meta(ge=0.0, le=10.0)]


class Wind(Table, frozen=True, kw_only=True):
    """Air that moves over the ground."""

    steady: tuple[Wind_m_s, Wind_m_s, Wind_m_s] = (0.0, 0.0, 0.0)  # towards east, north, up [m/s]
    gusts: Literal["none", "light", "moderate", "severe"] = "none"  # Dryden, MIL-F-8785C, low altitude


class EstimatorNoise(Table, frozen=True, kw_only=True):
    """What the autopilot believes is the truth plus noise, this much later. All 0: the truth."""

    position_std_m: Small = 0.0  # of each axis
    velocity_std_m_s: Small = 0.0  # of each axis
    attitude_std_rad: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0  # of each axis
    delay_s: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0  # of position and velocity


class Imu(Table, frozen=True, kw_only=True):
    """White noise of the inertial sensors; 0 off."""

    gyro_std_rad_s: Small = 0.0  # of each body rate
    accelerometer_std_m_s2: NonNegative = 0.0  # of each axis


class Physics(Table, frozen=True, kw_only=True):
    motor_lag: bool = True  # motors answer with a delay
    rotor_drag: bool = True  # drag of the rotors, through which wind acts
    battery_sag: bool = False  # thrust falls with the voltage
    ground_effect: bool = False  # more thrust near the ground
    downwash: bool = False  # rotors push on the vehicle below
    hover_thrust_error: Annotated[float, Meta(ge=-0.5, le=0.5)] = 0.0  # share by which the hover thrust is misjudged
    battery_start: Share = 1.0  # state of charge at the start
    wind: Wind = Wind()
    estimator: EstimatorNoise = EstimatorNoise()
    imu: Imu = Imu()
