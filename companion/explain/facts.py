"""The numbers behind an explanation, each with its meaning; `words` says them.

Directions are those of a pilot who looks from the vehicle at its target (level; along its velocity without one):
ahead, left, up.
"""

from __future__ import annotations

import math

import numpy as np
from msgspec import Struct

from companion.explain.cost import Cost, estimate
from companion.explain.moment import Moment, Outline
from companion.explain.refusal import Refusal, refusals
from companion.link.wire import MarginOut, RowOut, TrackOut
from companion.replay.whatif import predicted_distance
from companion.types import FloatArray, Vec3, frozen

LIMIT_M_S2 = 1e-3  # an acceleration this near to a bound is at it
NEAR_TARGET_M = 0.3


class Split(Struct, frozen=True, kw_only=True):
    """A vector, split for the pilot."""

    ahead: float
    left: float
    up: float
    norm: float


class ObstacleFacts(Struct, frozen=True, kw_only=True):
    """An obstacle at this tick; distances are from surface to surface where nothing else is said [m]."""

    track: str
    sources: list[str]
    status: str
    age_s: float | None  # of its newest detection, None where it is not known by a name
    distance_m: float
    bearing: Split  # from the vehicle, centre to centre
    closing_m_s: float  # > 0: they approach
    cpa_s: float | None  # until the closest approach if both flew straight on; None: they separate
    cpa_m: float | None  # the distance there
    miss_reference_m: float | None  # least predicted distance while the reference is held over the horizon
    miss_reference_s: float | None  # and when, after the setpoint acts
    miss_answer_m: float | None
    miss_answer_s: float | None
    growth: float  # how much faster than its models say its predicted covariance grows


class RowFacts(Struct, frozen=True, kw_only=True):
    """An obstacle that refused the reference, and its tightest row at the answer."""

    track: str
    shortfall_m_s2: float  # how far the reference breaks its tightest row
    by_braking: bool  # because the vehicle could no longer stop before it
    broken: bool  # the answer breaks its rows, too
    inside_m: float  # how far the answer comes inside the distance kept, predicted over the horizon
    step: int  # -1: the braking distance
    step_s: float  # of the row's last instant, after the setpoint acts
    slack_m_s2: float
    keep_out_m: float  # centre to centre
    margin: MarginOut
    epsilon: float
    epsilon_star: float
    decay_share: float  # alpha2 epsilon: what of the distance left may be used up per step of the grid


class LimitFacts(Struct, frozen=True, kw_only=True):
    """A limit of the vehicle that the answer touches."""

    name: str  # arena, floor, ceiling, speed, norm, tilt, box, slew
    slack_m_s2: float
    bound: str


class Facts(Struct, frozen=True, kw_only=True):
    """One tick."""

    stamp_ns: int
    state: str
    reason: str
    verdict: str
    task: str
    sent: bool
    position: list[float]
    speed_m_s: float
    target: list[float] | None
    target_m: float | None
    v_ahead_m_s: float
    wanted: Split | None
    did: Split | None
    change: Split | None  # did less wanted
    turned_deg: float | None  # angle between the two
    detour: bool
    worst: str | None  # the row with the least room, of an obstacle or a limit
    worst_slack_m_s2: float | None
    rows: list[RowFacts]
    obstacles: list[ObstacleFacts]  # of ``rows`` first, then the nearest
    limits: list[LimitFacts]
    horizon_s: float
    delay_s: float
    sources_s: dict[str, float]  # age of the newest frame of each
    disturbance_m_s2: float
    cost: Cost


