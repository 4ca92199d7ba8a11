"""`sim-bridge render`: what is drawn is where PyBullet draws it, files have their frames, bad input is one line."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from sim_bridge.cli import main
from sim_bridge.errors import ScenarioError
from sim_bridge.flight import Flight
from sim_bridge.pictures.camera import Camera, make_camera
from sim_bridge.pictures.film import shoot
from sim_bridge.pictures.log import Ball, Instant, Log, Pose, read_log
from sim_bridge.pictures.stage import BALL_COLORS, Stage
from sim_bridge.placement import resolve
from sim_bridge.runner import Trace
from sim_bridge.scenario import load_scenario

SIZE = (96, 64)
YAWED = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))


def instant(t_s: float = 0.0, *, ball: tuple[float, float, float] = (2.0, 0.0, 1.0), **pose: Any) -> Instant:
    defaults: dict[str, Any] = {"name": "uav1", "position": (0.0, 0.0, 1.0), "attitude": (1.0, 0.0, 0.0, 0.0)}
    return Instant(t_s, (Pose(**{**defaults, "radius_m": 0.2, **pose}),), (Ball("ball", ball, 0.3),))


def like(rgb: np.ndarray, color: tuple[float, ...]) -> np.ndarray:
    """Pixels of a colour's hue, whatever the light."""
    wanted = np.array(color[:3]) / np.linalg.norm(color[:3])
    length = np.linalg.norm(rgb.astype(float), axis=2)
    return (rgb @ wanted > 0.985 * length) & (length > 40.0)


def centroid(mask: np.ndarray) -> np.ndarray:
    rows, columns = np.nonzero(mask)
    assert len(rows), "nothing there"
    return np.array([columns.mean() + 0.5, rows.mean() + 0.5])


