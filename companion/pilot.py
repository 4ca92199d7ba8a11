"""The whole brain in one synchronous call: track, predict, ask the policy, filter (design 1, 5.7, 5.14).

No clock and no I/O: the same inputs give the same outputs, bit for bit, and the class is usable as a library.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

import numpy as np

from companion.commanded import acts_after_ns, at_action
from companion.config import Config
from companion.disturbance import DisturbanceObserver
from companion.errors import BrainFailure, ConfigError, PolicyOutputInvalid
from companion.origin import OriginWatch
from companion.policy import Policy, brake, hold, load_policy
from companion.safety.filter import FilterInput, SafetyFilter
from companion.tracking.tracker import Tracker
from companion.tunables import only_tunables_differ
from companion.types import (
    NS_PER_S,
    DetectionFrame,
    FilterResult,
    Prediction,
    TrackTable,
    Vec3,
    VehicleState,
    Verdict,
    frozen,
)

HOLD_SPEED_M_S = 0.3  # below it a braking vehicle anchors where it is
_ZERO = frozen([0.0, 0.0, 0.0])


class Task(StrEnum):
    """What the pilot is asked to fly in a tick."""

    STAY = "stay"  # hold where the vehicle is now, anchored anew each tick (READY)
    FLY = "fly"  # to the target, or hold where engaged without one (ACTIVE)
    HOLD = "hold"  # brake, then hold position (HOLD)


class ReferenceLaw(Protocol):
    """What the pilot asks for its reference: a loaded `Policy`, or a law of your own."""

    def act(self, v_enu: Vec3, error_enu: Vec3) -> Vec3:
        """Net acceleration for velocity and target minus position [m/s^2]; the pilot bounds it.

        Raises:
            PolicyOutputInvalid: there is none; the vehicle then brakes.
        """


@dataclass(frozen=True, slots=True)
class PilotInput:
    """One tick. ``frames`` may be empty; ``target_enu`` None means: hold where this flight began."""

    vehicle: VehicleState
    frames: tuple[DetectionFrame, ...] = ()
    task: Task = Task.FLY
    target_enu: Vec3 | None = None


@dataclass(frozen=True, slots=True)
class PilotOutput:
    """The answer to one tick; accelerations are net (gravity excluded), ENU [m/s^2]."""

    stamp_ns: int
    u_ref: Vec3
    result: FilterResult
    wire: Vec3  # u_safe less the disturbance estimate: what the autopilot is sent
    disturbance: Vec3
    prediction: Prediction
    policy_valid: bool
    obstacle_frames: int
    v_next: Vec3  # velocity one tick after this setpoint acts, under u_safe: goes with it where the mask uses velocity
    origin_moved_m: float | None = None  # the estimator was reset with this tick's state


class Pilot:
    """Tracker, policy and safety filter behind ``step``.

    The setpoint that answers the state of instant t acts at t + delay (loop time plus the actuation lag of the
    profile, as dead time). Vehicle and obstacles are both predicted to that instant, the vehicle under the
    accelerations already commanded, and the barrier's grid starts there.

    Raises:
        ArtifactError: at construction, where the policy cannot be flown with this configuration.
    """

    def __init__(self, config: Config, policy: ReferenceLaw | None = None) -> None:
        self._config = config
        self._policy = load_policy(config.policy, config.limits) if policy is None else policy
        self._tracker = Tracker(config.tracking, config.safety.drone_radius_m)
        self._filter = SafetyFilter(config.safety, config.limits)
        self._observer = DisturbanceObserver(config.disturbance, lag_s=config.response_lag_s)
        self._origin = OriginWatch()
        self._delay_ns = acts_after_ns(config)
        self._history_len = 2 + math.ceil(self._delay_ns * config.rate_hz / NS_PER_S)
        self.reset()

    def reset(self) -> None:
        """Forget everything; the next step is bit-equal to the first of a new pilot."""
        self._tracker.reset()
        self._filter.reset()
        self._observer.reset()
        self._origin.reset()
        self._commands: deque[tuple[int, Vec3]] = deque(maxlen=self._history_len)  # (acts from [ns], net a)
        self._last_ns: int | None = None
        self._ahead: tuple[int, Prediction] | None = None  # what `observe` has prepared
        self._anchor: Vec3 | None = None
        self._task: Task | None = None

    def configured(self, config: Config) -> Pilot:
        """A new pilot with the same policy, for a profile that was not known before."""
        return Pilot(config, self._policy)

    def retune(self, config: Config) -> None:
        """Fly on under ``config`` from the next step: other margins and limits, the same tracks and state.

        Raises:
            ConfigError: more than live parameters differs, or the policy asks for more acceleration than the new
                limit; nothing has changed then.
        """
        if not only_tunables_differ(self._config, config):
            raise ConfigError("retune: expected a configuration that differs in live parameters only")
        if isinstance(self._policy, Policy):
            self._policy = self._policy.within(config.limits)
        self._config = config
        self._tracker.retune(config.safety.drone_radius_m)
        self._filter.retune(config.safety, config.limits)

    @property
    def artifact(self) -> str | None:
        """SHA-256 of the manifest of the policy's artefact; None for a reference law of your own."""
        return self._policy.digest if isinstance(self._policy, Policy) else None

    def tracks(self) -> TrackTable:
        """The tracks as the last step left them; apart from it, because nobody waits for them."""
        return self._tracker.table()

    @property
    def tracking_counts(self) -> dict[str, int]:
        """Detections not used and tracks ended, by reason."""
        return dict(self._tracker.dropped)

    def observe(self, frames: tuple[DetectionFrame, ...], stamp_ns: int) -> None:
        """Track and predict for the tick of ``stamp_ns`` before its vehicle state is there.

        Optional: `step` with the same stamp and frames then answers sooner, and the same to the bit.
        """
        self._ahead = (stamp_ns, self._track(frames, stamp_ns))

    def step(self, inputs: PilotInput, *, sent: bool = True) -> PilotOutput:
        """The safe acceleration for one tick.

        Args:
            sent: whether this answer goes to a vehicle that obeys it; otherwise it is not counted as commanded.
        Raises:
            BrainFailure: the vehicle state is not finite, or its stamp does not advance.
        """
        vehicle = inputs.vehicle
        elapsed_s = self._elapsed(vehicle)
        moved_m = self._moved(vehicle)
        ahead, self._ahead = self._ahead, None
        prepared = ahead is not None and ahead[0] == vehicle.stamp_ns
        prediction = ahead[1] if ahead and prepared else self._track(inputs.frames, vehicle.stamp_ns)
        self._tracker.note_vehicle(vehicle)  # behind the tracking of this tick, which may have been done ahead
        p_act, v_act = self._at_action(vehicle)
        u_ref, valid = self._reference(inputs, p_act, v_act)
        flying = inputs.task is not Task.STAY
        estimate = self._observer.update(vehicle.v_enu, elapsed_s, adapt=sent and inputs.task is Task.FLY)
        disturbance = estimate if flying else _ZERO
        leads = inputs.task is Task.FLY and inputs.target_enu is not None
        result = self._filtered(vehicle, p_act, v_act, u_ref, prediction, elapsed_s, flying=flying, leads=leads)
        wire = frozen(result.a_safe - disturbance)
        self._commands.append((prediction.start_ns, result.a_safe if sent else _ZERO))
        self._observer.command(wire if sent else _ZERO, saturated=self._saturated(wire))
        return PilotOutput(
            stamp_ns=vehicle.stamp_ns,
            u_ref=u_ref,
            result=result,
            wire=wire,
            disturbance=disturbance,
            prediction=prediction,
            policy_valid=valid,
            obstacle_frames=len(inputs.frames),
            v_next=frozen(v_act + result.a_safe / self._config.rate_hz),
            origin_moved_m=moved_m,
        )

    def filter_acceleration(
        self, vehicle: VehicleState, a_ref: Vec3, frames: tuple[DetectionFrame, ...] = ()
    ) -> FilterResult:
        """Filter a reference of your own (net, ENU [m/s^2]) instead of the policy's: the library's front door."""
        elapsed_s = self._elapsed(vehicle)
        self._moved(vehicle)
        prediction = self._track(frames, vehicle.stamp_ns)
        self._tracker.note_vehicle(vehicle)
        p_act, v_act = self._at_action(vehicle)
        result = self._filtered(vehicle, p_act, v_act, frozen(a_ref), prediction, elapsed_s)
        self._commands.append((prediction.start_ns, result.a_safe))
        return result

    def _track(self, frames: tuple[DetectionFrame, ...], stamp_ns: int) -> Prediction:
        """Obstacles from the instant on at which the setpoint for the tick of ``stamp_ns`` acts."""
        self._tracker.update(frames, stamp_ns)
        safety = self._config.safety
        return self._tracker.predict(stamp_ns + self._delay_ns, safety.horizon + 3, safety.dt_s)

    def _elapsed(self, vehicle: VehicleState) -> float | None:
        if not (np.isfinite(vehicle.p_enu).all() and np.isfinite(vehicle.v_enu).all()):
            raise BrainFailure("vehicle state: expected finite position and velocity")
        last, self._last_ns = self._last_ns, vehicle.stamp_ns
        if last is None:
            return None
        if vehicle.stamp_ns <= last:
            raise BrainFailure(f"vehicle state: expected a stamp after {last} ns, got {vehicle.stamp_ns} ns")
        return (vehicle.stamp_ns - last) / NS_PER_S

    def _moved(self, vehicle: VehicleState) -> float | None:
        """Notice a reset of the estimator and forget what was relative to the old origin.

        That is the anchor, the filter's detour and decays, the own path, and the velocity that the disturbance
        observer compares with. What was commanded stays: accelerations do not depend on the origin, they are still
        under way, and slew counts from the last. So does the disturbance estimate. Tracks stay as well. Those of
        sources fixed to the ground are as good as before; those of sensors on board lie in the old frame until their
        next frame, which restarts what is named and starts the rest anew beside ghosts that end after
        `tracking.coast_s`. A ghost can only add margin, while to drop all would be to fly blind until each obstacle
        is confirmed again.
        """
        moved_m = self._origin.moved_m(vehicle)
        if moved_m is not None:
            self._tracker.forget_path()
            self._filter.reset()
            self._observer.skip()
            self._anchor = None
        return moved_m

    def _at_action(self, vehicle: VehicleState) -> tuple[Vec3, Vec3]:
        return at_action(vehicle, self._commands, self._delay_ns)

    def _reference(self, inputs: PilotInput, p_act: Vec3, v_act: Vec3) -> tuple[Vec3, bool]:
        """The reference acceleration, and whether the policy's output was usable."""
        if inputs.task is not self._task:
            self._task, self._anchor = inputs.task, None
        config, limit = self._config.policy, self._config.reference_limit_m_s2
        p_act, v_act = self._unwound(p_act, v_act)
        p, v = self._unwound(inputs.vehicle.p_enu, inputs.vehicle.v_enu)
        if inputs.task is Task.STAY:
            return frozen(brake(v_act, config, limit)), True
        if inputs.task is Task.HOLD:
            if self._anchor is None and float(np.linalg.norm(v)) < HOLD_SPEED_M_S:
                self._anchor = p
            anchor = self._anchor
            a_ref = brake(v_act, config, limit) if anchor is None else hold(anchor - p_act, v_act, config, limit)
            # the policy is still asked, so that a HOLD which its output caused ends when it is sound again
            return frozen(a_ref), inputs.target_enu is None or self._ask(v, inputs.target_enu - p) is not None
        if self._anchor is None:
            self._anchor = p
        goal = self._anchor if inputs.target_enu is None else inputs.target_enu
        action = self._ask(v, goal - p)
        if action is None:
            return frozen(brake(v_act, config, limit)), False
        return frozen(np.clip(action, -limit, limit)), True

    def _unwound(self, p: Vec3, v: Vec3) -> tuple[Vec3, Vec3]:
        """Position and velocity once the last command has been slewed to zero: where a reference law can next choose.

        t = |a| / slew on each axis, v += a t / 2, p += v t + a t^2 / 3. The laws know no slew and take the acceleration
        for theirs at once; behind a slow one (ArduPilot's 5 m/s^3) they would turn late and circle their target.
        """
        slew = self._config.limits.slew_m_s3
        if slew is None or not self._commands:
            return p, v
        a = self._commands[-1][1]
        t = np.abs(a) / slew
        return p + v * t + a * t * t / 3.0, v + 0.5 * a * t

    def _ask(self, v_enu: Vec3, error_enu: Vec3) -> Vec3 | None:
        """The policy's acceleration, None where its output is not usable."""
        try:
            return self._policy.act(v_enu, error_enu)
        except PolicyOutputInvalid:
            return None

    def _filtered(
        self,
        vehicle: VehicleState,
        p_act: Vec3,
        v_act: Vec3,
        u_ref: Vec3,
        prediction: Prediction,
        elapsed_s: float | None,
        *,
        flying: bool = True,
        leads: bool = True,
    ) -> FilterResult:
        if self._config.safety.filter == "none":
            return FilterResult(u_ref, Verdict.NOMINAL, None, (), 0, "none")
        full = self._config.limits.acceleration_m_s2
        return self._filter.step(
            FilterInput(
                p_enu=p_act,
                v_enu=v_act,
                a_ref=u_ref,
                prediction=prediction,
                p_std_m=vehicle.p_std_m,
                limits_on=flying,
                detours=leads,
                accel_shrink_m_s2=full - self._config.reference_limit_m_s2,
                elapsed_s=elapsed_s,
                a_before=self._commands[-1][1] if self._commands else None,
            )
        )

    def _saturated(self, wire: Vec3) -> bool:
        return bool(np.abs(wire).max() >= self._config.limits.acceleration_m_s2 - 1e-9)
