"""What an application adds to the summary, the report and the progress line of a run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from common.application import Application
from common.messages import PoseArray, TaskStatus, WorldObject, WorldObjects
from common.topics import Topic

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from common.config import RobotConfig
    from recording.report.history import RunHistory

Listener = Callable[[float, Any], None]  # takes wall time [s] since the start of the run or recording, and a message


class Section(NamedTuple):
    """Section of a report: HTML below a title."""

    name: str
    title: str
    html: str


class Figures:
    """Figures of a run, with the platform's defaults.

    An application names a subclass as `Application.figures` and overrides only what differs.
    """

    COUNTED: ClassVar[str] = "done"  # label of what the task counts
    STATE_COLORS: ClassVar[Mapping[str, str]] = {}  # of task states in the timeline; the others get default colors
    IN_PLACE: ClassVar[str] = "objects in place"  # label of what `in_place` returns
    TRUTH: ClassVar[Topic[PoseArray] | None] = None  # labelled positions, if world objects have no state
    parameters: Mapping[str, Any] = {}  # of the task in the cell file

    def __init__(self, robot: RobotConfig | None = None, *, for_report: bool = False) -> None:
        """Start without messages.

        Args:
            robot: of the cell; None if unknown.
            for_report: whether `picture` will be called, which may need data that must not grow for days otherwise.
        """
        self.robot, self.for_report = robot, for_report

    def listeners(self) -> dict[Topic[Any], Listener]:
        """Return listeners of topics that not every run needs."""
        return {}

    def exposed(self, message: Any) -> int:
        """Return the stamp [ns] of the image that a message of the topic `decided_by` is based on; 0 for none."""
        return int(message.header.stamp)

    def blocks(self) -> dict[str, Any]:
        """Return additional fields of the summary."""
        return {}

    def progress(self, status: TaskStatus) -> str:
        """Return the progress of the task in a few words."""
        line = f"{status.done} of {status.total} {self.COUNTED} - {status.state}"
        return f"{line} {status.subject}" if status.subject else line

    def headline(self, summary: Mapping[str, Any]) -> str:
        """Return the result of a run in a few words."""
        line = f"{summary['placed']} of {summary['targets']} {self.COUNTED}"
        return f"{line} (truth: {format_truth(summary['truth'])})" if summary["truth"] else line

    def in_place(self, truth: WorldObjects) -> list[WorldObject] | None:
        """Return the objects that are where the task puts them, by ground truth; None if containers say it.

        `zencell simulate` expects all objects in place once the task is DONE.
        """
        return None

    def facts(self, summary: Mapping[str, Any]) -> list[tuple[str, str]]:
        """Return names and values for the head of a report."""
        facts = [(self.COUNTED, f"{summary['placed']} of {summary['targets']}")]
        facts += [(name, str(value)) for name, value in summary["figures"].items()]
        facts.append(("rejected places", str(len(summary["rejected"]))))
        if summary["truth"]:
            facts.append(("truth", format_truth(summary["truth"])))
        return facts

    def picture(self, run: RunHistory, tool: npt.NDArray[np.float64]) -> Section | None:
        """Return a section that shows the work area; None if there is nothing to show.

        Args:
            run: history of the run.
            tool: (n, 3) path of the tool [m]; empty if unknown.
        """
        return top_view_section(run, tool)


def figures_of(application: Application | None) -> type[Figures]:
    """Return the figures class of an application."""
    found = application.figures if application else None
    return found if isinstance(found, type) and issubclass(found, Figures) else Figures


def format_truth(truth: Mapping[str, Any]) -> str:
    """Return what was achieved, or the final positions of objects as "6 in the box, 1 on the table"."""
    if truth.get("achieved"):
        return str(truth["achieved"])
    containers = truth["containers"]
    parts = [f"{truth['in_box']} in the box"] if containers or truth["in_box"] else []
    if len(containers) > 1:
        parts = [f"{count} in {name}" for name, count in containers.items()]
    parts.append(f"{truth['on_table']} on the table")
    return ", ".join([*parts, *([f"{truth['elsewhere']} elsewhere"] if truth["elsewhere"] else [])])


def top_view_section(
    run: RunHistory, tool: npt.NDArray[np.float64], marks: Mapping[str, Mapping[tuple[int, int], int]] | None = None
) -> Section | None:
    """Return the work area from above; None if there is nothing to show.

    Args:
        run: history of the run.
        tool: (n, 3) path of the tool [m].
        marks: further positions by label, in steps of `history.SAME_PLACE`, the lowest first.
    """
    from recording.report import charts

    marks = {name: places for name, places in (marks or {}).items() if places}
    if not (marks or run.footprints):
        return None
    return Section("top", "From above", (
        f"{charts.top_view(run, tool, marks)}<p>{len(run.picks)} picked, {len(run.rejections)} rejected. "
        "The truth is shown for comparison only.</p>"
    ))
