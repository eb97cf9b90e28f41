"""The figures of a run that every cell has; the file that `run` writes."""

from __future__ import annotations

import json
import math
from array import array
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from common.messages import (
    MotionStatus,
    PlanFigure,
    Rejection,
    Rejections,
    TaskStatus,
    Vector3,
)
from recording.report.application import Figures
from recording.report.history import Truth

SAME_PLACE = 0.03  # [m] rejections closer than this are of the same thing
NOT_LEFT_BEHIND = "inside the container"  # such a detection is of what was placed
MOST_PLACES = 1000  # that are listed as rejected: the newest
MOST_PLANS = 10_000  # of all lives of the task, the newest
MAX_LATENCIES = 20_000  # of frames; the older half is forgotten then: the last quarter of an hour stays at 10 Hz


@dataclass
class Rejected:
    """Places that were rejected, each once."""

    places: list[Rejection] = field(default_factory=list)

    def add(self, rejections: Iterable[Rejection]) -> None:
        """Take note of rejections; of the same place only the newest reason is kept."""
        at = [_place(known.position) for known in self.places]
        for rejection in rejections:
            if NOT_LEFT_BEHIND in rejection.reason:
                continue
            place = _place(rejection.position)
            for index, known in enumerate(at):
                if abs(known[0] - place[0]) < SAME_PLACE and math.dist(known, place) < SAME_PLACE:
                    self.places[index], at[index] = rejection, place
                    break
            else:
                self.places.append(rejection)
                at.append(place)
                del self.places[:-MOST_PLACES], at[:-MOST_PLACES]


@dataclass
class Counted:
    """Figures of the task that start over when its process does."""

    failures: int = 0
    retries: int = 0
    moving: float = 0.0  # cell time [s]
    planning: float = 0.0  # wall time [s]
    plans: list[PlanFigure] = field(default_factory=list)

    @classmethod
    def of(cls, status: TaskStatus) -> Counted:
        """The figures in a status."""
        return cls(status.failures, status.retries, status.moving_seconds, status.planning_seconds, list(status.plans))

    def __add__(self, other: Counted) -> Counted:
        """Figures of one life of the process and of the next."""
        return Counted(
            self.failures + other.failures,
            self.retries + other.retries,
            self.moving + other.moving,
            self.planning + other.planning,
            [*self.plans, *other.plans][-MOST_PLANS:],
        )

    def restarted_since(self, earlier: Counted) -> bool:
        """Whether these figures cannot follow the earlier ones in one life of the process."""
        return (
            self.failures < earlier.failures
            or self.retries < earlier.retries
            or self.moving < earlier.moving - 1e-9
            or self.planning < earlier.planning - 1e-9
            or len(self.plans) < len(earlier.plans)
        )


