"""``policies paper``: train every method's network, fly all five on the three cases, write table, figures and JSON."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from companion.config import Config
from companion.pilot import ReferenceLaw
from companion.policy import load_policy
from policies.baselines import pure_rl
from policies.baselines.pid import PositionPid
from policies.env import PRESETS
from policies.evaluation import paper
from policies.evaluation.bullet import PERIOD_S
from policies.evaluation.paper import CASE_NAMES, Cell, Flown, Preset, PresetName
from policies.evaluation.paper_figures import draw_case
from policies.run import provenance, run
from policies.train import TRAIN_PRESETS, CurvePoint, TrainConfig
from sim_bridge.scenario import Scenario

STARTS = 200  # of the evaluation of our policy's artefact
Report = Callable[[str, float], None]  # what is under way, and its share done


@dataclass(frozen=True, slots=True)
class Plan:
    """What to do. ``steps`` None: the presets' own."""

    presets: tuple[PresetName, ...]
    folder: Path
    flights: int = 10
    seed: int = 0
    steps: int | None = None


def compare(plan: Plan, report: Report = lambda what, share: None) -> dict[str, Any]:
    """Everything of every preset; networks that ``folder`` already has, made with the same settings, are taken."""
    outcome = {name: _compare_preset(paper.preset(name), plan, report) for name in plan.presets}
    tables = [outcome[name]["table"] for name in plan.presets]
    (plan.folder / "table3.md").write_text("\n".join(tables), encoding="utf-8")
    result = {"provenance": provenance(plan.seed), "presets": outcome}
    (plan.folder / "paper.json").write_bytes(msgspec.json.format(msgspec.json.encode(result), indent=1) + b"\n")
    return result


def _compare_preset(chosen: Preset, plan: Plan, report: Report) -> dict[str, Any]:
    networks = plan.folder / "networks" / chosen.name
    ours = _our_policy(chosen, plan, networks / "rl", report)
    config = chosen.with_policy(ours["artifact"])
    training: dict[str, dict[str, Any]] = {"RL+ACBF": ours}
    laws: dict[str, paper.EndToEndLaw] = {}
    for number, case in enumerate(pure_rl.CASES, start=1):
        method = f"Pure RL (Case {number})"
        law, training[method] = _end_to_end(chosen, case, plan, networks / f"pure_rl_{case}", method, report)
        laws[method] = law.act
    policy = load_policy(config.policy, config.limits)
    cases: dict[str, dict[str, Cell]] = {}
    scenarios: dict[str, Scenario] = {}
    for index, case_name in enumerate(CASE_NAMES):
        scenarios[case_name] = paper.retimed(paper.load_case(case_name), chosen, policy, config)
        cases[case_name] = {}
        for place, method in enumerate(paper.METHODS):
            report(f"{chosen.name}: fly {case_name}, {method}", (index * 5 + place) / 15)
            cases[case_name][method] = _cell(
                scenarios[case_name], chosen, plan, config, method, laws.get(method), policy
            )
    seconds = {method: figures["seconds"] for method, figures in training.items()}
    return {
        "table": paper.table(chosen.name, cases, seconds),
        "training": training,
        "cross_at_s": {name: scenario.obstacles[0].cross_at_s for name, scenario in scenarios.items()},
        "cases": {name: {method: cell.to_json() for method, cell in row.items()} for name, row in cases.items()},
        "figures": [
            str(path) for name in CASE_NAMES for path in _draw(name, cases[name], scenarios[name], chosen, plan)
        ],
    }


def _our_policy(chosen: Preset, plan: Plan, folder: Path, report: Report) -> dict[str, Any]:
    env, base = PRESETS[chosen.name], TRAIN_PRESETS[chosen.name]
    config = replace(base, seed=plan.seed, steps=plan.steps or base.steps)
    settings = {"env": asdict(env), "train": asdict(config)}
    known = _known(folder, settings)
    if known is not None:
        return known
    show = _shown(f"{chosen.name}: train RL+ACBF's policy", config, report)
    made = run(env, config, folder, name=chosen.name, starts=STARTS, on_point=show)
    return _remember(folder, settings, made)


def _end_to_end(
    chosen: Preset, case: pure_rl.Case, plan: Plan, folder: Path, method: str, report: Report
) -> tuple[pure_rl.EndToEnd, dict[str, Any]]:
    env, base = PRESETS[chosen.name], pure_rl.TRAINING
    config = replace(base, seed=plan.seed, steps=plan.steps or base.steps, gamma=TRAIN_PRESETS[chosen.name].gamma)
    settings = {"env": asdict(env), "train": asdict(config), "case": case}
    network = folder / "network.safetensors"
    known = _known(folder, settings)
    if known is not None and network.is_file():
        return pure_rl.EndToEnd(pure_rl.restore(network, env, case, config), chosen.k_ma_m_s2), known
    show = _shown(f"{chosen.name}: train {method}", config, report)
    model, curve, seconds = pure_rl.train_case(env, case, config, on_point=show)
    pure_rl.save(model, network)
    to_99 = next((point for point in curve if point.success >= 0.99), None)
    made = {
        "seconds": seconds,
        "steps": config.steps,
        "success_own_case": pure_rl.success(model, env, case, 1000),
        "seconds_to_99_percent": None if to_99 is None else to_99.seconds,
    }
    return pure_rl.EndToEnd(model, chosen.k_ma_m_s2), _remember(folder, settings, made)


def _known(folder: Path, settings: dict[str, Any]) -> dict[str, Any] | None:
    """The figures of an earlier run with the same settings."""
    try:
        record = json.loads((folder / "record.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    same = isinstance(record, dict) and record.get("settings") == json.loads(json.dumps(settings))
    return dict(record["figures"]) if same else None


def _remember(folder: Path, settings: dict[str, Any], figures: dict[str, Any]) -> dict[str, Any]:
    record = {"settings": settings, "figures": figures}
    (folder / "record.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    return figures


def _shown(what: str, config: TrainConfig, report: Report) -> Callable[[CurvePoint], None]:
    return lambda point: report(f"{what}, {point.success:.0%}", point.steps / config.steps)


def _cell(
    scenario: Scenario,
    chosen: Preset,
    plan: Plan,
    config: Config,
    method: str,
    law: paper.EndToEndLaw | None,
    policy: ReferenceLaw,
) -> Cell:
    """The flights of one method in one case, one a seed of the sensor."""

    def fly(seed: int) -> Flown:
        if law is not None:
            return paper.fly_case(scenario, chosen, seed=seed, end_to_end=law)
        reference = PositionPid(PERIOD_S) if method == "PID+ACBF" else policy
        return paper.fly_case(scenario, chosen, seed=seed, reference=reference, config=config)

    first = fly(plan.seed)
    # Pure RL sees the truth, so that its flights are all the same
    rest = [] if law is not None else [fly(plan.seed + k) for k in range(1, plan.flights)]
    flown = [first, *rest]
    return Cell(
        first,
        tuple(flight.clearance_m for flight in flown),
        sum(flight.collided for flight in flown),
        sum(flight.arrival_s is not None for flight in flown),
    )


def _draw(case: str, row: dict[str, Cell], scenario: Scenario, chosen: Preset, plan: Plan) -> list[Path]:
    own = f"Pure RL (Case {CASE_NAMES.index(case) + 1})"
    flights = {name: row[method].flight for name, method in (("RL+ACBF",) * 2, ("PID+ACBF",) * 2, ("Pure RL", own))}
    assert scenario.target is not None
    return draw_case(case, flights, scenario.target.position, plan.folder / chosen.name, f"preset {chosen.name}")
