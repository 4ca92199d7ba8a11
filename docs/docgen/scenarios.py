"""docs/reference/scenarios.md: every table of a scenario file, from its types, and the scenarios that ship."""

from __future__ import annotations

from docgen.pages import table
from docgen.structs import Struct, fields_of, tables_in
from sim_bridge.scenario import Scenario, load_scenario, scenario_names
from sim_bridge.scenario_faults import Fault
from sim_bridge.scenario_obstacles import _Placed


def tables() -> str:
    """A heading and a table of keys for every struct that a file is made of."""
    return "\n\n".join(_block(name, struct) for name, struct in _structs())


def shipped() -> str:
    """Every shipped scenario with what its faults must show."""
    rows = []
    for name in sorted(scenario_names()):
        _, scenario = load_scenario(name)
        rows.append((f"`{name}`", scenario.description, "; ".join(_fault(fault) for fault in scenario.faults)))
    return table(("scenario", "what happens", "what its faults must show"), rows)


def _structs() -> list[tuple[str, Struct]]:
    found: dict[Struct, str] = {Scenario: "At the top of the file"}

    def walk(struct: Struct, prefix: str) -> None:
        for field in fields_of(struct):
            inner = list(tables_in(field.type))
            for each in inner:
                if each in found:
                    continue
                if issubclass(each, _Placed):
                    found.setdefault(_Placed, "`[[obstacles]]`, every motion")
                name = f"{prefix}{field.name}"
                many = field.kind.startswith("list")
                title = f"`[[{name}]]`" if many else f"`[{name}]`"
                tag = each.__struct_config__.tag
                if tag is not None:
                    title += f', `{each.__struct_config__.tag_field} = "{tag}"`'
                found[each] = title
                walk(each, f"{name}.")

    walk(Scenario, "")
    return [(title, struct) for struct, title in found.items()]


def _block(title: str, struct: Struct) -> str:
    """A heading, what the struct says of itself, and its keys; of an obstacle those that not every motion has."""
    rows = []
    inherits = issubclass(struct, _Placed) and struct is not _Placed
    common = {field.name for field in fields_of(_Placed)} if inherits else set()
    for field in fields_of(struct):
        if list(tables_in(field.type)) or field.name in common:
            continue
        default = field.default if field.default in ("unset", "") else f"`{field.default}`"
        rows.append((f"`{field.name}`", field.kind, default or "must be stated", _tidy(field.comment)))
    doc = " ".join((struct.__doc__ or "").replace("``", "`").split())
    inherited = doc == " ".join((struct.__base__.__doc__ or "").split()) if struct.__base__ else False
    own = "" if inherited or "module" in doc else doc
    keys = table(("key", "value", "default", "meaning"), rows) if rows else "No keys of its own."
    return "\n\n".join(part for part in (f"## {title}", own, keys) if part)


def _fault(fault: Fault) -> str:
    said = f"{fault.what} on {fault.on}"
    if (expect := fault.expect) is None:
        return said
    wanted = [f"{key} `{value}`" for key in ("state", "verdict", "mode", "text") if (value := getattr(expect, key))]
    return f"{said}: {', '.join(wanted)} within {expect.within_s:g} s"


def _tidy(text: str) -> str:
    return text.replace("None:", "unset:").replace("``", "`").replace("<", "\\<")