def facts(moment: Moment, ticks: list[Outline], run: tuple[int, int] | None) -> Facts:
    """All of them; ``run``: first and last of ``ticks`` of the intervention that the moment is part of."""
    record, vehicle, config = moment.record, moment.inputs.vehicle, moment.config
    target = moment.inputs.target_enu
    ahead = _ahead(vehicle.p_enu, vehicle.v_enu, target)
    u_ref = None if record.u_ref is None else frozen(record.u_ref)
    u_safe = None if record.u_safe is None else frozen(record.u_safe)
    both = u_ref is not None and u_safe is not None
    change = u_safe - u_ref if u_ref is not None and u_safe is not None else None
    rows = [] if record.verdict == "nominal" else _rows(moment)
    return Facts(
        stamp_ns=record.stamp_ns,
        state=record.state,
        reason=_reason(moment),
        verdict=record.verdict,
        task=moment.inputs.task.value,
        sent=record.sent,
        position=vehicle.p_enu.tolist(),
        speed_m_s=math.hypot(*vehicle.v_enu.tolist()),
        target=None if target is None else target.tolist(),
        target_m=None if target is None else math.dist(vehicle.p_enu, target),
        v_ahead_m_s=float(vehicle.v_enu @ ahead),
        wanted=None if u_ref is None else split(u_ref, ahead),
        did=None if u_safe is None else split(u_safe, ahead),
        change=None if change is None else split(change, ahead),
        turned_deg=_angle_deg(u_ref, u_safe) if both and u_ref is not None and u_safe is not None else None,
        detour=moment.detour,
        worst=None if record.worst is None else record.worst.track,
        worst_slack_m_s2=None if record.worst is None else record.worst.slack,
        rows=rows,
        obstacles=_obstacles(moment, [row.track for row in rows], ahead, u_ref, u_safe),
        limits=_limits(moment, u_safe),
        horizon_s=(config.safety.horizon + 2) * config.safety.dt_s,
        delay_s=config.delay.loop_s + config.actuation_s,
        sources_s={name: (record.stamp_ns - ns) / 1e9 for name, ns in sorted(moment.sightings.sources.items())},
        disturbance_m_s2=math.hypot(*record.disturbance),
        cost=estimate(ticks, run, 0.0 if change is None else -float(change @ ahead)),
    )


def split(vector: Vec3, ahead: Vec3) -> Split:
    """``vector`` along level ``ahead``, to its left, and up."""
    left = np.array((-ahead[1], ahead[0], 0.0))
    return Split(
        ahead=float(vector @ ahead), left=float(vector @ left), up=float(vector[2]), norm=math.hypot(*vector.tolist())
    )


def _ahead(p: Vec3, v: Vec3, target: Vec3 | None) -> Vec3:
    """Level unit vector towards the target, along the velocity at it or without one, else east."""
    towards = v if target is None or math.dist(p[:2], target[:2]) < NEAR_TARGET_M else target - p
    length = math.hypot(towards[0], towards[1])
    return np.array((1.0, 0.0, 0.0)) if length < 1e-3 else np.array((towards[0] / length, towards[1] / length, 0.0))


def _angle_deg(one: Vec3, other: Vec3) -> float | None:
    lengths = math.hypot(*one.tolist()) * math.hypot(*other.tolist())
    return None if lengths < 1e-6 else math.degrees(math.acos(max(-1.0, min(1.0, float(one @ other) / lengths))))


def _reason(moment: Moment) -> str:
    status = moment.status
    return status.reason if status is not None and status.state == moment.record.state else ""


def _rows(moment: Moment) -> list[RowFacts]:
    """Of the obstacles that refused the reference, and of those whose rows the answer breaks, the hardest first."""
    found = []
    for refusal in refusals(moment):
        rows = [row for row in moment.record.rows if row.track == refusal.track and row.margin is not None]
        if rows and (refusal.refused or refusal.broken):
            found.append(_row(min(rows, key=lambda row: row.slack), refusal, moment))
    return found


def _row(row: RowOut, refusal: Refusal, moment: Moment) -> RowFacts:
    safety, margin = moment.config.safety, row.margin
    assert margin is not None
    return RowFacts(
        track=row.track,
        shortfall_m_s2=refusal.shortfall_m_s2,
        by_braking=refusal.by_braking,
        broken=refusal.broken,
        inside_m=refusal.inside_m,
        step=row.step,
        step_s=0.0 if row.step < 0 else (row.step + 2) * safety.dt_s,
        slack_m_s2=row.slack,
        keep_out_m=margin.radii + margin.cushion + margin.sigma + margin.delay,
        margin=margin,
        epsilon=row.epsilon,
        epsilon_star=row.epsilon_star,
        decay_share=min(safety.alpha2 * row.epsilon, 1.0),
    )


def _obstacles(
    moment: Moment, names: list[str], ahead: Vec3, u_ref: Vec3 | None, u_safe: Vec3 | None
) -> list[ObstacleFacts]:
    """Of the rows first; then the nearest of all that are not among them."""
    known = {track.id: _obstacle(moment, track, ahead, u_ref, u_safe) for track in moment.tracks.tracks}
    others = sorted((one for name, one in known.items() if name not in names), key=lambda one: one.distance_m)
    return [known[name] for name in names if name in known] + others[:1]


