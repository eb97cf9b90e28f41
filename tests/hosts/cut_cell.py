"""Run a cell on two hosts, cut the link between them, and collect the effects."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

from tests.hosts.two_hosts import TwoHosts

DOMAIN = "42"  # each host has ports of its own
PORT = 7447 + int(DOMAIN)
SPLITS = {  # services on the first host by name of the split; the others, with the task, are on the second
    "perception": ("camera_simulator", "vision_detector", "workspace_validator"),
    "robot": ("motion_planner", "robot_state_publisher", "trajectory_executor"),
}
ZENCELL = str(Path(sys.executable).with_name("zencell"))
PERIOD = 0.01  # [s] between two checks for events
TIMEOUT = 180.0  # [s] for an event, including the start of both parts

Event = dict[str, Any]


@dataclass
class Cut:
    """Effects of a cut link; times in seconds."""

    seconds: float
    noticed: float | None  # from the cut until the services of the other host were reported as gone; None: never
    data: float | None  # from the repair until the next targets
    started: int  # motions that started during the cut


@dataclass
class CutCell:
    """`run panda` on two hosts; a `with` block."""

    two: TwoHosts
    folder: Path
    split: str = "perception"
    options: Sequence[str] = ()
    events: list[Event] = field(default_factory=list)
    _read: int = 0

    def __enter__(self) -> CutCell:
        """Start both parts, and the observer on the host of the arm."""
        first, second = self.two.hosts
        part = ",".join(SPLITS[self.split])
        environment = {"ZENCELL_EPOCH": str(time.time_ns())}
        common = ["--domain", DOMAIN, "--log-json", *self.options]
        first.start(ZENCELL, "up", "panda", "--only", part, "--listen", f"tcp/{first.address}:{PORT}", *common,
                    file=self.folder / "first.log", environment=environment)
        self.run = second.start(
            ZENCELL, "run", "panda", "--without", f"{part},viewer", "--link", f"tcp/{first.address}:{PORT}", *common,
            "--summary", str(self.folder / "summary.json"), file=self.folder / "second.log", environment=environment,
        )
        arm = second if self.split == "perception" else first
        self._out = self.folder / "events"
        arm.start(sys.executable, "-m", "tests.hosts.cut_observer", DOMAIN, file=self._out)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """End all processes."""
        for host in self.two.hosts:
            host.stop()

    def until(self, wanted: Callable[[Event], bool], timeout: float = TIMEOUT) -> Event:
        """Return the first event from now on that satisfies a condition.

        Raises:
            TimeoutError: there was none.
        """
        self._take()
        seen, deadline = len(self.events), time.monotonic() + timeout
        while time.monotonic() < deadline:
            self._take()
            for event in self.events[seen:]:
                if wanted(event):
                    return event
            seen = len(self.events)
            time.sleep(PERIOD)
        raise TimeoutError(f"no such event; the last ones: {self.events[-5:]}")

    def cut(self, seconds: float) -> Cut:
        """Cut the link for some seconds; return when targets arrive again."""
        began = time.monotonic()
        self.two.unplug()
        time.sleep(seconds)
        ended = time.monotonic()
        self.two.plug_in()
        # Targets sent before the repair are no sign of a link.
        back = self.until(lambda e: e["what"] == "targets" and e["at"] > ended)
        gone = [e["at"] for e in self.events if e["what"] == "gone" and e["at"] > began]
        goals = {e["id"] for e in self.events if e["what"] == "motion" and began < e["at"] < ended}
        before = {e["id"] for e in self.events if e["what"] == "motion" and e["at"] <= began}
        noticed = round(gone[0] - began, 2) if gone and gone[0] < back["at"] else None
        return Cut(seconds, noticed, round(back["at"] - ended, 2), len(goals - before))

    def end(self, timeout: float = 120.0) -> dict[str, Any]:
        """Wait for the end of the run; return its summary."""
        self.run.wait(timeout=timeout)
        summary: dict[str, Any] = json.loads((self.folder / "summary.json").read_text(encoding="utf-8"))
        return summary

    def _take(self) -> None:
        text = self._out.read_text(encoding="utf-8")
        complete = text.rfind("\n") + 1
        self.events += [json.loads(line) for line in text[self._read:complete].splitlines() if line.startswith("{")]
        self._read = complete