@pytest.fixture(scope="module")
def trace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first half second of the demo scenario, as the runners write it: 11 lines."""
    path = tmp_path_factory.mktemp("render") / "flight.jsonl"
    flight = Flight(resolve("demo", load_scenario("demo")[1], 0))
    with path.open("wb") as file:
        trace = Trace(file)
        trace.write(flight)
        for _ in range(10):
            for _ in range(flight.resolved.control_steps):
                flight.advance()
            trace.write(flight)
    flight.close()
    return path


@pytest.mark.parametrize("ball", [(2.0, 0.0, 1.0), (3.0, 1.0, 2.0), (1.0, -1.0, 0.4)])
def test_points_are_projected_where_pybullet_draws_the_ball(ball: tuple[float, float, float]) -> None:
    camera = Camera((-4.0, 1.0, 2.5), (0.0, 0.0, 1.0))
    seen = instant(ball=ball, position=(0.0, 3.0, 1.0))
    with Stage(seen, [("ball", 0.3)], (0.0, 0.0, 0.0)) as stage:
        stage.show(seen)
        shot = stage.take(camera, (320, 240))
        there = shot.body == stage.balls["ball"]
    ((x, y, depth),) = camera.project(np.array([ball]), (320, 240))
    assert centroid(there) == pytest.approx([x, y], abs=1.5)
    assert shot.depth[round(y), round(x)] < depth, "the surface is nearer than the centre"
    assert like(shot.rgb, BALL_COLORS[0])[there].mean() > 0.9


def test_a_picture_shows_the_ball_left_where_it_is_left(tmp_path: Path) -> None:
    log = Log((instant(0.0, ball=(1.5, 1.2, 1.0)), instant(1.0, ball=(1.5, 1.2, 1.0))))
    (picture,) = shoot(log, [0.5], camera="top", size=SIZE, since_s=0.0)
    assert picture.size == SIZE
    vehicle = make_camera("top", log, 0.0, 0.5, SIZE[0] / SIZE[1])(0.5).project(np.array([[0.0, 0.0, 1.0]]), SIZE)
    x, y = centroid(like(np.asarray(picture), BALL_COLORS[0]))
    assert x > vehicle[0, 0] + 3.0, "east is to the right"
    assert y < vehicle[0, 1] - 3.0, "north is up"


@pytest.mark.parametrize(("attitude", "axis", "sign"), [((1.0, 0.0, 0.0, 0.0), 0, 1.0), (YAWED, 1, -1.0)])
def test_the_yellow_rotors_are_at_the_nose(attitude: tuple[float, ...], axis: int, sign: float) -> None:
    camera = Camera((0.0, 0.0, 3.0), (0.0, 0.0, 1.0), up=(0.0, 1.0, 0.0), fov_deg=20.0)
    seen = instant(attitude=attitude, ball=(9.0, 9.0, 1.0))
    with Stage(seen, [("ball", 0.3)], (0.0, 0.0, 0.0)) as stage:
        stage.show(seen)
        shot = stage.take(camera, (200, 200))
    yellow = centroid(like(shot.rgb, (0.95, 0.72, 0.08)) & (shot.body == stage.vehicles[0]))
    assert sign * (yellow[axis] - 100.0) > 15.0
    assert abs(yellow[1 - axis] - 100.0) < 3.0


def test_what_is_behind_a_ball_is_hidden_and_the_vehicle_leaves_a_trail() -> None:
    log = Log(tuple(instant(0.1 * k, position=(-2.0 + 0.2 * k, 0.0, 1.0), ball=(0.0, -9.0, 1.0)) for k in range(11)))
    (with_trail,) = shoot(log, [1.0], camera="top", size=SIZE, since_s=0.0)
    (without,) = shoot(log, [1.0], camera="top", size=SIZE, since_s=0.999)
    blue = like(np.asarray(with_trail), (20, 90, 200)).sum()
    assert blue > 0
    camera = make_camera("top", log, 0.0, 1.0, SIZE[0] / SIZE[1])(1.0)
    x, y, _ = camera.project(np.array([[-1.0, 0.0, 1.0]]), SIZE)[0]
    r, _, b = np.asarray(with_trail)[round(y) - 1 : round(y) + 1, round(x)].astype(int).min(axis=0)
    assert b > r + 30, "the path half way"
    assert with_trail.tobytes() != without.tobytes()


def test_attitude_and_position_between_two_instants() -> None:
    log = Log((instant(0.0), instant(1.0, position=(1.0, 0.0, 1.0), attitude=tuple(-x for x in YAWED))))
    pose = log.at(0.5).vehicles[0]
    assert pose.position == (0.5, 0.0, 1.0)
    assert pose.attitude == pytest.approx((np.cos(np.pi / 8), 0.0, 0.0, np.sin(np.pi / 8)))


def test_a_gif_has_its_frames_and_a_bar_only_on_a_terminal(trace: Path, tmp_path: Path, capfd: Any) -> None:
    out = tmp_path / "flight.gif"
    assert main(["render", str(trace), "-o", str(out), "--fps", "10", "--size", "96x64", "--camera", "chase"]) == 0
    with Image.open(out) as film:
        assert (film.n_frames, film.size, film.info["duration"]) == (6, SIZE, 100)
        assert len(np.unique(np.asarray(film.convert("RGB")).reshape(-1, 3), axis=0)) > 20
    assert capfd.readouterr().err == ""


def test_a_still_and_a_contact_sheet(trace: Path, tmp_path: Path) -> None:
    still, sheet = tmp_path / "still.png", tmp_path / "sheet.png"
    assert main(["render", str(trace), "-o", str(still), "--at", "0.25", "--size", "96x64"]) == 0
    assert main(["render", str(trace), "-o", str(sheet), "--size", "192x144", "--from", "0.1", "--to", "0.4"]) == 0
    with Image.open(still) as one, Image.open(sheet) as nine:
        assert one.size == SIZE
        assert like(np.asarray(one), BALL_COLORS[0]).any()
        assert nine.size == (192, 144)
        cells = np.asarray(nine).reshape(3, 48, 3, 64, 3).transpose(0, 2, 1, 3, 4).reshape(9, -1)
        assert cells.std(axis=1).min() > 5.0


def test_an_mp4_has_its_frames(trace: Path, tmp_path: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    out = tmp_path / "flight.mp4"
    assert main(["render", str(trace), "-o", str(out), "--fps", "10", "--size", "96x64"]) == 0
    frames, _ = ffmpeg.count_frames_and_secs(str(out))
    assert frames == 6


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["-o", "flight.avi"], "expected a name that ends in one of .mp4, .gif, .png"),
        (["-o", "nowhere/flight.png"], "cannot be written"),
        (["-o", "flight.gif", "--at", "0.1"], "--at: expected only with a .png"),
        (["-o", "flight.png", "--at", "9"], "the log covers 0 to 0.5 s"),
        (["-o", "flight.gif", "--from", "0.4", "--to", "0.1"], "expected a span within the log"),
        (["-o", "flight.mp4", "--size", "97x64"], "expected even numbers for .mp4"),
    ],
)
def test_wrong_use_is_one_line(
    words: list[str], told: str, trace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["render", str(trace), *words]) == 2
    said = capsys.readouterr().err
    assert told in said
    assert said.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_without_ffmpeg_an_mp4_says_how_to_get_it(
    trace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert main(["render", str(trace), "-o", str(tmp_path / "flight.mp4")]) == 2
    assert "companion-safety[video]" in capsys.readouterr().err


def test_logs_that_cannot_be_read_are_named(trace: Path, tmp_path: Path) -> None:
    lines = trace.read_text(encoding="utf-8").splitlines()
    first = json.loads(lines[0])
    broken = {
        "missing": (None, "cannot be read"),
        "empty": ("", "empty file"),
        "binary": ("\x89MCAP0", "line 1: expected a trace"),
        "old": (json.dumps({k: v for k, v in first.items() if k != "attitude"}), "attitude"),
        "uneven": (json.dumps({**first, "obstacle_ids": []}), "obstacles: expected as many"),
        "back": ("\n".join([lines[1], lines[0]]), "line 2: t_ns: expected a later time"),
    }
    for name, (text, told) in broken.items():
        path = tmp_path / f"{name}.jsonl"
        if text is not None:
            path.write_text(text, encoding="utf-8")
        with pytest.raises(ScenarioError, match=told) as error:
            read_log(path)
        assert str(path) in str(error.value)


def test_a_last_line_cut_short_is_left_out(trace: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.jsonl"
    cut.write_bytes(trace.read_bytes()[:-20])
    assert len(read_log(cut).instants) == 10
