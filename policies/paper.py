"""``policies paper``: train every method's network, fly all five on the three cases, write table, figures and JSON."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from companion.policy import load_policy
from policies.baselines import pure_rl
from policies.baselines.pid import PositionPid
from policies.env import PRESETS
from policies.evaluation import paper
from policies.evaluation.bullet import PERIOD_S
from policies.evaluation.paper import CASE_NAMES, Cell, Method, Preset, PresetName
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
    training: dict[str, dict[str, Any]] = {"RL+ACBF": ours}
    config = chosen.with_policy(ours["artifact"])
    policy = load_policy(config.policy, config.limits)
    methods = {
        "PID+ACBF": Method("PID+ACBF", config, reference=lambda: PositionPid(PERIOD_S)),
        "RL+ACBF": Method("RL+ACBF", config, reference=lambda: policy),
    }
    for number, case in enumerate(pure_rl.CASES, start=1):
        name = f"Pure RL (Case {number})"
        law, training[name] = _end_to_end(chosen, case, plan, networks / f"pure_rl_{case}", name, report)
        methods[name] = Method(name, config, end_to_end=law.act)
    cases: dict[str, dict[str, Cell]] = {}
    crossings: dict[str, dict[str, float | None]] = {}
    for index, case_name in enumerate(CASE_NAMES):
        cases[case_name], crossings[case_name] = {}, {}
        for place, name in enumerate(paper.METHODS):
            report(f"{chosen.name}: fly {case_name}, {name}", (index * 5 + place) / 15)
            scenario = paper.retimed(paper.load_case(case_name), chosen, methods[name])
            crossings[case_name][name] = scenario.obstacles[0].cross_at_s
            cases[case_name][name] = _cell(scenario, chosen, methods[name], plan)
    seconds = {method: figures["seconds"] for method, figures in training.items()}
    return {
        "table": paper.table(chosen.name, cases, seconds),
        "training": training,
        "cross_at_s": crossings,
        "cases": {name: {method: cell.to_json() for method, cell in row.items()} for name, row in cases.items()},
        "figures": [str(path) for name in CASE_NAMES for path in _draw(name, cases[name], chosen, plan)],
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
        "success_by_case": {other: pure_rl.success(model, env, other, 1000) for other in pure_rl.CASES},
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


def _cell(scenario: Scenario, chosen: Preset, method: Method, plan: Plan) -> Cell:
    """The flights of one method in one case. Pure RL sees the truth, so that its flights are all the same."""
    exact = paper.fly_case(scenario, chosen, method, exact=True)
    seeds = range(plan.seed, plan.seed + plan.flights) if method.end_to_end is None else ()
    return Cell(exact, tuple(paper.fly_case(scenario, chosen, method, seed=seed) for seed in seeds))


def _draw(case: str, row: dict[str, Cell], chosen: Preset, plan: Plan) -> list[Path]:
    """The figures of one case, of the flights on exact positions."""
    own = f"Pure RL (Case {CASE_NAMES.index(case) + 1})"
    flights = {name: row[method].exact for name, method in (("RL+ACBF",) * 2, ("PID+ACBF",) * 2, ("Pure RL", own))}
    target = paper.load_case(case).target
    assert target is not None, "checked by the tests of the shipped cases"
    return draw_case(case, flights, target.position, plan.folder / chosen.name, f"preset {chosen.name}")
