"""Makes the shipped logs again: `make logs`, after a deliberate change of what the brain answers.

Each is a short flight of the simulator and the daemon, cut after its interesting part, without what a replay does not
need, compressed. Five flights, about a minute.
"""

from __future__ import annotations

import contextlib
import io
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import msgspec
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, Writer

from companion.cli import main as main_of_companion

HERE = Path(__file__).parent
GOLDEN = HERE / "explained.txt"
EXPLAINED = (
    ("demo", "--at", "0.5"),
    ("demo", "--worst", "--around", "0.1"),
    ("demo", "--at", "4"),
    ("demo", "--at", "-2"),
    ("hold", "--at", "2"),
    ("noisy", "--worst"),
    ("ardupilot", "--at", "2"),
    ("retune", "--worst"),
)
KEPT = {"brain", "setpoint", "tracks", "config", "status"}  # of /companion/..., beside the obstacles
NOISY = """
description = "noise, clutter and no names"
[vehicle]
start = [-4.0, 0.0, 1.5]
[target]
position = [4.0, 0.0, 1.5]
[[sensors]]
source = "lidar"
anonymous = true
sigma_m = 0.15
dropout = 0.1
latency_s = 0.08
[[sensors]]
source = "radar"
rate_hz = 10.0
sigma_m = 0.3
[[obstacles]]
id = "ball-1"
motion = "linear"
cross_point = [0.0, 0.0, 1.5]
cross_at_s = 2.05
velocity = [0.0, 1.5, 0.0]
[[obstacles]]
id = "ball-2"
motion = "linear"
cross_point = [0.8, 0.0, 1.5]
cross_at_s = 2.0
velocity = [0.0, -1.5, 0.0]
[[operator]]
do = "engage"
after = "airborne_hover"
[end]
hold_s = 1.0
timeout_s = 12.0
"""


def demo(folder: Path) -> Path:
    """Three figure eights in lockstep, as `companion demo` flies them."""
    _run("companion.cli", "demo", "--lockstep", "--seed", "3", "--out", str(folder))
    return folder / "flight.mcap"


def noisy(folder: Path) -> Path:
    """Anonymous detections beside named ones, with noise, dropouts and late frames."""
    (folder / "noisy.toml").write_text(NOISY, encoding="utf-8")
    return _checked(folder, str(folder / "noisy.toml"))


def hold(folder: Path) -> Path:
    """A required source that goes silent: HOLD, and on again."""
    return _checked(folder, "silent-source")


def ardupilot(folder: Path) -> Path:
    """50 Hz, a slew limit and a dead time."""
    return _checked(folder, "ardupilot")


def retune(folder: Path) -> Path:
    """In real time; a ground station widens the cushion while an obstacle is near."""
    from sim_bridge.testing import FlyingPair

    pair = FlyingPair(folder, (3.0, 0.0, 2.0), "empty", 0, [f'log.directory="{folder}"', "log.tlog=false"])
    try:
        pair.takeoff()
        pair.engage()
        pair.wait_status(lambda status: status["state"] == "ACTIVE")
        for count in range(30):
            pair.publish("hand", [{"id": "pole", "position": [1.6, 0.1, 2.0], "radius": 0.3, "position_std": 0.02}])
            if count == 8:
                pair.ground_station.set_parameter("CA_CUSHION", 0.4)
            pair.wait_status(lambda status: True)
    finally:
        pair.close()
    return folder / "flight.mcap"


# how long each goes on after it was engaged [s]
FLIGHTS: dict[str, tuple[Callable[[Path], Path], float]] = {
    "demo": (demo, 6.0),
    "noisy": (noisy, 4.0),
    "hold": (hold, 5.0),
    "ardupilot": (ardupilot, 3.5),
    "retune": (retune, 4.0),
}


def main() -> int:
    for name in sys.argv[1:] or FLIGHTS:  # or only the explanations: none
        if name == "none":
            break
        fly, seconds = FLIGHTS[name]
        with tempfile.TemporaryDirectory() as folder:
            out = HERE / f"{name}.mcap"
            cut(fly(Path(folder)), out, seconds)
        print(f"{out.name}: {out.stat().st_size / 1000:.0f} kB", flush=True)
    GOLDEN.write_text("\n".join(explained(words) for words in EXPLAINED), encoding="utf-8")
    return 0


def explained(words: tuple[str, ...]) -> str:
    """The command, and what it says: to be read before it is committed."""
    log, *rest = words
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        main_of_companion(["explain", str(HERE / f"{log}.mcap"), *rest])
    return f"$ companion explain {' '.join((f'{log}.mcap', *rest))}\n{out.getvalue()}"


def cut(path: Path, out: Path, seconds: float) -> None:
    """What a replay needs of the log at ``path``, up to ``seconds`` after the flight was engaged."""
    end_ns: int | None = None
    with path.open("rb") as file, out.open("wb") as into:
        writer = Writer(into, compression=CompressionType.ZSTD, chunk_size=4 << 20)
        writer.start()
        channels: dict[str, int] = {}
        for schema, channel, message in NonSeekingReader(file).iter_messages(log_time_order=False):
            topic = channel.topic
            if topic.rpartition("/")[2] not in KEPT and topic != "/companion/input/obstacles":
                continue
            if end_ns is None and topic == "/companion/setpoint" and b'"state":"ACTIVE"' in message.data:
                end_ns = message.log_time + round(1e9 * seconds)
            if end_ns is not None and message.log_time > end_ns:
                break
            if topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data) if schema else 0
                channels[topic] = writer.register_channel(topic, "json", number)
            data = _without_places(message.data) if topic.endswith("/config") else message.data
            writer.add_message(channels[topic], message.log_time, data, message.publish_time)
        writer.finish()


def _without_places(data: bytes) -> bytes:
    """A configuration without where this machine keeps its files; its hash leaves that out too."""
    told = msgspec.json.decode(data)
    told["config"]["log"]["directory"] = None
    return msgspec.json.encode(told)


def _checked(folder: Path, scenario: str) -> Path:
    _run("sim_bridge.cli", "run", "--scenario", scenario, "--check", "--logs", str(folder), "--json")
    (found,) = folder.glob("*/flight.mcap")
    return found


def _run(*words: str) -> None:
    done = subprocess.run([sys.executable, "-m", *words], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise SystemExit(f"{' '.join(words)}: {done.stderr or done.stdout}")


if __name__ == "__main__":
    sys.exit(main())
