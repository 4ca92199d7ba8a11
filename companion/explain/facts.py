"""The numbers behind an explanation, each with its meaning; `words` says them.

Directions are those of a pilot who looks from the vehicle at its target (level; along its velocity without one):
ahead, left, up.
"""

from __future__ import annotations

import math

import numpy as np
from msgspec import Struct

from companion.explain.moment import Moment, Outline
from companion.link.wire import MarginOut, RowOut, TrackOut
from companion.replay.whatif import predicted_distance
from companion.types import FloatArray, Vec3, frozen

ACTIVE_M_S2 = 0.05  # a row with less slack binds, as in the record
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
    """A row that shaped the answer."""

    track: str
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


class Cost(Struct, frozen=True, kw_only=True):
    """What the change cost."""

    ahead_m_s2: float  # acceleration towards the target given up, < 0: gained
    began_ns: int | None  # of the run of changed ticks about this one
    ended_ns: int | None
    lost_s: float | None  # of that run: its duration less what the way covered takes at the speed towards the target


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
    wanted: Split | None
    did: Split | None
    change: Split | None  # did less wanted
    turned_deg: float | None  # angle between the two
    detour: bool
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
    rows = [_row(row, moment) for row in _active(record.rows) if row.margin is not None]
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
        wanted=None if u_ref is None else split(u_ref, ahead),
        did=None if u_safe is None else split(u_safe, ahead),
        change=None if change is None else split(change, ahead),
        turned_deg=_angle_deg(u_ref, u_safe) if both and u_ref is not None and u_safe is not None else None,
        detour=moment.detour,
        rows=rows,
        obstacles=_obstacles(moment, [row.track for row in rows], ahead, u_ref, u_safe),
        limits=_limits(moment, u_safe),
        horizon_s=(config.safety.horizon + 2) * config.safety.dt_s,
        delay_s=config.delay.loop_s + config.actuation_s,
        sources_s={name: (record.stamp_ns - ns) / 1e9 for name, ns in sorted(moment.sightings.sources.items())},
        disturbance_m_s2=math.hypot(*record.disturbance),
        cost=_cost(ticks, run, 0.0 if change is None else -float(change @ ahead)),
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


def _active(rows: list[RowOut]) -> list[RowOut]:
    """Rows of obstacles that bind, the tightest first, one of each obstacle."""
    seen: set[str] = set()
    found = []
    for row in sorted(rows, key=lambda row: row.slack):
        if row.slack < ACTIVE_M_S2 and row.margin is not None and row.track not in seen:
            seen.add(row.track)
            found.append(row)
    return found


def _row(row: RowOut, moment: Moment) -> RowFacts:
    safety, margin = moment.config.safety, row.margin
    assert margin is not None
    return RowFacts(
        track=row.track,
        step=row.step,
        step_s=0.0 if row.step < 0 else (row.step + 2) * safety.dt_s,
        slack_m_s2=row.slack,
        keep_out_m=margin.radii + margin.cushion + margin.sigma + margin.delay,
        margin=margin,
        epsilon=row.epsilon,
        epsilon_star=row.epsilon_star,
        decay_share=safety.alpha2 * row.epsilon,
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


def _cost(ticks: list[Outline], run: tuple[int, int] | None, ahead_m_s2: float) -> Cost:
    if run is None:
        return Cost(ahead_m_s2=ahead_m_s2, began_ns=None, ended_ns=None, lost_s=None)
    first, last = ticks[run[0]], ticks[run[1]]
    return Cost(ahead_m_s2=ahead_m_s2, began_ns=first.stamp_ns, ended_ns=last.stamp_ns, lost_s=_lost_s(ticks, run))


def _lost_s(ticks: list[Outline], run: tuple[int, int]) -> float | None:
    """Duration of the run less the time that the way covered towards the target takes at the speed before or after.

    That speed is the greater of the two, each over the tenth of a second outside the run. None without a target, or
    where neither moved towards it.
    """
    first, last = run
    began, ended = ticks[first].distance_m, ticks[last].distance_m
    if began is None or ended is None or ticks[first].target != ticks[last].target:
        return None
    speed = max(_approach_m_s(ticks, first, -1), _approach_m_s(ticks, last, 1))
    if speed < 0.3:
        return None
    duration_s = (ticks[last].stamp_ns - ticks[first].stamp_ns) / 1e9
    return max(0.0, duration_s - (began - ended) / speed)


def _approach_m_s(ticks: list[Outline], number: int, way: int) -> float:
    """Speed towards the target over the tenth of a second from ``number`` on, backwards (-1) or forwards (1)."""
    other = number
    while 0 <= other + way < len(ticks) and abs(ticks[other].stamp_ns - ticks[number].stamp_ns) < 100_000_000:
        other += way
    one, two = sorted((number, other))
    elapsed_s = (ticks[two].stamp_ns - ticks[one].stamp_ns) / 1e9
    start, end = ticks[one].distance_m, ticks[two].distance_m
    if elapsed_s <= 0.0 or start is None or end is None or ticks[one].target != ticks[two].target:
        return 0.0
    return (start - end) / elapsed_s
