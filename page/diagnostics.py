"""Diagnostics: the tabs Health (state of every process), Log and Plots (joints against limits, latency)."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray
from viser import uplot

from common.client.statistics import Rates
from common.messages import JointState, LogLine, ServiceCounters, SupervisorStatus
from page.markup import Html, block, fields, line, row, span, table, text
from page.status_text import service_state

if TYPE_CHECKING:
    from page.console import ActionQueue

LogLevel = Literal["debug", "info", "warning", "error"]

# Stream messages that were replaced by a newer one are not counted as lost: streams are meant to work like that.
HEAD = ("Service", "State", "PID ", "Restarts ", "Busiest topic", "Lost ")
LEGEND = line("Lost: messages that were rejected, or that did not fit into a queue.", "dim small")

LEVELS: tuple[LogLevel, ...] = ("debug", "info", "warning", "error")
_RANK = {"debug": 0, "info": 1, "warning": 2, "error": 3, "critical": 4}
_KIND = {"debug": "dim", "info": "", "warning": "busy", "error": "bad", "critical": "bad"}
MAX_LINES = 2000  # in memory
MAX_SHOWN = 200  # lines, newest first
MAX_LENGTH = 500  # characters of a line
MAX_STAMP = 4e9  # [s] since the Unix epoch: a stamp may have any value

SECONDS = 30.0  # [s] wall time of a plot
SAMPLE_PERIOD = 0.1  # [s] minimum
COLORS = ("#4dabf7", "#ff922b", "#51cf66", "#ff6b6b", "#cc5de8", "#fcc419", "#20c997", "#f783ac")
GRID = "rgba(128, 128, 128, 0.2)"
AXIS_COLOR = "#909296"
HEIGHT = 190  # [px]


class HealthPanel:
    """A table of the services: state, process, rate of the busiest topic, lost messages."""

    def __init__(self, gui: viser.GuiApi, services: Iterable[str]) -> None:
        """Build the panel for the services of the cell, in start order."""
        self._services = list(services)
        self._rates = Rates()
        self._html = Html(gui)

    def count(self, counters: ServiceCounters, now: float) -> None:
        """Update the counters of a service at a wall time [s]."""
        self._rates.update(counters, now)

    def show(self, supervisor: SupervisorStatus | None, alive: frozenset[str]) -> None:
        """Update the table from the supervisor's status; without it, only whether services are alive."""
        if supervisor is not None:
            rows = [self._row(s.name, s.state, s.pid, s.restarts, s.message) for s in supervisor.services]
        else:
            rows = [self._row(name, "ready" if name in alive else "gone", None, 0, "") for name in self._services]
        notices = "".join(line(each.message, "bad" if each.urgent else "busy")
                          for each in (supervisor.notices if supervisor is not None else ()))
        self._html.set(block(notices + table(HEAD, rows, "small") + LEGEND, "health"))

    def _row(self, name: str, state: str, pid: int | None, restarts: int, message: str) -> str:
        label, kind = service_state(state, restarts)
        busiest = self._rates.busiest_of(name) if kind == "good" else None
        counted = self._rates.counted(name)
        lost = sum(counted.overflow.values()) + sum(counted.invalid.values()) if counted else 0
        return row(
            span(name, "tight"),
            f'{span(f"● {label}", kind)} {span(message, "dim") if message else ""}',
            text(pid if pid is not None else "–"),
            str(restarts),
            span(f"{busiest[0]} {busiest[1]:.0f} Hz", "tight") if busiest else span("–", "dim"),
            span(lost, "bad") if lost else "0",
            service=name, state=state, pid=pid or "", restarts=restarts,
        )


