"""docker/: what can be told of the images and compose files without an engine to run them."""

from __future__ import annotations

import importlib.util
import json
import re
import shlex
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml
import zenoh
from packaging.requirements import Requirement

from companion import __version__
from companion.cli import build_parser
from companion.config import load_config
from companion.link.transports import parse_url
from sim_bridge.cli import _parser as simulator_parser
from sim_bridge.scenario import load_scenario

ROOT = Path(__file__).parents[2]
DOCKER = ROOT / "docker"
DOCKERFILES = sorted(DOCKER.glob("*.Dockerfile"))
COMPOSE = {path.name: yaml.safe_load(path.read_text(encoding="utf-8")) for path in DOCKER.glob("compose*.yaml")}
DEMO: dict[str, Any] = COMPOSE["compose.yaml"]["services"]
SERVICES = {f"{file}:{name}": s for file, whole in COMPOSE.items() for name, s in whole["services"].items()}
NOT_IN_THE_DAEMON = {"torch", "pybullet", "matplotlib", "mavsdk"}


def instructions(path: Path) -> list[tuple[str, str]]:
    """(instruction, its words) of a Dockerfile, comments gone and continued lines joined."""
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if not line.lstrip().startswith("#")]
    joined = re.sub(r"\\\n\s*", " ", "\n".join(lines))
    return [(name.upper(), words) for name, _, words in (line.partition(" ") for line in joined.splitlines() if line)]


def last(path: Path, name: str) -> str:
    """The words of the last instruction ``name``: what holds in the image."""
    return [words for found, words in instructions(path) if found == name][-1]


def stage_image(words: str) -> str:
    return words.split()[0]


