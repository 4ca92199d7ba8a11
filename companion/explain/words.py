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
_CHANGED = ("adjusted", "relaxed", "braking")
MOST = 3  # obstacles told in full
_TASKS = {
    "fly": "fly to the target",
    "hold": "brake and hold",
    "stay": "hold where it is, nothing engaged",
}
_AIMS = {"fly": "the way to the target", "hold": "holding", "stay": "staying"}
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
    told = [("State", _state(facts, origin_ns)), ("In short", _short(facts))]
    told += [("Wanted", _wanted(facts)), ("Did", _did(facts))]
    by_name = {one.track: one for one in facts.obstacles}
    for number, row in enumerate(facts.rows[:MOST]):
        obstacle = by_name.get(row.track)
        if obstacle is not None:
            told.append(("Because" if number == 0 else "and", f"{_obstacle(obstacle, facts)} {_refusal(row)}"))
            told += [("Margin", _margin(row)), ("Rule", _rule(row))]
    if len(facts.rows) > MOST:
        told.append(("and", f"{len(facts.rows) - MOST} more obstacles refused the reference, less hard."))
    if not facts.rows:
        told.append(("Nearest", _obstacle(facts.obstacles[0], facts) if facts.obstacles else "No obstacle is tracked."))
    told += [("Limits", _limits(facts.limits))] if facts.limits else []
    told.append(("Data", _data(facts, by_name)))
    told += [("Cost", _cost(facts))] if facts.verdict in _CHANGED else []
    return [(heading, text) for heading, text in told if text]


def moment_words(stamp_ns: int, origin_ns: int) -> str:
    """A stamp for people."""
    t_s = (stamp_ns - origin_ns) / NS_PER_S
    return f"{t_s:.2f} s after engaging" if t_s >= 0.0 else f"{-t_s:.2f} s before engaging"


def _state(facts: Facts, origin_ns: int) -> str:
    reason = f" ({facts.reason})" if facts.reason else ""
    sent = "" if facts.sent else " Nothing was sent to the autopilot."
    when = f"{moment_words(facts.stamp_ns, origin_ns)} (vehicle time {facts.stamp_ns / 1e9:.3f} s)"
    worst = ""
    if facts.verdict in ("relaxed", "braking") and facts.worst is not None and facts.worst_slack_m_s2 is not None:
        worst = f" Worst is {_LIMITS.get(facts.worst, facts.worst)}, {_slack(facts.worst_slack_m_s2)}."
    return f"{when}: {facts.state}{reason}, {facts.verdict}: {_VERDICTS[facts.verdict]}.{worst}{sent}"


def _short(facts: Facts) -> str:
    """One sentence for who reads no further."""
    if facts.change is None:
        return "Without an answer nothing was flown."
    if facts.verdict == "nominal":
        return f"Nothing stood against {_AIMS[facts.task]}."
    doing = _doing(facts.change, facts.v_ahead_m_s)
    if not facts.rows:
        why = ", ".join(_LIMITS.get(one.name, one.name) for one in facts.limits)
        what = "To get round what held it up" if facts.detour else f"For the sake of its limits ({why})" if why else ""
        return f"{what or 'Of two ways that cost about the same it stayed on one'}, it {doing}."
    names = [row.track for row in facts.rows]
    who = ", ".join(names[:MOST]) + (f" and {len(names) - MOST} more" if len(names) > MOST else "")
    first = next((one for one in facts.obstacles if one.track == names[0]), None)
    if first is None or first.miss_reference_m is None or first.miss_answer_m is None:
        return f"For {who} it {doing}."
    gap = _pass(first.miss_reference_m)
    gain = first.miss_answer_m - first.miss_reference_m
    better = f", {gain:.2f} m less than the answer does" if gain > 0.01 else ""
    return f"For {who} it {doing}: the reference would have led to {gap} within {facts.horizon_s:.1f} s{better}."


def _doing(change: Split, v_ahead: float) -> str:
    """What a change of the acceleration amounts to, the largest part first."""
    along = "sped up" if change.ahead > 0.0 else "slowed down" if v_ahead > 0.2 else "held back"
    named = (
        (abs(change.ahead), along),
        (abs(change.left), f"went {'left' if change.left > 0.0 else 'right'}"),
        (abs(change.up), "climbed" if change.up > 0.0 else "went down"),
    )
    big = sorted((part for part in named if part[0] >= max(SMALL, 0.3 * change.norm)), reverse=True)
    words = [word for _, word in big] or ["changed next to nothing"]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


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
    motion = "keeping its distance"
    if abs(one.closing_m_s) >= 0.05:
        motion = f"{'closing' if one.closing_m_s > 0 else 'moving away'} at {abs(one.closing_m_s):.1f} m/s"
    text = f"{one.track}, {_gap(one.distance_m)} {_where(one.bearing)}, {motion}"
    if one.cpa_s is not None and one.cpa_m is not None and one.cpa_s >= 0.05:
        text += f"; if both flew straight on, {_pass(one.cpa_m)} in {one.cpa_s:.1f} s"
    text += "."
    if one.miss_reference_m is None or one.miss_answer_m is None:
        return text
    text += f" Predicted over the next {facts.horizon_s:.1f} s: "
    answer = f"{_pass(one.miss_answer_m)} {_in(one.miss_answer_s)}"
    if abs(one.miss_reference_m - one.miss_answer_m) < 0.005:
        return f"{text}{answer}."
    reference = f"{_pass(one.miss_reference_m)} {_in(one.miss_reference_s)}"
    return f"{text}with the reference {reference}, with the answer {answer}."


