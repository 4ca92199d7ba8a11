"""Every Zenoh key of the daemon with its quality of service, and their page (`docs/reference/keys.md`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import msgspec
import zenoh

from companion.link import wire
from companion.link.inbox import MAX_PAYLOAD_BYTES


@dataclass(frozen=True, slots=True)
class Outlet:
    """Quality of service of one outgoing key. All are RELIABLE on their link, and DROP: no reader may delay a tick.

    ``each_tick``: one message a tick, and BLOCK in lockstep, where the simulator waits for each.
    ``express``: sent at once instead of being gathered with others for up to 1 ms.
    """

    priority: zenoh.Priority
    express: bool
    each_tick: bool
    why: str


OUTLETS = {
    "companion/setpoint": Outlet(
        zenoh.Priority.DATA_HIGH,
        express=True,
        each_tick=True,
        why="May drop: each record is whole and the next follows within a tick; the log keeps all."
        " First in line and unbatched, because latency is measured by it.",
    ),
    "companion/vehicle": Outlet(
        zenoh.Priority.DATA, express=False, each_tick=True, why="May drop: the next one replaces it."
    ),
    "companion/tracks": Outlet(
        zenoh.Priority.DATA_LOW,
        express=False,
        each_tick=True,
        why="May drop: the next one replaces it. The largest message, so it yields to all others.",
    ),
    "companion/status": Outlet(
        zenoh.Priority.DATA,
        express=False,
        each_tick=False,
        why="May drop: repeated at 5 Hz, so that a change that is lost is late by 0.2 s at most.",
    ),
}

# what the publisher should choose, and why
INLETS = {
    "obstacles/{source}": (
        "DROP, express",
        "May drop: a frame carries all that its source sees, so the next makes up for it, while a frame that waits"
        " for room is a stale one. Up to `obstacles.queue` wait for a tick, then the oldest is dropped and counted."
        f" At most {MAX_PAYLOAD_BYTES} bytes.",
    ),
    "vehicle/state": (
        "DROP, express",
        'May drop: only the newest counts. Read only with `vehicle.source = "zenoh"`.',
    ),
    "target": (
        "query, or put with BLOCK",
        "May not drop: it comes once. A query is answered with accepted or why not; a put is not acknowledged.",
    ),
    "engage": (
        "query, or put with BLOCK",
        "May not drop: it comes once. A query is answered; a release that matters is repeated until it is.",
    ),
    "sync/{source}": ("BLOCK", "May not drop: the tick waits for it. Read only in lockstep, and nowhere in flight."),
}

QUERYABLES = {
    "target": ("TargetCommand", "Reply", "accepted, or why not"),
    "engage": ("EngageCommand", "Reply", "accepted, or why not"),
    "companion/config": ("none", "JSON", "the resolved configuration and its hash; paths of secrets, never secrets"),
    "companion/health": ("none", "JSON", "healthy, state, reason, tick times"),
}
ALIVE = "companion/alive"

_HEAD = """\
# Zenoh keys

This page is what `companion schema --keys` prints; a test compares the two. Every key stands below `uav/<name>`
(`vehicle.name`, default `uav1`). Payloads are JSON (`application/json`) or MessagePack (`application/msgpack`); without
an encoding the first byte tells. The daemon itself writes JSON. Unknown fields are ignored, a missing or ill-typed one
rejects the payload whole. `companion schema KEY` prints the JSON Schema.
"""

_RULES = """\
## Why these

- **What is repeated may drop, what comes once may not.** Congestion control DROP gives up a message where there is no
  room, BLOCK makes the sender wait. The daemon never waits in flight: a reader on a bad link must not cost a tick.
- **Reliability is not delivery.** RELIABLE orders and repeats within one link; under DROP a full queue still loses
  messages, on loopback too. Nothing here depends on a single message arriving.