def load(name: str) -> ModuleType:
    """A script of docker/ as a module."""
    spec = importlib.util.spec_from_file_location(f"docker_{name}", DOCKER / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_dockerfile_and_compose_file_is_looked_at() -> None:
    assert [path.name for path in DOCKERFILES] == ["companion.Dockerfile", "simulator.Dockerfile"]
    assert sorted(COMPOSE) == ["compose.vehicle.yaml", "compose.yaml"]
    assert sorted(DEMO) == ["companion", "operator", "publisher", "router", "simulator"]


def test_every_image_is_pinned_to_a_whole_version() -> None:
    bases = {stage_image(words) for path in DOCKERFILES for name, words in instructions(path) if name == "FROM"}
    images = {service["image"] for service in SERVICES.values()}
    assert len(bases) == 1  # every stage of every image: what was compiled in one runs in the next
    for image in bases | images:
        assert re.search(r":\d+\.\d+\.\d+(-[a-z-]+)?$", image), image
    ours = {image for image in images if image.startswith("companion")}
    assert ours == {f"companion:{__version__}", f"companion-simulator:{__version__}"}
    (router,) = images - ours
    pins = dict(line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line)
    assert router == f"eclipse/zenoh:{pins['eclipse-zenoh']}"


@pytest.mark.parametrize("path", DOCKERFILES, ids=lambda path: path.name)
def test_an_image_runs_as_nobody_in_particular(path: Path) -> None:
    stages = [name for name, _ in instructions(path)]
    assert stages.count("FROM") == 2
    final = instructions(path)[len(stages) - stages[::-1].index("FROM") :]
    user = dict(final)["USER"]
    assert re.fullmatch(r"[1-9]\d{3,}:[1-9]\d{3,}", user)  # by number: Kubernetes cannot check a name
    assert not any("pip" in words for name, words in final if name == "RUN")
    names = [name for name, _ in final]
    assert names.index("USER") > max(i for i, name in enumerate(names) if name in ("RUN", "COPY"))
    for name in ("ENTRYPOINT", "CMD"):
        assert isinstance(json.loads(last(path, name)), list)  # exec form: no shell between the signal and the process
    assert last(path, "STOPSIGNAL") == "SIGTERM"
    check = last(path, "HEALTHCHECK").partition("CMD ")[2]
    assert json.loads(check)[1] == "/opt/companion/health.py"
    labels = dict(part.split("=", 1) for part in shlex.split(last(path, "LABEL")))
    assert labels["org.opencontainers.image.version"] == __version__
    assert labels["org.opencontainers.image.licenses"] == "Apache-2.0"
    base = stage_image(last(path, "FROM"))
    assert labels["org.opencontainers.image.base.name"] == f"docker.io/library/{base}"


def test_every_pip_call_uses_the_constraints() -> None:
    calls = []
    for path in DOCKERFILES:
        for name, words in instructions(path):
            assert "PIP_CONSTRAINT=/src/constraints.txt" in words or name != "ENV" or "PIP" not in words
            calls += [call for call in words.split("&&") if name == "RUN" and re.search(r"\bpip\b.* install\b", call)]
    assert len(calls) == 2 * len(DOCKERFILES)
    for call in calls:
        assert " -c constraints.txt" in call, call
    for text in DOCKER.glob("*.md"):
        assert "pip install" not in text.read_text(encoding="utf-8")


@pytest.mark.parametrize("path", DOCKERFILES, ids=lambda path: path.name)
def test_what_is_copied_exists_and_is_in_the_build_context(path: Path) -> None:
    ignore = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    rules = [line for line in ignore if line and not line.startswith("#")]
    assert rules[0] == "*"
    allowed = {rule[1:] for rule in rules if rule.startswith("!")}
    sources = set()
    for name, words in instructions(path):
        if name == "COPY" and not words.startswith("--from"):
            sources |= {source.rstrip("/") for source in words.split()[:-1]}
    assert sources
    for source in sources:
        assert (ROOT / source).exists(), source
        assert source in allowed or source.split("/")[0] in allowed, source
    assert all((ROOT / name).exists() for name in allowed)


def closure(requirements: list[str]) -> set[str]:
    """Every distribution that ``requirements`` bring, by what is installed here."""
    found: set[str] = set()
    waiting = [Requirement(line) for line in requirements]
    while waiting:
        wanted = waiting.pop()
        extras = wanted.extras or {""}
        if wanted.marker is not None and not any(wanted.marker.evaluate({"extra": extra}) for extra in extras):
            continue
        name = wanted.name.lower().replace("_", "-")
        if name not in found:
            found.add(name)
            waiting += [
                inner
                for line in metadata.requires(wanted.name) or []
                if (inner := Requirement(line)).marker is None
                or any(inner.marker.evaluate({"extra": extra}) for extra in extras)
            ]
            for inner in waiting:
                inner.marker = None  # judged already
    return found


def test_the_daemon_brings_no_torch_and_no_simulator() -> None:
    requirements = load("requirements").requirements
    daemon, simulator = (closure(requirements(ROOT / "pyproject.toml", extras)) for extras in ([], ["sim"]))
    assert {"numpy", "msgspec", "pymavlink", "eclipse-zenoh"} <= daemon
    assert not daemon & NOT_IN_THE_DAEMON
    assert {"pybullet", "mavsdk"} <= simulator  # the check can fail
    assert "torch" not in simulator
    assert 'ARG EXTRAS=""' in (DOCKER / "companion.Dockerfile").read_text()  # none by default


def test_an_extra_that_does_not_exist_is_an_error() -> None:
    words = [sys.executable, str(DOCKER / "requirements.py"), "no-such"]
    assert subprocess.run(words, cwd=ROOT, capture_output=True, check=False).returncode != 0
    done = subprocess.run([*words[:2], "ros2"], cwd=ROOT, capture_output=True, check=True, text=True)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert done.stdout.split("\n")[:-1] == project["dependencies"] + project["optional-dependencies"]["ros2"]


@pytest.mark.parametrize("name", SERVICES)
def test_a_service_is_locked_down(name: str) -> None:
    service = SERVICES[name]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert service["user"] == "10001:10001"
    assert re.fullmatch(r"\d+m", service["mem_limit"])
    assert service["pids_limit"] > 0
    assert all("noexec" in mount for mount in service["tmpfs"])
    assert not service.keys() & {"privileged", "cap_add", "pid", "ipc", "environment"}
    for volume in service.get("volumes", []):
        source, _, rest = re.sub(r"\$\{[^}]*\}", "FILE", volume).partition(":")
        assert source == "flights" or rest.endswith(":ro"), volume
        if source.startswith("./"):
            assert (DOCKER / source).is_file(), volume
    for port in service.get("ports", []):
        assert port.startswith("127.0.0.1:"), port


def test_services_start_in_an_order_that_waits_for_health() -> None:
    for name, service in DEMO.items():
        for other, how in service.get("depends_on", {}).items():
            health = DEMO[other]["healthcheck"]
            started = how["condition"] == "service_started"
            assert started == ("disable" in health), f"{name} waits for {other}"
            assert started or health["test"][0] == "CMD"
    order: list[str] = []
    while len(order) < len(DEMO):
        ready = [n for n, s in DEMO.items() if n not in order and set(s.get("depends_on", {})) <= set(order)]
        assert ready, f"a cycle among {set(DEMO) - set(order)}"
        order += ready
    assert order[-1] == "operator"


def test_the_flight_network_has_no_way_out() -> None:
    whole = COMPOSE["compose.yaml"]
    assert whole["networks"]["flight"] == {"internal": True}
    assert {n: s["networks"] for n, s in DEMO.items() if s["networks"] != ["flight"]} == {
        "companion": ["flight", "page"]
    }


def companion_words(words: list[str]) -> Any:
    return build_parser().parse_args(words)


def test_the_commands_are_ours() -> None:
    """As the compose files and the images give them; argparse ends a test with SystemExit where one is not."""
    assert companion_words(DEMO["companion"]["command"]).command == "run"
    assert companion_words(DEMO["publisher"]["command"]).connect == ["tcp/router:7447"]
    assert simulator_parser().parse_args(DEMO["simulator"]["command"]).must_reach
    daemon, simulator = DOCKERFILES
    assert json.loads(last(daemon, "ENTRYPOINT")) == ["companion"]
    assert json.loads(last(simulator, "ENTRYPOINT")) == ["sim-bridge"]
    words = companion_words(json.loads(last(daemon, "CMD")))
    assert f"COPY configs/default.toml {words.config}" in daemon.read_text()
    config = load_config(ROOT / "configs/default.toml", tuple(words.overrides))
    assert config.log.directory == last(daemon, "WORKDIR") == json.loads(last(daemon, "VOLUME"))[0]
    check = json.loads(last(daemon, "HEALTHCHECK").partition("CMD ")[2])
    assert (config.http.enabled, str(config.http.port)) == (True, check[3])
    simulator_parser().parse_args(json.loads(last(simulator, "CMD")))


def test_the_demo_fits_together() -> None:
    """Each side names the address on which the other listens, and what is flown is the scenario."""
    config = load_config(DOCKER / "companion.toml", ())
    simulator = simulator_parser().parse_args(DEMO["simulator"]["command"])
    publisher = companion_words(DEMO["publisher"]["command"])
    router = zenoh.Config.from_file(str(DOCKER / "router.json5"))
    assert router.get_json("mode") == '"router"'
    assert json.loads(router.get_json("listen/endpoints")) == ["tcp/0.0.0.0:7447"]
    for key in ("multicast", "gossip"):
        assert router.get_json(f"scouting/{key}/enabled") == "false"
    assert [*config.zenoh.connect, simulator.zenoh_connect, *publisher.connect] == ["tcp/router:7447"] * 3
    assert DEMO["router"]["healthcheck"]["test"][-1] == "7447"

    onboard, (link, *target) = parse_url(config.mavlink.url), DEMO["operator"]["command"]
    assert (onboard.scheme, onboard.host, onboard.port) == ("udpout", "simulator", simulator.onboard_bind[1])
    assert link == f"udpout://simulator:{simulator.gcs_bind[1]}"
    assert {simulator.onboard_bind[0], simulator.gcs_bind[0]} == {"0.0.0.0"}
    assert DEMO["simulator"]["healthcheck"]["test"][-1] == str(simulator.gcs_port)

    _, scenario = load_scenario(simulator.scenario)
    assert scenario.target is not None
    assert config.target.position == scenario.target.position == tuple(float(word) for word in target)
    assert set(config.obstacles.required) == {*(s.source for s in scenario.sensors), publisher.key_source}

    (page,) = DEMO["companion"]["ports"]
    assert config.http.host == "0.0.0.0"
    assert page.endswith(f":{config.http.port}")
    assert DEMO["companion"]["healthcheck"]["test"][-2:] == [str(config.http.port), "/healthz"]
    assert not config.http.commands
    assert f"flights:{config.log.directory}" in DEMO["companion"]["volumes"]


@pytest.mark.parametrize("name", SERVICES)
def test_a_service_that_is_built_is_built_from_a_dockerfile_here(name: str) -> None:
    service = SERVICES[name]
    if service["image"].startswith("eclipse/"):
        assert "build" not in service
        return
    assert service["build"]["context"] == ".."
    assert ROOT / service["build"]["dockerfile"] in DOCKERFILES
    simulated = service["image"].startswith("companion-simulator")
    assert service["build"]["dockerfile"].endswith("simulator.Dockerfile") == simulated
    assert service.get("platform") == ("linux/amd64" if simulated else None)


def make(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["make", "-C", str(ROOT), *words], capture_output=True, text=True, check=False)


def test_make_images_builds_both_and_says_what_it_needs() -> None:
    planned = make("--dry-run", "images").stdout
    for image, dockerfile in (("companion", "companion"), ("companion-simulator", "simulator")):
        assert f"--file docker/{dockerfile}.Dockerfile --tag {image}:{__version__} " in planned
    refused = make("images", "ENGINE=no-such-engine")
    assert refused.returncode != 0
    assert "no-such-engine is not installed: expected docker" in refused.stderr