class LogPanel:
    """The newest log lines of all services, from a selected level on."""

    def __init__(self, gui: viser.GuiApi, actions: ActionQueue, level: LogLevel) -> None:
        """Build the panel.

        Args:
            gui: of the server.
            actions: runs a change of the level.
            level: lowest level that is shown at first.
        """
        self.level = level
        self._lines: deque[tuple[int, str]] = deque(maxlen=MAX_LINES)
        self._changed = True
        levels = gui.add_dropdown("Minimum level", LEVELS, initial_value=level)
        actions.on_change(levels, self._set_level, "look")
        self._html = gui.add_html("")

    def add(self, line: LogLine) -> None:
        """Add a line."""
        stamp = min(line.header.stamp * 1e-9, MAX_STAMP)
        when = time.strftime("%H:%M:%S", time.localtime(stamp)) if stamp else ""
        message = line.message if len(line.message) <= MAX_LENGTH else line.message[:MAX_LENGTH] + " …"
        shown = row(text(when), text(line.service), span(message, _KIND[line.level]), level=line.level)
        self._lines.append((_RANK[line.level], shown))
        self._changed = True

    def show(self) -> None:
        """Update the panel if anything has changed."""
        if not self._changed:
            return
        self._changed = False
        rank = _RANK[self.level]
        lines = [shown for level, shown in reversed(self._lines) if level >= rank][:MAX_SHOWN]
        self._html.content = block(
            table((), lines, "log") if lines else span("No log lines of this level yet", "dim"), "log",
            lines=len(lines))

    def _set_level(self, level: LogLevel) -> None:
        self.level = level
        self._changed = True
        self.show()


# --- plots ---


@dataclass(frozen=True)
class Limits:
    """Joints of a plot with their limits; arrays are (dof,)."""

    names: Sequence[str]
    lower: NDArray[np.float64]  # [rad]
    upper: NDArray[np.float64]  # [rad]
    velocity: NDArray[np.float64]  # [rad/s]


class Samples:
    """Joint samples of the last half minute.

    Attributes:
        values: wall time [s], positions and velocities (dof,) [rad, rad/s] of each sample.
    """

    def __init__(self, limits: Limits) -> None:
        """Start empty."""
        self._limits = limits
        self.values: deque[tuple[float, NDArray[np.float64], NDArray[np.float64]]] = deque()

    def add(self, state: JointState, now: float) -> None:
        """Add joint states that arrived at a wall time [s]; incomplete ones are left out."""
        at = {name: index for index, name in enumerate(state.name)}
        if all(name in at for name in self._limits.names):
            order = [at[name] for name in self._limits.names]
            velocities = [state.velocity[i] for i in order] if state.velocity else None
            self.add_joints([state.position[i] for i in order], velocities, now)

    def add_joints(self, positions: ArrayLike, velocities: ArrayLike | None, now: float) -> None:
        """Add a sample in the order of the limits, unless the last one is too recent.

        Args:
            positions: (dof,) [rad].
            velocities: (dof,) [rad/s]; None: computed from the positions.
            now: wall time [s], monotonic.
        """
        if self.values and now - self.values[-1][0] < SAMPLE_PERIOD:
            return
        q = np.asarray(positions, dtype=float)
        if velocities is not None:
            dq = np.asarray(velocities, dtype=float)
        elif self.values:
            then, before, _ = self.values[-1]
            dq = (q - before) / (now - then)
        else:
            dq = np.zeros_like(q)
        self.values.append((now, q, dq))
        while self.values[0][0] < now - SECONDS:
            self.values.popleft()


