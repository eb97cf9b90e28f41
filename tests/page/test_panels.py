"""Plots and pictures: the numbers and pixels that go to the page."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np
import pytest
import viser
from page.arm_panel import ControllerPanel
from page.plots import SAMPLE, SECONDS, Limits, PlotPanel

from common.messages import Header, Image
from common.perception.image import ImageError, array_to_image
from page.camera_panel import rgb_image
from page.console import ActionQueue
from page.manual_control import JogPanel
from page.permissions import PageSession, Permissions
from page.server import close_server, make_server

LIMITS = Limits(["arm_joint1", "arm_joint2"], np.array([-1.0, 0.0]), np.array([1.0, 4.0]), np.array([2.0, 5.0]))


@pytest.fixture(scope="module")
def gui() -> Iterator[viser.GuiApi]:
    server = make_server("127.0.0.1", 0)
    yield server.gui
    close_server(server)


def test_joints_are_drawn_against_their_limits(gui: viser.GuiApi) -> None:
    plots = PlotPanel(gui, LIMITS, "latency")
    plots.joints([0.0, 4.0], [1.0, -5.0], 10.0)
    plots.joints([1.0, 2.0], [2.0, 2.5], 11.0)
    plots.show(11.5)
    times, first, second = plots._positions.data
    np.testing.assert_allclose(times, [-1.5, -0.5])
    np.testing.assert_allclose((first, second), [[0, 100], [100, 0]])
    np.testing.assert_allclose(plots._speeds.data[1:], [[50, 100], [-100, 50]])
    assert [series.get("label") for series in plots._positions.series][1:] == ["joint1", "joint2"]


def test_speeds_that_are_not_measured_are_told_from_positions(gui: viser.GuiApi) -> None:
    plots = PlotPanel(gui, LIMITS, "latency")
    for step in range(3):
        plots.joints([0.1 * step, 0.0], None, 1.0 + 0.5 * step)
    plots.show(2.0)
    np.testing.assert_allclose(plots._speeds.data[1], [0, 10, 10], atol=1e-9)


def test_only_the_last_half_minute_and_no_more_samples_than_are_drawn_are_kept(gui: viser.GuiApi) -> None:
    plots = PlotPanel(gui, LIMITS, "latency")
    for step in range(10_000):
        plots.joints([0.0, 0.0], [0.0, 0.0], step * 0.01)
        plots.latency(float(step % 100), step * 0.01)
    plots.show(99.99)
    times = plots._positions.data[0]
    assert times[0] >= -SECONDS and len(times) <= SECONDS / SAMPLE + 1
    assert plots._latency.data[0][0] >= -SECONDS
    assert "<b>49.5</b>" in plots._figures.content and "<b>99.0</b>" in plots._figures.content


def test_picture_is_red_where_it_was_and_no_wider_than_is_shown() -> None:
    bgr = np.zeros((100, 1000, 3), np.uint8)
    bgr[:, :, 2] = 200
    rgb = rgb_image(array_to_image(bgr, "bgr8"), 500)
    assert rgb.shape == (50, 500, 3) and rgb[25, 250].tolist() == [200, 0, 0]
    same = rgb_image(array_to_image(bgr[:, :, ::-1], "rgb8"))
    assert same[50, 50].tolist() == [200, 0, 0]
    grey = rgb_image(array_to_image(np.full((4, 4), 7, np.uint8), "mono8"))
    assert grey.shape == (4, 4, 3) and grey[0, 0].tolist() == [7, 7, 7]


@pytest.mark.parametrize(("encoding", "data"), [("bgr8", b"short"), ("32FC1", bytes(64)), ("jpeg", b"")])
def test_what_is_no_picture_is_refused(encoding: str, data: bytes) -> None:
    with pytest.raises(ImageError):
        rgb_image(Image(header=Header(), height=4, width=4, encoding=encoding, data=data))


async def test_who_only_looks_has_the_arm_do_nothing(gui: viser.GuiApi) -> None:
    doors, noted = Permissions(), []
    doors.guarded = True
    actions = ActionQueue(doors)
    actions.put = noted.append  # type: ignore[method-assign]
    before = set(gui._gui_input_handle_from_uuid)
    ControllerPanel(gui, actions)  # type: ignore[arg-type]  # asks nobody here
    (buttons,) = set(gui._gui_input_handle_from_uuid) - before
    roles = {role: doors.admit(PageSession(n, "10.0.0.5", frozenset({"look", role})), buttons)
             for n, role in enumerate(("look", "tune", "operate"))}
    assert roles == {"look": False, "tune": False, "operate": True}


@pytest.mark.parametrize(("joints", "said"), [
    (["panda_joint1", "panda_joint2"], ["joint1", "joint2"]),
    (["shoulder_pan_joint", "elbow_joint"], ["joint shoulder pan", "joint elbow"]),
    (["1", "2"], ["joint 1", "joint 2"]),
])
async def test_what_is_said_of_the_buttons_of_a_joint_names_it_as_it_is_written(
    gui: viser.GuiApi, joints: list[str], said: list[str]
) -> None:
    panel = JogPanel(gui, ActionQueue(), joints, [1.0, 1.0])
    labels = re.findall(r'aria-label="([^"]*)"', panel._html.content)
    assert labels == [f"jog {name}, {way}" for name in said for way in ("minus", "plus")]
