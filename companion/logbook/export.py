"""Writes the tables of a log as CSV or Parquet files, one a table."""

from __future__ import annotations

import csv
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from companion.errors import ConfigError
from companion.logbook.reader import FlightLog
from companion.logbook.tables import TABLES, Row, Table

BATCH_ROWS = 10_000


def export(log: FlightLog, folder: Path, kind: str) -> dict[str, int]:
    """Rows written by file name; ``kind`` is ``csv`` or ``parquet``.

    Raises:
        ConfigError: the folder cannot be written to, or what Parquet needs is not installed.
    """
    write = _parquet_writer() if kind == "parquet" else _write_csv
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return {
            path.name: write(path, table, table.rows(log))
            for table in TABLES
            for path in (folder / f"{table.name}.{kind}",)
        }
    except OSError as error:
        raise ConfigError(f"-o {folder}: cannot be written ({error.strerror or error}), expected a folder") from None


def _write_csv(path: Path, table: Table, rows: Iterator[Row]) -> int:
    """Comma-separated with a head line; a missing value is empty, a number keeps all its digits."""
    written = 0
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([name for name, _ in table.columns])
        for row in rows:
            writer.writerow(row)
            written += 1
    return written


def _parquet_writer() -> Any:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise ConfigError(
            "log export: pyarrow is not installed, expected: pip install 'companion-safety[parquet]'"
        ) from None
    kinds = {int: pyarrow.int64(), float: pyarrow.float64(), str: pyarrow.string(), bool: pyarrow.bool_()}

    def write(path: Path, table: Table, rows: Iterator[Row]) -> int:
        schema = pyarrow.schema([(name, kinds[kind]) for name, kind in table.columns])
        written = 0
        with pyarrow.parquet.ParquetWriter(path, schema) as writer:
            while batch := list(itertools.islice(rows, BATCH_ROWS)):
                arrays = [
                    pyarrow.array(column, type=field.type)
                    for column, field in zip(zip(*batch, strict=True), schema, strict=True)
                ]
                writer.write_batch(pyarrow.record_batch(arrays, schema=schema))
                written += len(batch)
        return written

    return write