class Summary:
    """Gathers the figures of one run."""

    def __init__(
        self, cell: str, seed: int, speed: float, figures: Figures | None = None, containers: Sequence[str] = (),
        *, fills: bool = False,
    ) -> None:
        """Start with nothing seen.

        Args:
            cell: name of the cell.
            seed: of the run.
            speed: seconds of cell time per second of wall time.
            figures: what the application says of the run.
            containers: ids of those that the cell has.
            fills: the task brings all that there is into containers.
        """
        self.figures = figures or Figures()
        self.cell = cell
        self.seed = seed
        self.speed = speed
        self.status = TaskStatus()
        self.ready: float | None = None  # wall time [s] from the start of the process to the cell being ready
        self.first_motion: float | None = None  # wall time [s] from the start of the process
        self.truth = Truth(tuple(containers))
        self.fills = fills
        self.rejected = Rejected()
        self.restarts: dict[str, int] = {}
        self.failed = False  # the cell did not come up
        self.chaos: list[dict[str, object]] | None = None  # faults that were made on purpose, if any were to be
        self._latencies = array("d")  # [ms]
        self._before = Counted()  # of earlier lives of the task's process
        self._now = Counted()
        self._task_since: float | None = None  # cell time [s]
        self._task_until = 0.0  # cell time [s]

    def on_status(self, status: TaskStatus) -> None:
        """Take note of the task's status."""
        figures = Counted.of(status)
        if figures.restarted_since(self._now):
            self._before = self._before + self._now
        self._now = figures
        self.status = status
        if status.started:
            stamp = status.header.stamp * 1e-9
            if self._task_since is None:
                self._task_since = stamp - status.task_seconds
            self._task_until = stamp

    def on_motion(self, time: float, status: MotionStatus) -> None:
        """Take note of a motion's status at a wall time [s] from the start of the process."""
        if status.state == "active" and self.first_motion is None:
            self.first_motion = time

    def on_rejections(self, _time: float, rejections: Rejections) -> None:
        """Take note of what the task is not offered, and why."""
        self.rejected.add(rejections.rejected)

    def on_latency(self, milliseconds: float) -> None:
        """Take note of the time [ms] from a frame's exposure to the arrival of the targets seen in it."""
        if len(self._latencies) == MAX_LATENCIES:
            del self._latencies[: MAX_LATENCIES // 2]
        self._latencies.append(milliseconds)

    @property
    def state(self) -> str:
        """Where the task ended; ERROR too when the cell did not come up."""
        return "ERROR" if self.failed else self.status.state

    @property
    def unexplained(self) -> list[list[float]]:
        """Where [m] a task that is DONE left what it does not call rejected, by the truth of a simulated world."""
        if not (self.fills and self.state == "DONE"):
            return []
        named = [_xyz(place.position) for place in self._all_rejected().places]
        return [[round(value, 4) for value in thing.position] for thing in self.truth.left(named)]

    def _all_rejected(self) -> Rejected:
        rejected = Rejected(list(self.rejected.places))
        rejected.add(self.status.skipped)
        return rejected

    def write(self, file: Path) -> None:
        """Write it as JSON, at once: a reader sees all of it or none."""
        beside_it = file.with_name(file.name + ".part")
        beside_it.write_text(json.dumps(self.as_dict(), indent=2) + "\n", encoding="utf-8")
        beside_it.replace(file)

    def as_dict(self) -> dict[str, Any]:
        """The summary file."""
        rejected = self._all_rejected()
        figures = self._before + self._now
        took = self._task_until - self._task_since if self._task_since is not None else 0.0
        return {
            "cell": self.cell,
            "state": self.state,
            "placed": self.status.done,
            "targets": self.status.total,
            "rejected": [{"position": _xyz(place.position), "reason": place.reason} for place in rejected.places],
            "failures": figures.failures,
            "retries": figures.retries,
            "seconds": {
                "ready": _rounded(self.ready),
                "first_motion": _rounded(self.first_motion),
                "task": _rounded(took),
                "moving": _rounded(figures.moving),
                "planning": _rounded(figures.planning),
            },
            "plans": [plan.model_dump() for plan in figures.plans],
            "frame_to_target_ms": {
                "p50": _rounded(percentile(self._latencies, 0.50)),
                "p99": _rounded(percentile(self._latencies, 0.99)),
            },
            "restarts": dict(self.restarts),
            "seed": self.seed,
            "speed": self.speed,
            "truth": self.truth.counted(),
            "figures": dict(self.status.figures),
            "overlooked": self.status.overlooked,
            "unexplained": self.unexplained,
            **self.figures.blocks(),
            **({"chaos": list(self.chaos)} if self.chaos is not None else {}),
        }


def percentile(values: Sequence[float], fraction: float) -> float | None:
    """The value below which this fraction of the values lies (nearest rank); None of nothing."""
    if not values:
        return None
    return sorted(values)[max(0, math.ceil(fraction * len(values)) - 1)]


def describe(summary: dict[str, Any], application: Figures) -> list[str]:
    """A summary in a few lines for people.

    Args:
        summary: as a file has it.
        application: says how the run ended.
    """
    seconds = summary["seconds"]
    lines = [f"{summary['cell']}: {summary['state']}, {application.headline(summary)}"]
    if summary["figures"]:
        lines.append("  " + ", ".join(f"{name} {value}" for name, value in summary["figures"].items()))
    for place in summary["rejected"]:
        x, y, z = place["position"]
        lines.append(f"  left at ({x:.3f}, {y:.3f}, {z:.3f}): {place['reason']}")
    if summary.get("overlooked"):
        lines.append(f"  {summary['overlooked']}")
    for x, y, z in summary.get("unexplained", ()):
        lines.append(f"  left at ({x:.3f}, {y:.3f}, {z:.3f}): not among what was rejected")
    times = [
        f"ready {_seconds(seconds['ready'])}",
        f"first motion {_seconds(seconds['first_motion'])}",
        f"task {_seconds(seconds['task'])}",
        f"moving {_seconds(seconds['moving'])}",
        f"planning {_seconds(seconds['planning'])} in {len(summary['plans'])} plans",
    ]
    lines.append("  " + ", ".join(times))
    if summary["failures"] or summary["retries"]:
        lines.append(f"  {summary['failures']} failures, {summary['retries']} retries")
    if summary["frame_to_target_ms"]["p50"] is not None:
        latency = summary["frame_to_target_ms"]
        lines.append(f"  frame to target {latency['p50']:.1f} ms (median), {latency['p99']:.1f} ms (99 %)")
    if "chaos" in summary:
        lines.append(f"  {len(summary['chaos'])} faults on purpose")
    if restarted := {name: count for name, count in summary["restarts"].items() if count}:
        lines.append("  started again: " + ", ".join(f"{name} {count} x" for name, count in restarted.items()))
    return lines


def _seconds(value: float | None) -> str:
    return "never" if value is None else f"{value:.1f} s"


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)


def _xyz(position: Vector3) -> list[float]:
    return [round(position.x, 4), round(position.y, 4), round(position.z, 4)]


def _place(position: Vector3) -> tuple[float, float, float]:
    return position.x, position.y, position.z
