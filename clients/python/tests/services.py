"""The built program as child processes, each with its own endpoint, root and state folder."""

from __future__ import annotations

import csv
import os
import pathlib
import socket
import subprocess
import threading
import time
from typing import Dict, List, Optional, Sequence

REPOSITORY = pathlib.Path(__file__).resolve().parents[3]
#: Limit that only ends a hang, in seconds.
DEADLINE_S = 180.0

#: Two storeys with the nodes `ground` (1 channel) and `roof` (2 channels). Frames wait practically
#: without limit, so that a slow machine changes no number.
STRUCTURE = """
[structure]
name = "house"
sampling-rate-hz = 100
[model]
kind = "shear-building"
storeys = 2
mass-kg = 20_000
first-frequency-hz = 2.0
[damping]
kind = "rayleigh"
ratio = 0.02
[[parameter]]
name = "storey-1"
scales = "stiffness"
of = ["storey-1"]
[[parameter]]
name = "storey-2"
scales = "stiffness"
of = ["storey-2"]
[[excitation]]
name = "ground"
kind = "ground"
std = 0.1
measured-on = "ground"
[[node]]
name = "ground"
[[node.channel]]
name = "ground"
quantity = "ground-acceleration"
unit = "m/s2"
noise-std = 0.005
[[node]]
name = "roof"
[[node.channel]]
name = "roof"
quantity = "absolute-acceleration"
dof = "floor-2"
unit = "m/s2"
noise-std = 0.005
adapt-noise = true
[[node.channel]]
name = "roof-velocity"
quantity = "velocity"
dof = "floor-2"
unit = "m/s"
noise-std = 0.001
[[condition]]
name = "air"
unit = "degC"
range = [-40, 60]
[ingest]
lateness-s = 3600
"""


def program() -> str:
    """The path of the built program, from the variable `PROGRAM`."""
    return os.environ["PROGRAM"]


def free_endpoint() -> str:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{listener.getsockname()[1]}"


def environment(state: pathlib.Path) -> Dict[str, str]:
    """The environment of a child without settings of the user of this machine."""
    ours = {name: text for name, text in os.environ.items() if not name.startswith("SPANDREL_")}
    ours.pop("STATE_DIRECTORY", None)
    ours.pop("RUST_LOG", None)
    return {**ours, "XDG_STATE_HOME": str(state)}


class Process:
    """A running program, which is killed at the end of a `with` statement."""

    def __init__(
        self, command: Sequence[str], state: pathlib.Path, extra: Optional[Dict[str, str]] = None
    ) -> None:
        self.command = list(command)
        self.child = subprocess.Popen(
            self.command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            env={**environment(state), **(extra or {})},
            cwd=state,
        )
        self._lines: List[str] = []
        self._changed = threading.Condition()
        self._has_ended = False
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.child.stdout is not None
        for line in self.child.stdout:
            with self._changed:
                self._lines.append(line.decode(errors="replace"))
                self._changed.notify_all()
        with self._changed:
            self._has_ended = True
            self._changed.notify_all()

    @property
    def output(self) -> str:
        with self._changed:
            return "".join(self._lines)

    def wait_for(self, text: str) -> None:
        """Waits until the output contains a text."""
        with self._changed:
            self._changed.wait_for(
                lambda: text in "".join(self._lines) or self._has_ended, DEADLINE_S
            )
        assert text in self.output, f"{self.command}\nlacks {text!r}:\n{self.output}"

    def wait(self) -> str:
        """Waits until the program has ended without error, and returns its output."""
        with self._changed:
            self._changed.wait_for(lambda: self._has_ended, DEADLINE_S)
        assert self.child.wait(DEADLINE_S) == 0, f"{self.command}\n{self.output}"
        return self.output

    def stop(self) -> None:
        """Requests the program to stop, and waits for its end."""
        self.child.terminate()
        assert self.child.wait(DEADLINE_S) == 0, f"{self.command}\n{self.output}"

    def kill(self) -> None:
        self.child.kill()
        self.child.wait(DEADLINE_S)

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()


class Site:
    """A folder, a root and an endpoint for one test."""

    def __init__(self, folder: pathlib.Path, structure: str = STRUCTURE) -> None:
        self.folder = folder
        self.structure_file = folder / "structure.toml"
        self.structure_file.write_text(structure)
        self.root = f"test-{os.getpid()}-{time.time_ns()}"
        self.endpoint = free_endpoint()

    def start(self, service: str, *arguments: str) -> Process:
        """Starts services that listen, and waits until they are ready."""
        return self._start(service, "--listen", *arguments)

    def connecting(self, service: str, *arguments: str) -> Process:
        """Starts services that connect, and waits until they are ready."""
        return self._start(service, "--connect", *arguments)

    def _start(self, service: str, how: str, *arguments: str) -> Process:
        command = [program(), service, str(self.structure_file), "-v", "--root", self.root]
        process = Process([*command, how, self.endpoint, *arguments], self.folder)
        process.wait_for("ready structures=1")
        return process

    def simulate(self, *arguments: str) -> Process:
        command = [program(), "simulate", str(self.structure_file), "--root", self.root]
        return Process([*command, "--connect", self.endpoint, *arguments], self.folder)

    def recorded(self) -> List[Dict[str, float]]:
        """The rows of the recording. NaN is missing."""
        return recorded(self.folder)


def recorded(folder: pathlib.Path) -> List[Dict[str, float]]:
    segments = sorted(folder.rglob("*.mcap"))
    assert segments, f"no recording in {folder}"
    rows: List[Dict[str, float]] = []
    for segment in segments:
        table = segment.with_suffix(".csv")
        Process([program(), "convert", str(segment), str(table)], folder).wait()
        with table.open() as file:
            for row in csv.DictReader(file):
                rows.append(
                    {name: float(text) if text else float("nan") for name, text in row.items()}
                )
    return rows
