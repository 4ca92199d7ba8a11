"""Frames of a film, and the files that they become: GIF through Pillow, MP4 through imageio-ffmpeg, PNG."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from sim_bridge.errors import ScenarioError, SimError
from sim_bridge.pictures.camera import CameraName, make_camera
from sim_bridge.pictures.log import Log
from sim_bridge.pictures.overlay import PATH_INKS, overlay
from sim_bridge.pictures.stage import BALL_COLORS, TARGET, Stage

Size = tuple[int, int]
SHEET = (3, 3)  # columns and rows of a contact sheet
_FINER = 2  # the renderer smooths no edges: pictures are taken larger and shrunk
_COLORS = 80  # of a GIF's first picture
_HOW_TO_INSTALL = "expected imageio-ffmpeg: pip install 'companion-safety[video]', or -o FILE.gif"


def frame_times(since_s: float, until_s: float, fps: float) -> list[float]:
    """The times of a film's frames, both ends included.

    >>> frame_times(1.0, 2.0, 4.0)
    [1.0, 1.25, 1.5, 1.75, 2.0]
    """
    return [since_s + k / fps for k in range(int((until_s - since_s) * fps + 1e-6) + 1)]


def shoot(
    log: Log, times_s: Sequence[float], *, camera: CameraName, size: Size, since_s: float
) -> Iterator[Image.Image]:
    """A picture at each of ``times_s``, with the paths since ``since_s``."""
    width, height = size
    until_s = max(times_s)
    view = make_camera(camera, log, since_s, until_s, width / height)
    shown = log.until(until_s, since_s) or (log.at(since_s),)
    balls = {ball.id: ball.radius_m for instant in log.instants for ball in instant.balls}
    middle = np.mean([pose.position for instant in shown for pose in instant.vehicles], axis=0)
    x, y, _ = middle.tolist()
    with Stage(log.instants[0], list(balls.items()), (x, y, 0.0)) as stage:
        for t_s in times_s:
            instant = log.at(t_s)
            stage.show(instant)
            shot = stage.take(view(t_s), (_FINER * width, _FINER * height))
            picture = overlay(shot, log, instant, view(t_s), since_s=since_s, ids=list(balls))
            yield picture.resize(size, Image.Resampling.BOX)


def contact_sheet(pictures: Iterable[Image.Image], size: Size) -> Image.Image:
    """``pictures`` by rows on one sheet of ``size``."""
    columns, rows = SHEET
    width, height = size[0] // columns, size[1] // rows
    sheet = Image.new("RGB", (columns * width, rows * height), "white")
    for index, picture in enumerate(pictures):
        sheet.paste(picture, (index % columns * width, index // columns * height))
    return sheet


Writer = Callable[[Path, Iterable[Image.Image], float], None]


def write_gif(path: Path, pictures: Iterable[Image.Image], fps: float) -> None:
    """One palette for the whole film: colours neither flicker nor cost a table a frame."""
    frames = iter(pictures)
    first = next(frames)
    palette = _palette(first)
    films = (
        picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in itertools.chain([first], frames)
    )
    start = next(films)
    start.save(path, save_all=True, append_images=films, duration=round(1000.0 / fps), loop=0, optimize=False)


def _palette(first: Image.Image) -> Image.Image:
    """The colours of the first picture, and those that things have which may not be in it, in light and in shade."""
    inks = [ink[:3] for ink in PATH_INKS] + [tuple(round(255 * part) for part in c[:3]) for c in (*BALL_COLORS, TARGET)]
    shades = [round(shade * part) for ink in inks for shade in (1.0, 0.6) for part in ink]
    seen = first.quantize(_COLORS, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    palette = Image.new("P", (1, 1))
    palette.putpalette([*(seen.getpalette() or [])[: 3 * _COLORS], *shades])
    return palette


def write_mp4(path: Path, pictures: Iterable[Image.Image], fps: float) -> None:
    """H.264, as every browser plays it.

    Raises:
        ScenarioError: imageio-ffmpeg is not installed.
        SimError: ffmpeg failed.
    """
    ffmpeg = _ffmpeg()
    frames = iter(pictures)
    first = next(frames)
    writer = ffmpeg.write_frames(
        str(path), first.size, fps=fps, codec="libx264", quality=7, macro_block_size=2, ffmpeg_log_level="error"
    )
    try:
        writer.send(None)
        writer.send(np.asarray(first).tobytes())
        for picture in frames:
            writer.send(np.asarray(picture).tobytes())
    except OSError as error:
        raise SimError(f"{path}: ffmpeg: {str(error).strip().splitlines()[0]}") from None
    finally:
        writer.close()


def check_mp4(size: Size) -> None:
    """Raise ScenarioError where an MP4 of ``size`` cannot be written here."""
    if size[0] % 2 or size[1] % 2:
        raise ScenarioError(f"--size {size[0]}x{size[1]}: expected even numbers for .mp4")
    _ffmpeg()


def _ffmpeg() -> Any:
    try:
        import imageio_ffmpeg
    except ImportError:
        raise ScenarioError(f"-o .mp4: {_HOW_TO_INSTALL}") from None
    return imageio_ffmpeg
