"""Runs the blocks of one page as a reader would: one folder, several terminals, and every port a free one.

What differs from the page, and nothing else:

- the ports that pages name (`PORTS`) are replaced by free ones, in commands and in files, and passed to the programs
  where a command leaves them to their defaults;
- the programs are those of this checkout, some of them in haste (`docs_programs`).
"""

from __future__ import annotations

import contextlib
import os
import queue
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Collection, Iterator
from pathlib import Path

from docs_blocks import ROOT, Block

from sim_bridge.testing import free_port

PORTS = {14540: socket.SOCK_DGRAM, 14550: socket.SOCK_DGRAM, 7447: socket.SOCK_STREAM, 7448: socket.SOCK_STREAM}
PORTS[8080] = socket.SOCK_STREAM
READ = ("tests", "policies", "docker")  # folders of the checkout that pages name, beside configs
WITHIN_S, SLOW_WITHIN_S = 60.0, 300.0  # for a block
_SHIM = """\
#!{python}
import sys
sys.path[:0] = [{tests!r}]
from docs_programs import become
become({name!r}, sys.argv[1:])
"""


class Session:
    """The terminals of one page, in ``folder``."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.ports = {port: free_port(kind) for port, kind in PORTS.items()}
        self._behind: list[Running] = []
        bin_folder = folder / ".bin"
        bin_folder.mkdir()
        for name in ("companion", "sim-bridge", "policies", "python3", "pytest", "make"):
            shim = bin_folder / name
            shim.write_text(_SHIM.format(python=sys.executable, tests=str(ROOT / "tests"), name=name), encoding="utf-8")
            shim.chmod(0o755)
        shutil.copytree(ROOT / "configs", folder / "configs")
        for name in READ:
            if (ROOT / name).is_dir():
                (folder / name).symlink_to(ROOT / name)
        for path in (folder / "configs").rglob("*.toml"):
            path.write_text(self.moved(path.read_text(encoding="utf-8")), encoding="utf-8")
        self._environment = {
            **os.environ,
            "PATH": f"{bin_folder}{os.pathsep}{os.environ['PATH']}",
            "PYTHONPATH": str(ROOT),
            "PYTHONUNBUFFERED": "1",
            "COLUMNS": "100",
            "DOCS_PORTS": ",".join(f"{known}:{free}" for known, free in self.ports.items()),
        }

    def moved(self, text: str) -> str:
        """``text`` with its ports replaced by this session's."""
        for known, free in self.ports.items():
            text = re.sub(rf"(?<![\d.]){known}(?!\d)", str(free), text)
        return text

    def do(self, block: Block) -> str:
        """Run one block, or write its file; what it printed."""
        text = self.moved(block.text)
        if name := block.says.get("file"):
            (self.folder / name).write_text(text, encoding="utf-8")
            return ""
        if not block.runs:
            return ""
        if block.language == "python":
            command = [sys.executable, "-c", text]
        else:
            command = ["bash", "-euo", "pipefail", "-c", text]
        within_s = SLOW_WITHIN_S if "slow" in block.says else WITHIN_S
        running = Running(command, self.folder, self._environment, str(block), within_s)
        if "until" in block.says or "beside" in block.says:
            self._behind.append(running)
            if until := block.says.get("until"):
                running.wait_for(until)
            return running.said
        return running.finish([int(status) for status in block.says.get("exit", "0").split(" or ")])

    def close(self) -> None:
        """End what still runs, the last started first; all of it has to end well on SIGINT."""
        problems = []
        for running in reversed(self._behind):
            try:
                running.interrupt()
            except AssertionError as problem:
                problems.append(str(problem))
        assert not problems, "\n".join(problems)


class Running:
    """One block as a process group, its output read line by line."""

    def __init__(
        self, command: list[str], folder: Path, environment: dict[str, str], name: str, within_s: float
    ) -> None:
        self.name, self.said, self._within_s = name, "", within_s
        self._lines: queue.Queue[str | None] = queue.Queue()
        self._process = subprocess.Popen(
            command,
            cwd=folder,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            text=True,
            start_new_session=True,
        )
        threading.Thread(target=self._read, daemon=True).start()

    def wait_for(self, text: str) -> None:
        """Until the process has said ``text``."""
        for _ in self._until_end():
            if text in self.said:
                return
        raise AssertionError(f"{self.name}: ended without saying {text!r}:\n{self.said}")

    def finish(self, statuses: Collection[int]) -> str:
        """Until the end, which has to be with one of ``statuses``."""
        for _ in self._until_end():
            pass
        got = self._process.wait()
        assert got in statuses, f"{self.name}: exit status {got}, expected {statuses}:\n{self.said}"
        return self.said

    def interrupt(self) -> None:
        """Ctrl-C in this terminal."""
        if self._process.poll() is None:
            self._signal(signal.SIGINT)
        for _ in self._until_end():
            pass
        got = self._process.wait()
        assert got in (0, 130, -signal.SIGINT), f"{self.name}: exit status {got} after Ctrl-C:\n{self.said}"

    def _until_end(self) -> Iterator[None]:
        deadline = time.monotonic() + self._within_s
        while True:
            try:
                line = self._lines.get(timeout=max(0.0, deadline - time.monotonic()))
            except queue.Empty:
                self._signal(signal.SIGKILL)
                self._process.wait()
                raise AssertionError(f"{self.name}: nothing came of it in {self._within_s:g} s:\n{self.said}") from None
            if line is None:
                return
            self.said += line
            yield

    def _signal(self, number: signal.Signals) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, number)

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout:
            for line in self._process.stdout:
                self._lines.put(line)
        self._lines.put(None)
