"""The code of the pages, as printed. Uses the default endpoint, on which nothing else may listen."""

from __future__ import annotations

import contextlib
import json
import math
import os
import pathlib
import re
import sys
import textwrap
import time
from dataclasses import dataclass
from typing import Iterator, List

import pytest

import spandrel
from services import DEADLINE_S, REPOSITORY, Process, program, recorded

README = REPOSITORY / "clients" / "python" / "README.md"
TOPICS = REPOSITORY / "docs" / "topics.md"
HOW_TO = REPOSITORY / "docs" / "how-to.md"


@dataclass(frozen=True)
class Block:
    kind: str
    text: str


def blocks(page: pathlib.Path, heading: str) -> List[Block]:
    """The blocks of code below a heading, up to the next heading."""
    text = page.read_text()
    start = text.index(f"\n{heading}\n") + len(heading) + 2
    marks = heading.split(" ")[0]
    end = re.search(rf"^#{{1,{len(marks)}}} ", text[start:], re.MULTILINE)
    section = text[start : start + end.start()] if end else text[start:]
    found = re.findall(r"^ *```(\w[^\n]*)\n(.*?)^ *```$", section, re.MULTILINE | re.DOTALL)
    assert found, f"{page} has no code below {heading}"
    return [Block(kind, textwrap.dedent(code)) for kind, code in found]


class Desk:
    """A folder like that of the repository, in which the code of a page runs."""

    def __init__(self, folder: pathlib.Path) -> None:
        self.folder = folder
        for name in ("docs", "clients"):
            (folder / name).symlink_to(REPOSITORY / name)
        python = folder / "spandrel-python" / "bin" / "python"
        python.parent.mkdir(parents=True)
        python.write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n')
        python.chmod(0o755)
        here = pathlib.Path(__file__).parent
        self.extra = {
            "PATH": f"{pathlib.Path(program()).parent}:{os.environ['PATH']}",
            "PYTHONPATH": f"{REPOSITORY / 'clients' / 'python' / 'src'}:{here}",
            "MPLBACKEND": "module://plot_backend",
            "PLOT": str(folder / "live.png"),
        }

    def start(self, block: Block) -> Process:
        if block.kind.startswith("sh"):
            # Replaces the shell, so that the end of the process is the end of the program.
            last = block.text.rstrip().split("\n")[-1]
            script = block.text.replace(last, f"exec {last}")
            return Process(["bash", "-euo", "pipefail", "-c", script], self.folder, self.extra)
        return Process([sys.executable, "-c", block.text], self.folder, self.extra)

    @contextlib.contextmanager
    def service(self, block: Block) -> Iterator[Process]:
        with self.start(block) as process:
            if " run " in block.text:
                # The page is announced before the service that receives the samples has started.
                process.wait_for("ready structures")
            yield process

    def run(self, block: Block) -> str:
        with self.start(block) as process:
            return process.wait()

    def recorded_floor_1(self) -> List[float]:
        """The recorded samples of floor-1."""
        values = (row["floor-1"] for row in recorded(self.folder))
        return [value for value in values if not math.isnan(value)]


@pytest.fixture
def desk(tmp_path: pathlib.Path) -> Desk:
    if "PROGRAM" not in os.environ:
        pytest.skip("the variable PROGRAM is not the path of the built program")
    return Desk(tmp_path)


def test_the_sensors_of_the_readme_are_recorded(desk):
    services, one, two = blocks(README, "## A sensor")
    with desk.service(services) as running:
        desk.run(one)
        running.child.terminate()
        running.wait()
    assert desk.recorded_floor_1() == [0.1 * math.sin(0.3 * (index % 100)) for index in range(1000)]
    with desk.service(services):
        desk.run(two)


def test_the_condition_of_the_readme_is_kept(desk):
    services, publishing = blocks(README, "## A condition")
    with desk.service(services):
        desk.run(publishing)
        deadline = time.monotonic() + DEADLINE_S
        while True:
            past = spandrel.history("demo", "air", kind="condition").points
            if len(past) == 3:
                break
            assert time.monotonic() < deadline, f"the history has {past}"
    assert [point.mean for point in past] == [21.5, 21.6, 21.4]


def test_the_programs_of_the_readme_receive_plot_acknowledge_and_query(desk):
    services, simulation, printing, plotting, acknowledging, history, watching = blocks(
        README, "## Estimates and alerts"
    )
    with contextlib.ExitStack() as stack:
        stack.enter_context(desk.service(services))
        printed = stack.enter_context(desk.start(printing))
        plotted = stack.enter_context(desk.start(plotting))
        stack.enter_context(desk.start(simulation))
        printed.wait_for("storey-5 1.")
        plotted.wait_for("plotted")
        assert pathlib.Path(desk.extra["PLOT"]).read_bytes().startswith(b"\x89PNG")
        printed.wait_for("ALERT storey-2 raised storey-2 has lost")
        assert "acknowledged by J. Doe" in desk.run(acknowledging)
        deadline = time.monotonic() + DEADLINE_S
        while " ± " not in desk.run(history):
            assert time.monotonic() < deadline, "the history remains empty"
        said = desk.run(watching)
        assert re.search(r"^storey-1 [01]\.\d{4} ± ", said, re.MULTILINE), said
        assert "plot saved to storey-2.png" in said
        assert (desk.folder / "storey-2.png").read_bytes().startswith(b"\x89PNG")


def test_the_json_script_of_the_topics_page_is_recorded(desk):
    example, script = blocks(TOPICS, "### Samples as JSON")
    assert json.loads(example.text)["samples"] == [[0.012, -0.003], [None, -0.002]]
    services, *_ = blocks(README, "## A sensor")
    with (
        desk.service(services) as running,
        spandrel.subscribe("demo", [spandrel.Status]) as statuses,
    ):
        desk.run(script)
        deadline = time.monotonic() + DEADLINE_S
        while True:
            status = statuses.receive(DEADLINE_S)
            if status.service == "ingest" and status.done >= 1000:
                break
            assert time.monotonic() < deadline, f"the last status is {status}"
        assert not [reason for reason in status.drops if reason.startswith("refused")]
        running.child.terminate()
        running.wait()
    assert desk.recorded_floor_1() == [0.01 * number for number in range(100)] * 10


def test_the_sensor_of_the_how_to_page_is_recorded(desk):
    services, sensor = [
        block for block in blocks(HOW_TO, "## Connect a sensor in Python") if block.kind != "sh"
    ]
    with desk.service(services) as running:
        desk.run(sensor)
        running.child.terminate()
        running.wait()
    found = desk.recorded_floor_1()
    assert len(found) == 500 and len(set(found)) > 400
