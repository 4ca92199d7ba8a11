"""One event, one line, whatever the event holds."""

from __future__ import annotations

import io
import json
import logging
import math
import warnings
from collections.abc import Iterator
from datetime import datetime
from typing import Any

import pytest

from companion.logging_setup import set_up_logging


@pytest.fixture
def restored() -> Iterator[None]:
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield
    logging.captureWarnings(False)
    root.handlers, root.level = handlers, level


def lines(stream: io.StringIO) -> list[dict[str, Any]]:
    return [json.loads(line) for line in stream.getvalue().splitlines()]


@pytest.mark.usefixtures("restored")
def test_an_event_with_its_fields() -> None:
    stream, log = io.StringIO(), logging.getLogger("companion")
    set_up_logging(format="json", level="info", vehicle="uav7", stream=stream)
    log.info("%s (%s)", "READY", "vehicle fresh", extra={"state": "READY", "reason": "vehicle fresh", "t_ns": 12})
    log.debug("not said")
    (line,) = lines(stream)
    assert datetime.fromisoformat(line.pop("time")).utcoffset() is not None
    assert line == {
        "level": "info",
        "logger": "companion",
        "message": "READY (vehicle fresh)",
        "vehicle": "uav7",
        "state": "READY",
        "reason": "vehicle fresh",
        "t_ns": 12,
    }


@pytest.mark.usefixtures("restored")
def test_an_exception_is_one_field_of_one_line() -> None:
    stream, log = io.StringIO(), logging.getLogger("companion")
    set_up_logging(format="json", level="debug", stream=stream)
    try:
        raise ValueError("two\nlines")
    except ValueError:
        log.exception("the brain\nfailed")
    (line,) = lines(stream)
    assert line["message"] == "the brain\nfailed"
    assert line["exception"].splitlines()[0] == "Traceback (most recent call last):"
    assert line["exception"].endswith("ValueError: two\nlines")


@pytest.mark.usefixtures("restored")
def test_what_json_cannot_hold_is_still_one_line() -> None:
    stream, log = io.StringIO(), logging.getLogger("companion")
    set_up_logging(format="json", level="info", stream=stream)
    log.warning("half a character: \udce4", extra={"age": math.nan, "what": {1, 2}, "level": "mine"})
    (line,) = lines(stream)
    assert (line["age"], line["what"], line["level"]) == ("nan", "{1, 2}", "warning")


@pytest.mark.usefixtures("restored")
def test_warnings_of_python_are_lines_too() -> None:
    stream = io.StringIO()
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        set_up_logging(format="json", level="warning", stream=stream)
        warnings.warn("deprecated", DeprecationWarning, stacklevel=1)
        logging.captureWarnings(False)
    (line,) = lines(stream)
    assert line["logger"] == "py.warnings"
    assert "deprecated" in line["message"]


@pytest.mark.usefixtures("restored")
def test_text_for_people() -> None:
    stream = io.StringIO()
    set_up_logging(format="text", level="error", stream=stream)
    logging.getLogger("companion").warning("not said")
    logging.getLogger("companion").error("said")
    assert stream.getvalue().endswith(" ERROR said\n")