- **Commands are queries.** Only a query tells the sender that the command arrived and what came of it. A reply travels
  with the quality of service of its query (Zenoh's default: BLOCK).
- **The order across keys is not promised**, and no part of the daemon relies on it: frames count at their own stamps.
- **Presence** is the liveliness token: it goes within milliseconds of the end of the process, and 10 s after the link
  to it was cut.
"""


def key_page() -> str:
    """The documentation of every key as Markdown."""
    lines = [_HEAD, "## The daemon reads", "", "| key | payload | sender should use | why |", "|---|---|---|---|"]
    for key, kind in wire.INCOMING.items():
        use, why = INLETS[key]
        lines.append(f"| `{key}` | {_link(kind)} | {use} | {why} |")
    lines += ["", "## The daemon writes", ""]
    lines += [
        "| key | payload | when | flight | lockstep | priority | express | why |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for key, outlet in OUTLETS.items():
        when = "each tick" if outlet.each_tick else "5 Hz and on change"
        lockstep = "BLOCK" if outlet.each_tick else "DROP"
        cells = (f"`{key}`", _link(wire.OUTGOING[key]), when, "DROP", lockstep, str(outlet.priority).split(".")[-1])
        lines.append(f"| {' | '.join(cells)} | {'yes' if outlet.express else 'no'} | {outlet.why} |")
    lines.append(f"| `{ALIVE}` | liveliness token | while the daemon runs | | | | | presence |")
    lines += ["", "## The daemon answers", "", "| key | query | reply | what |", "|---|---|---|---|"]
    lines += [f"| `{key}` | {query} | {reply} | {what} |" for key, (query, reply, what) in QUERYABLES.items()]
    lines += ["", _RULES, "## Payloads"]
    for name, schema in _definitions().items():
        lines += ["", f"### {name}", "", _summary(schema), "", "| field | type | default |", "|---|---|---|"]
        required = schema.get("required", [])
        for field, kind in schema["properties"].items():
            default = "" if field in required else f"`{_plain(kind.get('default'))}`"
            lines.append(f"| `{field}` | {_type(kind)} | {default} |")
    return "\n".join(lines) + "\n"


def _link(kind: type[msgspec.Struct]) -> str:
    return f"[{kind.__name__}](#{kind.__name__.lower()})"


def _definitions() -> dict[str, dict[str, Any]]:
    """Every struct of the wire, in the order in which they are first used."""
    kinds = list(dict.fromkeys([*wire.INCOMING.values(), *wire.OUTGOING.values()]))
    _, components = msgspec.json.schema_components(kinds, ref_template="{name}")
    return dict(components)


def _summary(schema: dict[str, Any]) -> str:
    return " ".join(str(schema.get("description", "")).split())


def _plain(value: object) -> str:
    return msgspec.json.encode(value).decode()


def _type(schema: dict[str, Any]) -> str:
    """A JSON Schema in words."""
    if "anyOf" in schema:
        return " or ".join(_type(each) for each in schema["anyOf"])
    if "$ref" in schema:
        return f"[{schema['$ref']}](#{schema['$ref'].lower()})"
    if "enum" in schema:
        return " or ".join(f"`{_plain(value)}`" for value in schema["enum"])
    if "prefixItems" in schema:
        return f"[{', '.join(_type(each) for each in schema['prefixItems'])}]"
    low, high = schema.get("minItems"), schema.get("maxItems")
    if schema.get("type") == "array":
        count = "" if high is None else f" of {high}" if low == high else f" of at most {high}"
        return f"list{count}: {_type(schema['items'])}"
    if schema.get("type") == "object":
        return f"object of {_type(schema['additionalProperties'])}"
    return str(schema["type"]) + _bounds(schema)


def _bounds(schema: dict[str, Any]) -> str:
    low, high = schema.get("minimum"), schema.get("maximum")
    if "maxLength" in schema:
        return f" of {schema.get('minLength', 0)} to {schema['maxLength']} characters"
    if high == 2**63 - 1:
        return " of 64 bits"
    return "" if low is None else f" {low} to {high}"
