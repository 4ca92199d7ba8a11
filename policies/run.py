"""One training run from configuration to artefact: a folder with everything that tells how it came about."""

from __future__ import annotations

import platform
import subprocess
from collections.abc import Callable
from dataclasses import asdict
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec

from policies.env import EnvConfig
from policies.evaluation.artifact import evaluate
from policies.export import contract, network_files, write_artifact
from policies.train import CurvePoint, TrainConfig, Trained, train

HELD_SEED = 10_007  # never trained on, nor tuned with
PACKAGES = ("numpy", "torch", "stable-baselines3", "onnx", "onnxruntime")


def run(
    env: EnvConfig,
    config: TrainConfig,
    folder: Path,
    *,
    name: str,
    resume: Path | None = None,
    starts: int = 1000,
    on_point: Callable[[CurvePoint], None] = lambda point: None,
) -> dict[str, Any]:
    """Train, export to ``folder/artifact``, evaluate what was exported; the figures, which the manifest holds too.

    ``folder`` gets config.json, curve.csv, curves.png, checkpoints/ and artifact/.
    """
    folder.mkdir(parents=True, exist_ok=True)
    settings = {"env": asdict(env), "train": asdict(config)}
    (folder / "config.json").write_bytes(msgspec.json.format(msgspec.json.encode(settings), indent=1) + b"\n")
    trained = train(env, config, checkpoints=folder / "checkpoints", resume=resume, on_point=on_point)
    write_curve(trained, folder)
    artifact = folder / "artifact"
    files = network_files(trained.weights)
    manifest = msgspec.structs.replace(
        contract(env, name),
        network={"kind": "axis_shared", "width": config.actor_width},
        training={"algorithm": "PPO (stable-baselines3)", **settings, **_progress(trained)},
        provenance=provenance(config.seed),
    )
    write_artifact(artifact, manifest, files)
    figures = evaluate(artifact, starts=starts, seed=HELD_SEED, env=env)
    write_artifact(artifact, msgspec.structs.replace(manifest, evaluation=figures), files)
    return {"artifact": str(artifact), **_progress(trained), "evaluation": figures}


def write_curve(trained: Trained, folder: Path) -> None:
    """curve.csv and curves.png: return and success over environment steps."""
    rows = [f"{p.steps},{p.seconds:.3f},{p.mean_return:.4f},{p.success:.4f}" for p in trained.curve]
    (folder / "curve.csv").write_text("steps,seconds,mean_return,success\n" + "\n".join(rows) + "\n", encoding="utf-8")
    from matplotlib.figure import Figure  # half a second of import, needed here only

    figure = Figure(figsize=(8, 4), layout="constrained")
    left = figure.subplots()
    steps = [p.steps for p in trained.curve]
    left.plot(steps, [p.mean_return for p in trained.curve], color="tab:blue")
    left.set_xlabel("environment steps")
    left.set_ylabel("mean return of 500 episodes", color="tab:blue")
    right = left.twinx()
    right.plot(steps, [100.0 * p.success for p in trained.curve], color="tab:orange")
    right.set_ylabel("reached the target [%]", color="tab:orange")
    right.set_ylim(0.0, 102.0)
    figure.savefig(folder / "curves.png", dpi=120)


def provenance(seed: int) -> dict[str, Any]:
    """Where and from what an artefact was made."""
    here = Path(__file__).resolve().parent
    commit = _git(here, "rev-parse", "HEAD")
    return {
        "seed": seed,
        "commit": commit,
        "modified": bool(_git(here, "status", "--porcelain", "--", "*.py")) if commit else None,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "python": platform.python_version(),
        "packages": {package: version(package) for package in PACKAGES},
        "machine": platform.machine(),
        "processor": _processor(),
    }


def _progress(trained: Trained) -> dict[str, Any]:
    to_99 = trained.to_99
    return {
        "seconds": round(trained.seconds, 2),
        "cpu_seconds": round(trained.cpu_seconds, 2),
        "steps_to_99_percent": None if to_99 is None else to_99.steps,
        "seconds_to_99_percent": None if to_99 is None else round(to_99.seconds, 2),
    }


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None  # an installed package is no checkout
    return done.stdout.strip()


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{len(names)} x {names[0]}" if names else platform.processor()
