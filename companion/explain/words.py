"""Says what `facts` found, in plain sentences with units."""

from __future__ import annotations

import math

from companion.explain.facts import Facts, LimitFacts, ObstacleFacts, RowFacts, Split
from companion.types import NS_PER_S

SMALL = 0.05  # m/s^2 or m that are not worth a word
_VERDICTS = {
    "nominal": "the reference passed unchanged",
    "adjusted": "the reference was changed, and every margin and limit holds",
    "relaxed": "not every margin could hold within the vehicle's limits: the least violation was flown",
    "braking": "no solver had a usable answer: braking in the safest direction",
    "silent": "the brain gave no answer",
}
_TASKS = {
    "fly": "fly to the target",
    "hold": "brake and hold",
    "stay": "hold where it is, nothing engaged",
}
_LIMITS = {
    "box": "acceleration",
    "slew": "change of the acceleration",
    "arena": "arena walls",
    "speed": "speed limit",
    "norm": "total acceleration",
    "tilt": "tilt",
    "floor": "floor",
    "ceiling": "ceiling",
}


def paragraphs(facts: Facts, origin_ns: int) -> list[tuple[str, str]]:
    """(heading, text) in the order in which a pilot asks."""
    told = [("State", _state(facts, origin_ns)), ("Wanted", _wanted(facts)), ("Did", _did(facts))]
    by_name = {one.track: one for one in facts.obstacles}
    for number, row in enumerate(facts.rows):
        obstacle = by_name.get(row.track)
        if obstacle is not None:
            told.append(("Because" if number == 0 else "and", _obstacle(obstacle, facts)))
            told.append(("Margin", _margin(row)))
            told.append(("Rule", _rule(row)))
    rest = [one for one in facts.obstacles if one.track not in {row.track for row in facts.rows}]
    if not facts.rows:
        told.append(("Near", _obstacle(rest[0], facts) if rest else "No obstacle was tracked."))
    told += [("Limits", _limits(facts.limits))] if facts.limits else []
    told.append(("Data", _data(facts, by_name)))
    told += [("Cost", _cost(facts))] if facts.verdict in ("adjusted", "relaxed", "braking") else []
    return [(heading, text) for heading, text in told if text]


def moment_words(stamp_ns: int, origin_ns: int) -> str:
    """A stamp for people."""
    t_s = (stamp_ns - origin_ns) / NS_PER_S
    return f"{t_s:.2f} s after engaging" if t_s >= 0.0 else f"{-t_s:.2f} s before engaging"


def _state(facts: Facts, origin_ns: int) -> str:
    reason = f" ({facts.reason})" if facts.reason else ""
    sent = "" if facts.sent else " Nothing was sent to the autopilot."
    when = f"{moment_words(facts.stamp_ns, origin_ns)} (vehicle time {facts.stamp_ns / 1e9:.3f} s)"
    return f"{when}: {facts.state}{reason}, {facts.verdict}: {_VERDICTS[facts.verdict]}.{sent}"


def _wanted(facts: Facts) -> str:
    if facts.wanted is None:
        return ""
    aim = _TASKS[facts.task]
    if facts.task == "fly":
        place = None if facts.target is None else "(" + ", ".join(f"{x:.1f}" for x in facts.target) + ") m"
        aim = "hold where it engaged" if place is None else f"fly to {place}, {facts.target_m:.1f} m away"
    return f"To {aim}; at {facts.speed_m_s:.1f} m/s the reference was {_vector(facts.wanted)}."


def _did(facts: Facts) -> str:
    did, change = facts.did, facts.change
    if did is None or change is None:
        return ""
    if facts.verdict == "nominal":
        return "The same, to the bit."
    text = f"{_vector(did)}, {change.norm:.2f} m/s^2 from the reference"
    if facts.turned_deg is not None and did.norm > SMALL:
        text += f" and turned {facts.turned_deg:.0f} degrees from it"
    text += f": {_change(change)}."
    if facts.detour:
        text += " A detour: there was no progress, so it followed the boundary of what stands in the way."
    return text


def _obstacle(one: ObstacleFacts, facts: Facts) -> str:
    motion = (
        f"closing at {one.closing_m_s:.1f} m/s" if one.closing_m_s > 0 else f"opening at {-one.closing_m_s:.1f} m/s"
    )
    text = f"{one.track}, {_gap(one.distance_m)} {_where(one.bearing)}, {motion}"
    if one.cpa_s is not None and one.cpa_m is not None:
        text += f"; if both flew straight on, {_pass(one.cpa_m)} in {one.cpa_s:.1f} s"
    text += "."
    if one.miss_reference_m is not None and one.miss_answer_m is not None:
        ahead = f" Predicted over the next {facts.horizon_s:.1f} s: "
        if abs(one.miss_reference_m - one.miss_answer_m) < 0.005:
            return text + ahead + f"{_pass(one.miss_answer_m)} in {one.miss_answer_s:.1f} s."
        with_reference = f"with the reference {_pass(one.miss_reference_m)} in {one.miss_reference_s:.1f} s"
        text += ahead + f"{with_reference}, with the answer {_pass(one.miss_answer_m)} in {one.miss_answer_s:.1f} s."
    return text


def _margin(row: RowFacts) -> str:
    margin = row.margin
    parts = [
        f"{margin.radii:.2f} radii",
        f"{margin.cushion:.2f} cushion",
        f"{margin.sigma:.2f} for the uncertainty of its position and prediction",
        f"{margin.delay:.2f} for that of the delay",
    ]
    return f"{row.keep_out_m:.2f} m are kept, centre to centre: {', '.join(parts)}."


