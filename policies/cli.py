"""``policies``: train what flies, and measure it."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

from companion.errors import CompanionError, ConfigError
from companion.policy import artifact_folder

TRAIN_EXAMPLE = "example: policies train --seed 1 --out runs/first && policies evaluate runs/first/artifact"
EVALUATE_EXAMPLE = "example: policies evaluate builtin:default --starts 200 --json"


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
    parser = argparse.ArgumentParser(prog="policies", description="Train, export and evaluate policies.")
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
    evaluate.add_argument("--json", action="store_true", help="one JSON object on stdout")
    evaluate.set_defaults(command=_evaluate)
    return parser


def _count(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"expected a whole number, not negative, got {value}")
    return value


def _require_train_extra() -> None:
    try:
        import gymnasium  # noqa: F401
        import onnx  # noqa: F401
        import stable_baselines3  # noqa: F401
        import torch  # noqa: F401
    except ModuleNotFoundError as error:
        raise ConfigError(f"train: {error.name} is not installed, expected companion-safety[train]") from None


def _train(args: argparse.Namespace) -> int:
    _require_train_extra()
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
    from policies.evaluation.artifact import evaluate

    figures = evaluate(artifact_folder(args.artifact), starts=args.starts, seed=args.seed)
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
