"""What an application says of a run in its summary, its report and on the line that tells how far it is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from common.application import Application
from common.messages import PoseArray, TaskStatus
from common.topics import Topic

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from common.config import RobotConfig
    from recording.report.history import RunHistory

Listener = Callable[[float, Any], None]  # is given wall time [s] since the run or its recording began, and a message


class Section(NamedTuple):
    """A part of a report: HTML under a title."""

    name: str
    title: str
    html: str


class Figures:
    """What is said of a run where its application says nothing else.

    An application names a subclass as `Application.figures` and overrides only what differs.
    """

    COUNTED: ClassVar[str] = "done"  # what became of that which a task counts
    STATE_COLORS: ClassVar[Mapping[str, str]] = {}  # of the timeline; states without one get one
    TRUTH: ClassVar[Topic[PoseArray] | None] = None  # where things are, by their labels, if objects do not tell it

    def __init__(self, robot: RobotConfig | None = None, *, pictured: bool = False) -> None:
        """Start with nothing heard.

        Args:
            robot: of the cell; None when it is not known.
            pictured: `picture` will be asked for, which may need more than is kept of a run that goes on for days.
        """
        self.robot, self.pictured = robot, pictured

    def listeners(self) -> dict[Topic[Any], Listener]:
        """Topics that are listened to beside what every run is judged by, each with who is given its messages."""
        return {}

    def exposed(self, message: Any) -> int:
        """Stamp [ns] of the picture by which a message of `decided_by` was decided; 0 for none."""
        return int(message.header.stamp)

    def blocks(self) -> dict[str, Any]:
        """What stands in the summary beside the fields of every run."""
        return {}

    def progress(self, status: TaskStatus) -> str:
        """How far the task is, in a few words."""
        line = f"{status.done} of {status.total} {self.COUNTED} - {status.state}"
        return f"{line} {status.subject}" if status.subject else line

    def headline(self, summary: Mapping[str, Any]) -> str:
        """How the run of a summary ended, in a few words."""
        line = f"{summary['placed']} of {summary['targets']} {self.COUNTED}"
        return f"{line} (truth: {format_truth(summary['truth'])})" if summary["truth"] else line

    def facts(self, summary: Mapping[str, Any]) -> list[tuple[str, str]]:
        """What the head of a report says first: names and values."""
        facts = [(self.COUNTED, f"{summary['placed']} of {summary['targets']}")]
        facts += [(name, str(value)) for name, value in summary["figures"].items()]
        facts.append(("rejected places", str(len(summary["rejected"]))))
        if summary["truth"]:
            facts.append(("truth", format_truth(summary["truth"])))
        return facts

    def picture(self, run: RunHistory, tool: npt.NDArray[np.float64]) -> Section | None:
        """What a report shows of the place of work; None when there is nothing to show.

        Args:
            run: what was gathered of the run.
            tool: (n, 3) way of the tool [m]; empty when it is not known.
        """
        return top_view_section(run, tool)


def figures_of(application: Application | None) -> type[Figures]:
    """The class with which an application tells of its runs."""
    found = application.figures if application else None
    return found if isinstance(found, type) and issubclass(found, Figures) else Figures


def format_truth(truth: Mapping[str, Any]) -> str:
    """Where everything really lies, as "6 in the box, 1 on the table"."""
    containers = truth["containers"]
    parts = [f"{truth['in_box']} in the box"]
    if len(containers) > 1:
        parts = [f"{count} in {name}" for name, count in containers.items()]
    parts.append(f"{truth['on_table']} on the table")
    return ", ".join([*parts, *([f"{truth['elsewhere']} elsewhere"] if truth["elsewhere"] else [])])


def top_view_section(
    run: RunHistory, tool: npt.NDArray[np.float64], marks: Mapping[str, Mapping[tuple[int, int], int]] | None = None
) -> Section | None:
    """The place of work from above; None when nothing was seen there.

    Args:
        run: what was gathered of the run.
        tool: (n, 3) way of the tool [m].
        marks: more places by what they are, in steps of `gathering.SAME_PLACE`, the lowest first.
    """
    from recording.report import charts

    marks = {name: places for name, places in (marks or {}).items() if places}
    if not (marks or run.footprints):
        return None
    return Section("top", "From above", (
        f"{charts.top_view(run, tool, marks)}<p>{len(run.picks)} picked, {len(run.rejections)} rejected. "
        "The truth is shown for comparison only.</p>"
    ))
