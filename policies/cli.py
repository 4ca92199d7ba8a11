"""``policies``: train what flies, and measure it."""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
import os
import signal
import sys
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any, NoReturn

from companion.errors import CompanionError, ConfigError
from companion.policy import artifact_folder

TRAIN_EXAMPLE = "example: policies train --seed 1 --out runs/first && policies evaluate runs/first/artifact"
EVALUATE_EXAMPLE = "example: policies evaluate builtin:default --starts 200 --json"
BENCH_EXAMPLE = "example: policies bench builtin:default --calls 20000"
PAPER_EXAMPLE = "example: policies paper --preset default --out runs/paper"
ENCOUNTERS_EXAMPLE = "example: policies encounters --flights 2000 --noise 0.2236 --json"


class _Parser(argparse.ArgumentParser):
    """Wrong usage is one line that names the option."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}\n")


def main(argv: Sequence[str] | None = None) -> int:
    """Exit status 0 done, 1 failed, 2 wrong usage or configuration."""
    args = _parser().parse_args(argv)
    command: Any = args.command
    try:
        return int(command(args))
    except ConfigError as error:
        print(f"policies: {error}", file=sys.stderr)
        return 2
    except (CompanionError, OSError) as error:
        print(f"policies: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("policies: interrupted", file=sys.stderr)
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="policies", description="Train, export and evaluate policies.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    train = commands.add_parser("train", help="train a policy with PPO", epilog=TRAIN_EXAMPLE)
    train.add_argument("--preset", choices=("default", "paper"), default="default", help="task and hyperparameters")
    train.add_argument("--seed", type=_count, default=0)
    train.add_argument("--steps", type=_count, help="environment steps over all vehicles (default: the preset's)")
    train.add_argument("--threads", type=_count, help="torch threads (default: the preset's)")
    train.add_argument("--out", type=Path, help="run folder (default: runs/<time>)")
    train.add_argument("--resume", type=Path, metavar="CHECKPOINT", help="go on from RUN/checkpoints/STEPS.safetensors")
    train.add_argument("--starts", type=_count, default=1000, help="flights of the evaluation at the end")
    train.add_argument("--json", action="store_true", help="one JSON object on stdout")
    train.set_defaults(command=_train)
    evaluate = commands.add_parser("evaluate", help="fly an artefact on the point mass", epilog=EVALUATE_EXAMPLE)
    evaluate.add_argument("artifact", help="an artefact's folder, or builtin:NAME")
    evaluate.add_argument("--starts", type=_count, default=1000)
    evaluate.add_argument("--seed", type=_count, default=20_011, help="of the starts and targets")
    evaluate.add_argument(
        "--plant",
        choices=("point", "pybullet"),
        default="point",
        help="a point mass with lag, or the simulated Crazyflie (slower; default: point)",
    )
    evaluate.add_argument("--json", action="store_true", help="one JSON object on stdout")
    evaluate.set_defaults(command=_evaluate)
    bench = commands.add_parser("bench", help="time one inference on each backend", epilog=BENCH_EXAMPLE)
    bench.add_argument("artifact", nargs="?", default="builtin:default", help="an artefact's folder, or builtin:NAME")
    bench.add_argument("--calls", type=_positive, default=20_000)
    bench.add_argument("--json", action="store_true", help="one JSON object on stdout")
    bench.set_defaults(command=_bench)
    _add_paper(commands)
    _add_encounters(commands)
    return parser


def _add_paper(commands: argparse._SubParsersAction[_Parser]) -> None:
    paper = commands.add_parser(
        "paper",
        help="fly the paper's comparison: five methods, three cases, Table 3 and figures 5 to 13",
        description="Trains what the methods need, flies all of them in PyBullet, and writes table3.md, paper.json, "
        "the figures and the networks into a folder. Networks that the folder already has, made with the same "
        "settings, are flown again without training. From scratch both presets take about ten minutes on two cores.",
        epilog=PAPER_EXAMPLE,
    )
    paper.add_argument("--preset", choices=("both", "paper", "default"), default="both", help="the paper's parameters")
    paper.add_argument("--out", type=Path, help="folder (default: runs/paper-<time>)")
    paper.add_argument("--flights", type=_positive, default=10, help="of each cell, one a seed of the sensor's noise")
    paper.add_argument("--seed", type=_count, default=0, help="of training, and of the first flight")
    paper.add_argument("--steps", type=_positive, help="environment steps of every training (default: each its own)")
    paper.add_argument("--json", action="store_true", help="one JSON object on stdout")
    paper.set_defaults(command=_paper)


def _add_encounters(commands: argparse._SubParsersAction[_Parser]) -> None:
    encounters = commands.add_parser(
        "encounters", help="fly tracker and filter against obstacles timed to hit", epilog=ENCOUNTERS_EXAMPLE
    )
    encounters.add_argument("--obstacles", type=_positive, default=1, help="in each encounter")
    encounters.add_argument("--flights", type=_positive, default=2000)
    encounters.add_argument("--noise", type=_not_negative, default=0.2236, help="of the sensor, 1 sigma an axis [m]")
    encounters.add_argument("--latency", type=_not_negative, default=0.05, help="of the sensor [s]")
    encounters.add_argument("--dropout", type=_share, default=0.0, help="share of the sensor's frames that are lost")
    encounters.add_argument("--seed", type=_count, default=20_000, help="of the first flight; the next has the next")
    encounters.add_argument("--config", type=Path, metavar="FILE", help="TOML configuration (default: the defaults)")
    encounters.add_argument("--jobs", type=_positive, default=os.cpu_count() or 1, help="processes (default: all CPUs)")
    encounters.add_argument("--json", action="store_true", help="one JSON object on stdout")
    encounters.set_defaults(command=_encounters)


def _count(text: str) -> int:
    return _whole(text, 0)


def _positive(text: str) -> int:
    return _whole(text, 1)


def _whole(text: str, least: int) -> int:
    try:
        value = int(text)
    except ValueError:
        value = least - 1
    if value < least:
        raise argparse.ArgumentTypeError(f"expected a whole number of at least {least}, got {text}")
    return value


def _not_negative(text: str, most: float = 1e6) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 <= value <= most:
        raise argparse.ArgumentTypeError(f"expected a number from 0 to {most:g}, got {text}")
    return value


def _share(text: str) -> float:
    return _not_negative(text, 1.0)


def _require(command: str, **modules: str) -> None:
    """Refuse a command whose modules (name -> extra) are not installed, in one line."""
    for module, extra in modules.items():
        if importlib.util.find_spec(module) is None:
            raise ConfigError(f"{command}: {module} is not installed, expected companion-safety[{extra}]")


_TRAINING = {"gymnasium": "train", "onnx": "train", "stable_baselines3": "train", "torch": "train"}


def _train(args: argparse.Namespace) -> int:
    _require("train", **_TRAINING)
    from policies.display import training_display
    from policies.env import PRESETS
    from policies.run import run
    from policies.train import TRAIN_PRESETS

    chosen = {name: getattr(args, name) for name in ("steps", "threads") if getattr(args, name)}
    config = replace(TRAIN_PRESETS[args.preset], seed=args.seed, **chosen)
    folder = args.out or Path("runs") / datetime.now().astimezone().strftime("%Y%m%d-%H%M%S")
    with training_display(config.steps) as on_point:
        outcome = run(
            PRESETS[args.preset],
            config,
            folder,
            name=args.preset,
            resume=args.resume,
            starts=args.starts,
            on_point=on_point,
        )
    _print(outcome, args.json)
    return 0 if outcome["evaluation"]["reached"] == args.starts else 1


def _evaluate(args: argparse.Namespace) -> int:
    from policies.display import flights_display
    from policies.evaluation.artifact import evaluate

    if args.plant == "pybullet":
        _require("evaluate --plant pybullet", pybullet="sim")
    with flights_display("evaluate", args.starts, shown=args.plant == "pybullet") as on_flight:
        folder = artifact_folder(args.artifact)
        figures = evaluate(folder, starts=args.starts, seed=args.seed, plant=args.plant, on_flight=on_flight)
    _print(figures, args.json)
    return 0


def _bench(args: argparse.Namespace) -> int:
    from policies.bench import measure

    figures = measure(artifact_folder(args.artifact), args.calls)
    if args.json:
        print(json.dumps(figures))
        return 0
    print(f"{figures['calls']} calls on one thread, microseconds")
    print(f"{'':28s}{'p50':>9s}{'p99':>9s}{'p99.9':>9s}{'max':>9s}")
    for name, values in figures["milliseconds"].items():
        shown = ["-" if values[key] is None else f"{1e3 * values[key]:.1f}" for key in ("p50", "p99", "p999", "max")]
        print(f"{name:28s}" + "".join(f"{text:>9s}" for text in shown))
    print(figures["left_out"] or f"greatest difference of the backends: {figures['greatest_difference']:.1e}")
    return 0


def _paper(args: argparse.Namespace) -> int:
    _require("paper", **_TRAINING, pybullet="sim", matplotlib="sim")
    from policies.display import work_display
    from policies.evaluation.paper import PRESET_NAMES
    from policies.paper import Plan, compare

    folder = args.out or Path("runs") / datetime.now().astimezone().strftime("paper-%Y%m%d-%H%M%S")
    folder.mkdir(parents=True, exist_ok=True)
    presets = PRESET_NAMES if args.preset == "both" else (args.preset,)
    with work_display() as report:
        result = compare(Plan(presets, folder, args.flights, args.seed, args.steps), report)
    if args.json:
        print(json.dumps(result))
    else:
        print("\n".join(result["presets"][name]["table"] for name in presets))
        print(f"figures, table3.md and paper.json: {folder}")
    return 0


def _encounters(args: argparse.Namespace) -> int:
    from companion.config import Config, load_config
    from policies.display import encounters_display
    from policies.evaluation.campaign import fly_all, report
    from policies.evaluation.encounters import Sensor

    config = load_config(args.config) if args.config else Config()
    sensor = Sensor(noise_std_m=args.noise, latency_s=args.latency, dropout=args.dropout)
    seeds = range(args.seed, args.seed + args.flights)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # or the workers would fly on
    with encounters_display(args.flights) as show:
        outcomes = fly_all(seeds, args.obstacles, config, sensor, jobs=args.jobs, on_outcome=show)
    figures = report(outcomes).to_json()
    if not args.json:
        figures |= {f"share_of_{name}": share for name, share in figures["verdict_shares"].items()}
    _print(figures, args.json)
    return 0


def _print(values: dict[str, Any], as_json: bool) -> None:
    if as_json:
        print(json.dumps(values))
        return
    flat = {**{k: v for k, v in values.items() if not isinstance(v, dict)}, **values.get("evaluation", {})}
    for key, value in flat.items():
        shown = [round(x, 4) for x in value] if isinstance(value, list) else value
        print(f"{key:34s} {round(shown, 4) if isinstance(shown, float) else shown}")


if __name__ == "__main__":
    sys.exit(main())
