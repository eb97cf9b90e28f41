"""The panel with what was measured in the last half minute: joints against their limits, and latency."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray
from viser import uplot

from common.messages import JointState
from page.markup import block, fields

SECONDS = 30.0  # [s] wall time that is shown
SAMPLE = 0.1  # [s] least time between two samples
SETTLE = 10  # samples before speeds that are not measured can be told
COLORS = ("#4dabf7", "#ff922b", "#51cf66", "#ff6b6b", "#cc5de8", "#fcc419", "#20c997", "#f783ac")
GRID = "rgba(128, 128, 128, 0.2)"
INK = "#909296"
HEIGHT = 190  # [px]


@dataclass(frozen=True)
class Limits:
    """What a plot of joints is against; arrays are (dof,)."""

    names: Sequence[str]
    lower: NDArray[np.float64]  # [rad]
    upper: NDArray[np.float64]  # [rad]
    velocity: NDArray[np.float64]  # [rad/s]


class Samples:
    """Joints as they were in the last half minute.

    Attributes:
        kept: wall time [s], positions and velocities (dof,) [rad, rad/s] of each sample.
    """

    def __init__(self, limits: Limits) -> None:
        """Start without any."""
        self._limits = limits
        self.kept: deque[tuple[float, NDArray[np.float64], NDArray[np.float64]]] = deque()

    def measured(self, state: JointState, now: float) -> None:
        """Take a sample of joint states that came at a wall time [s]; one in which a joint is missing is left out."""
        at = {name: index for index, name in enumerate(state.name)}
        if all(name in at for name in self._limits.names):
            order = [at[name] for name in self._limits.names]
            speeds = [state.velocity[i] for i in order] if state.velocity else None
            self.add([state.position[i] for i in order], speeds, now)

    def add(self, positions: ArrayLike, velocities: ArrayLike | None, now: float) -> None:
        """Take a sample of the joints, in the order of the limits, at a wall time [s]; too many are left out.

        Args:
            positions: (dof,) [rad].
            velocities: (dof,) [rad/s]; None when they are not measured: told from the positions.
            now: wall time [s], monotonic.
        """
        if self.kept and now - self.kept[-1][0] < SAMPLE:
            return
        q = np.asarray(positions, dtype=float)
        if velocities is not None:
            dq = np.asarray(velocities, dtype=float)
        elif self.kept:
            then, before, _ = self.kept[-1]
            dq = (q - before) / (now - then)
        else:
            dq = np.zeros_like(q)
        self.kept.append((now, q, dq))
        while self.kept[0][0] < now - SECONDS:
            self.kept.popleft()


class PlotPanel:
    """Keeps samples and draws them: positions and speeds in percent of what the joints can do, latency in ms."""

    def __init__(self, gui: viser.GuiApi, limits: Limits, latency: str) -> None:
        """Lay the panel out where the GUI stands.

        Args:
            gui: of the server.
            limits: of the joints.
            latency: what the latency is from and to.
        """
        self._limits = limits
        self._samples = Samples(limits)
        self._latencies: deque[tuple[float, float]] = deque()
        none = np.full(2, np.nan)
        x = np.array([-SECONDS, 0.0])
        names = short_names(limits.names)
        joints = (x, *(none for _ in names))
        self._positions = _plot(gui, joints, names, "Position, % of the way between the limits", (-105.0, 105.0))
        self._speeds = _plot(gui, joints, names, "Speed, % of the limit", (-105.0, 105.0))
        self._latency = _plot(gui, (x, none), [latency], f"{latency} [ms]", None)
        self._figures = gui.add_html("")

    def measured(self, state: JointState, now: float) -> None:
        """Take a sample of joint states that came at a wall time [s]; one in which a joint is missing is left out."""
        self._samples.measured(state, now)

    def joints(self, positions: ArrayLike, velocities: ArrayLike | None, now: float) -> None:
        """Take a sample of the joints: see `Samples.add`."""
        self._samples.add(positions, velocities, now)

    def show_past(self, states: Sequence[tuple[float, JointState]], at: float) -> None:
        """Draw joint states, each with its time [s], up to a time that is looked back at."""
        samples = Samples(self._limits)
        for when, state in states:
            samples.measured(state, when)
        self._draw(samples, at)

    def _draw(self, samples: Samples, now: float) -> None:
        if len(samples.kept) >= 2:
            times = np.array([t for t, _, _ in samples.kept]) - now
            q, dq = np.array([q for _, q, _ in samples.kept]), np.array([dq for _, _, dq in samples.kept])
            middle, half = (self._limits.upper + self._limits.lower) / 2, (self._limits.upper - self._limits.lower) / 2
            self._positions.data = (times, *np.ascontiguousarray((100 * (q - middle) / half).T))
            self._speeds.data = (times, *np.ascontiguousarray((100 * dq / self._limits.velocity).T))

    def latency(self, ms: float, now: float) -> None:
        """Take in how old [ms] a result was when it came, at a wall time [s]."""
        self._latencies.append((now, ms))
        while self._latencies[0][0] < now - SECONDS:
            self._latencies.popleft()

    def show(self, now: float) -> None:
        """Draw what is known at a wall time [s]."""
        self._draw(self._samples, now)
        recent = [(t, ms) for t, ms in self._latencies if t >= now - SECONDS]
        if len(recent) >= 2:
            times, values = np.array(recent).T
            self._latency.data = (times - now, np.ascontiguousarray(values))
            middle_ms, most = float(np.median(values)), float(values.max())
            content = block(fields({"median [ms]": f"{middle_ms:.1f}", "most [ms]": f"{most:.1f}",
                                    "of the last": f"{SECONDS:.0f} s"}), "latency", median=f"{middle_ms:.3f}")
            if content != self._figures.content:
                self._figures.content = content


def short_names(joints: Sequence[str]) -> list[str]:
    """Names without what all of them begin with, as joint1 of arm_joint1, or end with, as elbow of elbow_joint."""
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
    axis = uplot.Axis(stroke=INK, grid=marks, ticks=marks, size=42)
    lines = tuple(
        uplot.Series(label=name, stroke=COLORS[i % len(COLORS)], width=1.5, points={"show": False})
        for i, name in enumerate(names)
    )
    return gui.add_uplot(
        data, (uplot.Series(label="s ago"), *lines), title=title, scales=scales,
        axes=(axis, axis), legend=uplot.Legend(show=len(names) > 1),
        height=HEIGHT, padding=(4, 12, 0, 0),
    )
