"""Imports flow one way, the two sides never meet, the brain reads no clock and no wire, the base install is light."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("companion", "sim_bridge", "policies")

# each layer may import itself and what stands before it
LAYERS = [
    {"companion", "companion.__version__", "companion.types", "companion.errors"},
    {"companion.frames", "companion.profiles", "companion.clock"},
    {
        "companion.config",
        "companion.config_check",
        "companion.config_links",
        "companion.config_realtime",
        "companion.config_traffic",
        "companion.config_types",
    },
    {
        "companion.tunables",
        "companion.threats",
        "companion.texts",
        "companion.hostload",
        "companion.realtime",
        "companion.tlog",
    },
    {
        "companion.tracking",
        "companion.safety",
        "companion.policy",
        "companion.torch_backend",
        "companion.disturbance",
        "companion.origin",
    },
    {"companion.pilot"},
    {"companion.state"},
    {"companion.log_files", "companion.foxglove", "companion.provenance"},
    {"companion.log_writer"},
    {"companion.link", "companion.metrics", "companion.route", "companion.report", "companion.record"},
    {"companion.scene"},
    {"companion.scene_log"},
    {
        "companion.notices",
        "companion.confirm",
        "companion.requests",
        "companion.modes",
        "companion.watch",
    },
    {
        "companion.latch",
        "companion.lockstep",
        "companion.microservices",
        "companion.parameters",
        "companion.session",
        "companion.timebase",
        "companion.thinker",
        "companion.publisher",
        "companion.doors",
    },
    {"companion.logbook"},
    {"companion.service", "companion.publish", "companion.demo", "companion.bench", "companion.doctor"},
    {"companion.cli"},
]
BRAIN = (
    "companion/tracking",
    "companion/safety",
    "companion/policy.py",
    "companion/torch_backend.py",
    "companion/pilot.py",
    "companion/disturbance.py",
    "companion/threats.py",
    "companion/tunables.py",
    "companion/origin.py",
)
NOT_IN_BRAIN = {"asyncio", "socket", "time", "random", "os", "logging", "threading", "datetime"}
HEAVY = {"torch", "pybullet", "matplotlib", "filterpy", "mavsdk", "stable_baselines3", "gymnasium"}
HEAVY |= {"cbfpy", "jax", "quadprog", "rosbags"}
SELDOM = {"scipy", "osqp", "jinja2", "rich", "pandas", "PIL", "IPython", "unittest", "multiprocessing"}


def modules(folder: str) -> list[Path]:
    path = ROOT / folder
    return [path] if path.suffix else sorted(path.rglob("*.py"))


def imported(path: Path, *, top_level_only: bool = False) -> set[str]:
    """Absolute names of every module that ``path`` imports."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    nodes = tree.body if top_level_only else ast.walk(tree)
    names: set[str] = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names.add(node.module or "")
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def roots(path: Path) -> set[str]:
    return {name.partition(".")[0] for name in imported(path)}


def layer_of(module: str) -> int | None:
    for index in range(len(LAYERS) - 1, -1, -1):
        for name in LAYERS[index]:
            if module == name or (name != "companion" and module.startswith(name + ".")):
                return index
    return None


def name_of(path: Path) -> str:
    parts = list(path.relative_to(ROOT).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@pytest.mark.parametrize("path", modules("companion"), ids=name_of)
def test_companion_imports_flow_one_way(path: Path) -> None:
    own = layer_of(name_of(path))
    assert own is not None, f"{path}: belongs to no layer; add it to LAYERS"
    for name in imported(path):
        if name.partition(".")[0] != "companion":
            continue
        other = layer_of(name)
        assert other is not None, f"{path} imports {name}, which belongs to no layer"
        assert other <= own, f"{path} imports {name}, which stands above it"


def test_link_knows_types_and_frames_only() -> None:
    allowed = {"types", "errors", "frames", "profiles", "clock", "config", "config_links", "config_traffic", "link"}
    for path in modules("companion/link"):
        for name in imported(path):
            if name.startswith("companion."):
                assert name.split(".")[1] in allowed, f"{path} imports {name}"


@pytest.mark.parametrize(("side", "other"), [("companion", "sim_bridge"), ("sim_bridge", "companion")])
def test_the_two_sides_never_import_each_other(side: str, other: str) -> None:
    for path in modules(side):
        assert other not in roots(path), path


@pytest.mark.parametrize("side", ["companion", "sim_bridge"])
def test_neither_side_imports_policies(side: str) -> None:
    for path in modules(side):
        assert "policies" not in roots(path), path


def test_the_brain_reads_no_clock_and_no_wire() -> None:
    for folder in BRAIN:
        for path in modules(folder):
            assert not roots(path) & NOT_IN_BRAIN, f"{path}: {roots(path) & NOT_IN_BRAIN}"
            assert not {n for n in imported(path) if n.startswith("companion.link")}, path


def test_only_the_clock_module_reads_time() -> None:
    for path in modules("companion"):
        if name_of(path) not in {"companion.clock", "companion.demo.command"}:  # the demo names its folder by the date
            assert "time" not in roots(path), path


def test_heavy_packages_are_imported_where_they_are_used_only() -> None:
    for path in modules("companion"):
        if name_of(path) == "companion.torch_backend":  # imported by policy.py when the configuration asks for it
            continue
        names = {name.partition(".")[0] for name in imported(path, top_level_only=True)}
        assert not names & HEAVY, f"{path}: {names & HEAVY}"


def test_only_qp_imports_the_solvers() -> None:
    for path in modules("companion"):
        if name_of(path) != "companion.safety.qp":
            assert not roots(path) & {"osqp", "daqp"}, path


def test_the_daemon_starts_without_the_heavy_packages() -> None:
    blocker = f"import sys; sys.modules.update(dict.fromkeys({sorted(HEAVY)!r})); "
    done = subprocess.run(
        [sys.executable, "-c", blocker + "import companion.service, companion.cli; companion.cli.build_parser()"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_a_start_loads_nothing_that_takes_long_and_is_seldom_needed() -> None:
    """Start to READY is mostly imports; scipy alone would take as long as all the rest."""
    script = """
import json, sys
from companion.cli import build_parser
build_parser()
from companion.clock import SystemClock
from companion.config import parse_config
from companion.service import Service
Service(parse_config({}), SystemClock())
print(json.dumps(sorted({name.partition(".")[0] for name in sys.modules})))
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    loaded = set(json.loads(done.stdout))
    assert {"numpy", "zenoh", "onnxruntime", "daqp"} <= loaded, "the check sees what is loaded"
    assert not loaded & (HEAVY | SELDOM), loaded & (HEAVY | SELDOM)


def test_frame_conversion_of_the_simulator_is_its_own() -> None:
    for path in modules("sim_bridge"):
        text = path.read_text(encoding="utf-8")
        assert "companion.frames" not in text, path