def _obstacle(moment: Moment, track: TrackOut, ahead: Vec3, u_ref: Vec3 | None, u_safe: Vec3 | None) -> ObstacleFacts:
    vehicle = moment.inputs.vehicle
    radii = track.radius + moment.config.safety.drone_radius_m
    r = frozen(track.position) - vehicle.p_enu
    v = frozen(track.velocity) - vehicle.v_enu
    distance = max(math.hypot(*r.tolist()), 1e-9)
    square = float(v @ v)
    cpa_s = -float(r @ v) / square if square > 1e-9 else 0.0
    reference = _miss(moment, track, u_ref, radii)
    answer = _miss(moment, track, u_safe, radii)
    return ObstacleFacts(
        track=track.id,
        sources=track.sources,
        status=track.status,
        age_s=_age_s(moment, track),
        distance_m=distance - radii,
        bearing=split(r, ahead),
        closing_m_s=-float(r @ v) / distance,
        cpa_s=cpa_s if cpa_s > 0.0 else None,
        cpa_m=math.hypot(*(r + cpa_s * v).tolist()) - radii if cpa_s > 0.0 else None,
        miss_reference_m=reference[0],
        miss_reference_s=reference[1],
        miss_answer_m=answer[0],
        miss_answer_s=answer[1],
        growth=track.growth,
    )


def _miss(moment: Moment, track: TrackOut, u: Vec3 | None, radii: float) -> tuple[float | None, float | None]:
    """Least predicted distance of surfaces while ``u`` is held, and when."""
    if u is None or not track.predicted:
        return None, None
    dt_s = moment.config.safety.dt_s
    predicted: FloatArray = np.array(track.predicted)
    distances = predicted_distance(predicted, moment.at, u, dt_s)
    k = int(distances.argmin())
    return float(distances[k]) - radii, k * dt_s


def _age_s(moment: Moment, track: TrackOut) -> float | None:
    """Since the newest detection that carries the track's name; for anonymous ones that of its sources."""
    sightings, now_ns = moment.sightings, moment.record.stamp_ns
    names = [f"{source}/{track.id.partition('/')[2].split('~')[0]}" for source in track.sources]
    stamps = [sightings.named[name] for name in (*names, track.id) if name in sightings.named]
    if not stamps and track.status != "coasting":
        stamps = [sightings.sources[name] for name in track.sources if name in sightings.sources]
    return (now_ns - max(stamps)) / 1e9 if stamps else None


def _limits(moment: Moment, u_safe: Vec3 | None) -> list[LimitFacts]:
    """Limits of the record, and the box and the slew, which are bounds of the program and in no row."""
    config, record = moment.config, moment.record
    limits = config.limits
    (west, south, floor), (east, north, ceiling) = limits.arena_min, limits.arena_max
    bounds = {
        "arena": f"walls at {west:g} to {east:g} m east and {south:g} to {north:g} m north",
        "floor": f"{floor:g} m",
        "ceiling": f"{ceiling:g} m",
        "speed": f"{limits.speed_m_s:g} m/s",
        "norm": f"{limits.norm_m_s2} m/s^2",
        "tilt": f"{limits.tilt_deg} degrees",
    }
    found = [
        LimitFacts(name=row.track, slack_m_s2=row.slack, bound=bounds.get(row.track, ""))
        for row in record.rows
        if row.margin is None
    ]
    if u_safe is None or config.safety.filter == "none":
        return found
    room = config.reference_limit_m_s2 - float(np.abs(u_safe).max())
    if room < LIMIT_M_S2:
        bound = f"{config.reference_limit_m_s2:g} m/s^2 of each axis"
        found.append(LimitFacts(name="box", slack_m_s2=room, bound=bound))
    if limits.slew_m_s3 is not None and moment.before is not None and moment.elapsed_s is not None:
        room = limits.slew_m_s3 * moment.elapsed_s - float(np.abs(u_safe - moment.before).max())
        if room < LIMIT_M_S2:
            found.append(LimitFacts(name="slew", slack_m_s2=room, bound=f"{limits.slew_m_s3:g} m/s^3 of each axis"))
    return found