class PlotPanel:
    """Plots joint positions and velocities in percent of their limits, and latency in ms."""

    def __init__(self, gui: viser.GuiApi, limits: Limits, latency: str) -> None:
        """Build the panel; `latency` is the label of the latency."""
        self._limits = limits
        self._samples = Samples(limits)
        self._latencies: deque[tuple[float, float]] = deque()
        empty = np.full(2, np.nan)
        x = np.array([-SECONDS, 0.0])
        names = short_names(limits.names)
        joints = (x, *(empty for _ in names))
        self._positions = _plot(
            gui, joints, names, "Joint position [% of range, 0 = center]", (-105.0, 105.0))
        self._velocities = _plot(gui, joints, names, "Joint velocity [% of limit]", (-105.0, 105.0))
        self._latency = _plot(gui, (x, empty), [latency], f"{latency} [ms]", None)
        self._figures = Html(gui)

    def add(self, state: JointState, now: float) -> None:
        """Add joint states that arrived at a wall time [s]; incomplete ones are left out."""
        self._samples.add(state, now)

    def add_joints(self, positions: ArrayLike, velocities: ArrayLike | None, now: float) -> None:
        """Add a sample: see `Samples.add_joints`."""
        self._samples.add_joints(positions, velocities, now)

    def add_latency(self, ms: float, now: float) -> None:
        """Add the age [ms] that a result had when it arrived at a wall time [s]."""
        self._latencies.append((now, ms))
        while self._latencies[0][0] < now - SECONDS:
            self._latencies.popleft()

    def show(self, now: float) -> None:
        """Update the plots at a wall time [s]."""
        self._draw(self._samples, now)
        recent = [(t, ms) for t, ms in self._latencies if t >= now - SECONDS]
        if len(recent) >= 2:
            times, values = np.array(recent).T
            self._latency.data = (times - now, np.ascontiguousarray(values))
            median, maximum = float(np.median(values)), float(values.max())
            self._figures.set(block(fields({
                "median [ms]": f"{median:.1f}", "max [ms]": f"{maximum:.1f}", "window": f"{SECONDS:.0f} s",
            }), "latency", median=f"{median:.3f}"))

    def show_past(self, states: Sequence[tuple[float, JointState]], at: float) -> None:
        """Plot joint states of the past, each with its time [s], up to the time `at`."""
        samples = Samples(self._limits)
        for when, state in states:
            samples.add(state, when)
        self._draw(samples, at)

    def _draw(self, samples: Samples, now: float) -> None:
        if len(samples.values) >= 2:
            times = np.array([t for t, _, _ in samples.values]) - now
            q, dq = np.array([q for _, q, _ in samples.values]), np.array([dq for _, _, dq in samples.values])
            middle, half = (self._limits.upper + self._limits.lower) / 2, (self._limits.upper - self._limits.lower) / 2
            self._positions.data = (times, *np.ascontiguousarray((100 * (q - middle) / half).T))
            self._velocities.data = (times, *np.ascontiguousarray((100 * dq / self._limits.velocity).T))


def short_names(joints: Sequence[str]) -> list[str]:
    """Return names without a common prefix (joint1 of arm_joint1) or the suffix "_joint" (elbow of elbow_joint)."""
    first = joints[0].partition("_")[0] + "_"
    shared = first if len(joints) > 1 and all(name.startswith(first) for name in joints) else ""
    return [name.removeprefix(shared).removesuffix("_joint").replace("_", " ") for name in joints]


def _plot(
    gui: viser.GuiApi, data: tuple[NDArray[np.float64], ...], names: Sequence[str], title: str,
    limits: tuple[float, float] | None,
) -> viser.GuiUplotHandle:
    scales = {"x": uplot.Scale(time=False, range=(-SECONDS, 0.0)), "y": uplot.Scale()}
    if limits is not None:
        scales["y"] = uplot.Scale(range=limits)
    marks: Any = {"stroke": GRID, "width": 1}
    axis = uplot.Axis(stroke=AXIS_COLOR, grid=marks, ticks=marks, size=42)
    series = tuple(
        uplot.Series(label=name, stroke=COLORS[i % len(COLORS)], width=1.5, points={"show": False})
        for i, name in enumerate(names)
    )
    return gui.add_uplot(
        data, (uplot.Series(label="time [s]"), *series), title=title, scales=scales,
        axes=(axis, axis), legend=uplot.Legend(show=len(names) > 1, live=False),
        height=HEIGHT, padding=(4, 12, 0, 0),
    )