def _rule(row: RowFacts) -> str:
    where = (
        "the braking distance binds"
        if row.step < 0
        else f"step {row.step} of the horizon binds, {row.step_s:.2f} s ahead"
    )
    short = "holds exactly" if abs(row.slack_m_s2) < 1e-3 else f"has {row.slack_m_s2:.2f} m/s^2 to spare"
    if row.slack_m_s2 < -1e-3:
        short = f"is broken by {-row.slack_m_s2:.2f} m/s^2"
    share = (
        f"epsilon {row.epsilon:.2f} lets the vehicle use up {100.0 * min(row.decay_share, 1.0):.0f} % of the room left"
    )
    star = "0 as for all that approaches" if row.epsilon_star == 0.0 else f"{row.epsilon_star:.2f} as it separates"
    return f"{_cap(where)} and {short}; {share} per step (aim: epsilon* {star})."


def _limits(limits: list[LimitFacts]) -> str:
    told = []
    for one in limits:
        state = "at it" if abs(one.slack_m_s2) < 1e-3 else f"{one.slack_m_s2:.2f} m/s^2 to spare"
        if one.slack_m_s2 < -1e-3:
            state = f"broken by {-one.slack_m_s2:.2f} m/s^2"
        told.append(f"{_LIMITS.get(one.name, one.name)} ({one.bound}): {state}")
    return _cap("; ".join(told)) + "."


def _data(facts: Facts, by_name: dict[str, ObstacleFacts]) -> str:
    told = []
    for name in [row.track for row in facts.rows] or list(by_name):
        one = by_name.get(name)
        if one is not None:
            age = "of unknown age" if one.age_s is None else f"last seen {one.age_s:.2f} s before"
            text = f"{one.track} {age} by {', '.join(one.sources) or 'nobody'}, {one.status}"
            told.append(text + (f", agile (predictions widen {one.growth:.1f} times)" if one.growth >= 2.0 else ""))
    if facts.sources_s:
        told.append("newest frames: " + ", ".join(f"{name} {age:.2f} s old" for name, age in facts.sources_s.items()))
    told.append(f"the setpoint acts {facts.delay_s:.2f} s later")
    if facts.disturbance_m_s2 > SMALL:
        told.append(f"{facts.disturbance_m_s2:.2f} m/s^2 of disturbance (wind, hover thrust) are compensated")
    return _cap("; ".join(told)) + "."


def _cost(facts: Facts) -> str:
    cost = facts.cost
    if abs(cost.ahead_m_s2) < SMALL:
        now = "No acceleration towards the target given up at this tick."
    elif cost.ahead_m_s2 > 0.0:
        now = f"{cost.ahead_m_s2:.2f} m/s^2 towards the target given up at this tick."
    else:
        now = f"None at this tick: it accelerated {-cost.ahead_m_s2:.2f} m/s^2 more towards the target."
    if cost.began_ns is None or cost.ended_ns is None:
        return now
    duration_s = (cost.ended_ns - cost.began_ns) / NS_PER_S
    text = f"{now} Changed for {duration_s:.1f} s in a row"
    return text + ("." if cost.lost_s is None else f", which took about {cost.lost_s:.1f} s longer than flying on.")


def _vector(v: Split) -> str:
    """Size and direction of an acceleration."""
    if v.norm < SMALL:
        return "no acceleration"
    return f"{v.norm:.2f} m/s^2 {_parts(v, v.norm)}"


def _parts(v: Split, norm: float) -> str:
    """Directions that make up most of a vector: "ahead", "ahead and left"."""
    named = (("ahead", "back", v.ahead), ("left", "right", v.left), ("up", "down", v.up))
    big = sorted(((abs(x), one if x > 0 else other) for one, other, x in named if abs(x) > 0.3 * norm), reverse=True)
    return " and ".join(name for _, name in big)


def _change(v: Split) -> str:
    told = []
    if abs(v.ahead) >= SMALL:
        told.append(f"{abs(v.ahead):.2f} {'more' if v.ahead > 0 else 'less'} ahead")
    if abs(v.left) >= SMALL:
        told.append(f"{abs(v.left):.2f} to the {'left' if v.left > 0 else 'right'}")
    if abs(v.up) >= SMALL:
        told.append(f"{abs(v.up):.2f} {'up' if v.up > 0 else 'down'}")
    return ", ".join(told) or "hardly"


def _where(v: Split) -> str:
    """Clock position and height of something seen from the vehicle."""
    level = math.hypot(v.ahead, v.left)
    height = "" if abs(v.up) < 0.3 else f", {abs(v.up):.1f} m {'higher' if v.up > 0 else 'lower'}"
    if level < 0.3:
        return f"{'above' if v.up > 0 else 'below'}"
    clock = round(-math.degrees(math.atan2(v.left, v.ahead)) / 30.0) % 12 or 12
    return f"at {clock} o'clock{height}"


def _gap(metres: float) -> str:
    return f"{metres:.2f} m off" if metres >= 0.0 else f"{-metres:.2f} m inside contact"


def _pass(metres: float) -> str:
    return f"{metres:.2f} m between them" if metres >= 0.0 else "contact"


def _cap(text: str) -> str:
    return text[:1].upper() + text[1:]