def _refusal(row: RowFacts) -> str:
    """How hard the reference was refused."""
    if row.shortfall_m_s2 <= 0.0:
        return "It admits the reference, not the answer."
    why = "could not have stopped before it" if row.by_braking else "would have come nearer, or faster, than is allowed"
    return f"With the reference it {why}: {row.shortfall_m_s2:.2f} m/s^2 too much."


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
    where = f"step {row.step} of the horizon, {row.step_s:.2f} s ahead"
    if row.step < 0:
        return f"The braking distance decides; {_slack(row.slack_m_s2)}."
    if row.broken:
        depth = f"comes {row.inside_m:.2f} m inside that distance" if row.inside_m > 0.005 else "keeps that distance"
        tightest = f"its tightest row is {where}: {_slack(row.slack_m_s2)}"
        return f"No allowed answer was left. The one flown {depth}; {tightest}."
    share = f"up to {100.0 * row.decay_share:.0f} % of the room left may be used up per step"
    star = (
        "approaching, so epsilon* is 0" if row.epsilon_star == 0.0 else f"separating, epsilon* {row.epsilon_star:.2f}"
    )
    return f"Decided by {where}: {_slack(row.slack_m_s2)}; {share} (epsilon {row.epsilon:.2f}; {star})."


def _slack(slack_m_s2: float) -> str:
    if slack_m_s2 < -1e-3:
        return f"short by {-slack_m_s2:.2f} m/s^2"
    return "it just holds" if slack_m_s2 < 1e-3 else f"{slack_m_s2:.2f} m/s^2 to spare"


def _limits(limits: list[LimitFacts]) -> str:
    told = [f"{_LIMITS.get(one.name, one.name)} ({one.bound}), {_slack(one.slack_m_s2)}" for one in limits]
    return "At or near: " + "; ".join(told) + "."


def _data(facts: Facts, by_name: dict[str, ObstacleFacts]) -> str:
    told = []
    for name in [row.track for row in facts.rows[:MOST]] or list(by_name)[:1]:
        one = by_name.get(name)
        if one is not None:
            age = "was never seen under its name" if one.age_s is None else f"was last seen {one.age_s:.2f} s before"
            by = f" by {', '.join(one.sources)}" if one.sources else ""
            agile = f", turns more sharply than assumed: its uncertainty grows {one.growth:.1f} times as fast"
            told.append(f"{one.track} {age}{by} ({one.status}{agile if one.growth >= 2.0 else ''})")
    if facts.sources_s:
        ages = ", ".join(f"{name} {age:.2f} s" for name, age in facts.sources_s.items())
        told.append(f"age of the newest frames: {ages}")
    told.append(f"the setpoint acts {facts.delay_s:.2f} s after the state it answers")
    if facts.disturbance_m_s2 > SMALL:
        told.append(f"{facts.disturbance_m_s2:.2f} m/s^2 of wind or hover-thrust error are compensated on top")
    return "; ".join(told) + "."


def _cost(facts: Facts) -> str:
    cost = facts.cost
    now = "No acceleration towards the target was given up at this tick."
    if abs(cost.ahead_m_s2) >= SMALL:
        verb = "given up" if cost.ahead_m_s2 > 0.0 else "gained"
        now = f"{abs(cost.ahead_m_s2):.2f} m/s^2 towards the target {verb} at this tick."
    if cost.began_ns is None or cost.ended_ns is None:
        return now
    duration_s = (cost.ended_ns - cost.began_ns) / NS_PER_S
    run = "It is the only changed answer"
    if duration_s > 0.0:
        run = f"It is part of {duration_s:.2f} s of changed answers"
    if cost.behind_s is None or cost.behind_m is None or cost.slower_m_s is None:
        return f"{now} {run}."
    behind = f"about {cost.behind_s:.1f} s ({cost.behind_m:.1f} m) behind one that flew the reference"
    return f"{now} {run}, at the end of which the vehicle is {behind}, and {cost.slower_m_s:.1f} m/s slower (estimate)."


def _vector(v: Split) -> str:
    """Size and direction of an acceleration."""
    if v.norm < SMALL:
        return "no acceleration"
    return f"{v.norm:.2f} m/s^2 {_parts(v, v.norm)}"


def _parts(v: Split, norm: float) -> str:
    """Directions that make up most of a vector: "ahead", "ahead and left"."""
    named = (("ahead", "back", v.ahead), ("left", "right", v.left), ("up", "down", v.up))
    big = sorted(((abs(x), one if x > 0 else other) for one, other, x in named if abs(x) > 0.3 * norm), reverse=True)
    return ", ".join(name for _, name in big)


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


def _in(seconds: float | None) -> str:
    return "now" if not seconds else f"in {seconds:.1f} s"
