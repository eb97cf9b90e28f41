"""Plots: the numbers that are sent to the page."""

import numpy as np
import pytest
import viser

from page.diagnostics import SAMPLE_PERIOD, SECONDS, Limits, PlotPanel

LIMITS = Limits(["arm_joint1", "arm_joint2"], np.array([-1.0, 0.0]), np.array([1.0, 4.0]), np.array([2.0, 5.0]))


@pytest.fixture
def plots(gui: viser.GuiApi) -> PlotPanel:
    return PlotPanel(gui, LIMITS, "latency")


def test_joints_are_plotted_in_percent_of_their_limits(plots: PlotPanel) -> None:
    plots.add_joints([0.0, 4.0], [1.0, -5.0], 10.0)
    plots.add_joints([1.0, 2.0], [2.0, 2.5], 11.0)
    plots.show(11.5)
    times, first, second = plots._positions.data
    np.testing.assert_allclose(times, [-1.5, -0.5])
    np.testing.assert_allclose((first, second), [[0, 100], [100, 0]])
    np.testing.assert_allclose(plots._velocities.data[1:], [[50, 100], [-100, 50]])
    assert [series.get("label") for series in plots._positions.series][1:] == ["joint1", "joint2"]


def test_missing_velocities_are_computed_from_positions(plots: PlotPanel) -> None:
    for step in range(3):
        plots.add_joints([0.1 * step, 0.0], None, 1.0 + 0.5 * step)
    plots.show(2.0)
    np.testing.assert_allclose(plots._velocities.data[1], [0, 10, 10], atol=1e-9)


def test_samples_are_bounded_in_time_and_number(plots: PlotPanel) -> None:
    for step in range(10_000):
        plots.add_joints([0.0, 0.0], [0.0, 0.0], step * 0.01)
        plots.add_latency(float(step % 100), step * 0.01)
    plots.show(99.99)
    times = plots._positions.data[0]
    assert times[0] >= -SECONDS and len(times) <= SECONDS / SAMPLE_PERIOD + 1
    assert plots._latency.data[0][0] >= -SECONDS
    assert "<b>49.5</b>" in plots._figures.content and "<b>99.0</b>" in plots._figures.content
