"""The JSON Schema of scenario files, as `sim-bridge schema` prints it.

It holds what one value must be: types, ranges, names, required and unknown keys. What one table demands of another
(`scenario_checks`) is beyond it.
"""

from __future__ import annotations

from typing import Any

import msgspec

from sim_bridge.scenario import Scenario


def scenario_schema() -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of a scenario file."""
    (reference,), definitions = msgspec.json.schema_components([Scenario], ref_template="#/$defs/{name}")
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "sim-bridge scenario",
        **reference,
        "$defs": definitions,
    }
