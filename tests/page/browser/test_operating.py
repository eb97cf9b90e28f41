"""Operating a real cell on its page."""

from __future__ import annotations

import asyncio
import os
import signal
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from applications.outlining.topics import CONTOURS, OUTLINE_STATUS, OutlineStatus
from applications.pick_place.topics import PICK_PLACE_STATUS, PickPlaceStatus
from common import topics
from common.messages import JointState, MotionStatus, ParameterReply, ParameterRequest, SupervisorStatus
from common.transport.bus import Client, Reader
from tests.harness import until
from tests.page.browser.conftest import IN_BROWSER, PATIENCE, Bring, Watched

if TYPE_CHECKING:
    from playwright.async_api import Page

pytestmark = IN_BROWSER

LAYOUT = ("--set", f"services.viewer.layout={Path(__file__).with_name('nothing_to_draw.yaml')}")
# Slow, so that the task lasts until a busy browser has drawn the page.
PANDA = ("up", "panda", "--set", "autostart=false", "--set", "services.trajectory_executor.speed_scaling=0.2", *LAYOUT)
UR5 = ("up", "ur5", "--world", "w5", "--speed", "10", "--set", "autostart=false", *LAYOUT)
MOVING = 0.01  # [rad/s]
NOISE = "services.camera_simulator.noise_std"


def is_moving(state: JointState) -> bool:
    return max(map(abs, state.velocity)) > MOVING


async def after(reader: Reader[JointState], count: int) -> JointState:
    """Return the joint state after a number of others."""
    for _ in range(count):
        await reader.next()
    return await reader.next()


async def in_motion(page: Page, joints: Reader[JointState]) -> None:
    """Start the task, if it is not running, and wait until the arm moves."""
    start = page.get_by_role("button", name="Start")
    runs = page.locator('[data-press="start"][title="already running"]')
    try:
        await start.and_(page.locator(":not([aria-disabled])")).or_(runs).wait_for()
    except BaseException as error:
        text = await page.locator("body").inner_text(timeout=5000)
        presses = await page.locator("[data-press=start]").evaluate_all("found => found.map(one => one.outerHTML)")
        error.add_note(f"Start is {presses}; the page shows {text!r}")
        raise
    if not await runs.count():
        await start.click()
    await until(joints, is_moving, PATIENCE)


async def test_pause_stops_the_arm_and_resume_starts_it(bring: Bring, watched: Watched) -> None:
    cell = await bring(*PANDA)
    page = await watched.open(cell.address)
    async with cell.listen() as bus:
        joints, motion = bus.reader(topics.JOINT_STATES), bus.reader(topics.MOTION_STATUS)
        status = bus.reader(PICK_PLACE_STATUS)
        pause = page.get_by_role("button", name="Pause")
        place = await pause.bounding_box()
        await in_motion(page, joints)
        await pause.click()
        await until(motion, lambda status: status.held, PATIENCE)
        await until(joints, lambda state: not is_moving(state), PATIENCE)
        still = (await after(joints, 5)).position
        assert (await after(joints, 100)).position == pytest.approx(still, abs=1e-6)
        await page.locator('[data-part="task"][data-paused="True"]').get_by_text("Paused", exact=True).wait_for()
        assert await pause.bounding_box() == place, "it must not move under the pointer"
        await page.get_by_role("button", name="Resume").click()
        await until(joints, is_moving, PATIENCE)
        assert not (await until(status, lambda status: not status.paused, PATIENCE)).paused
        await page.locator('[data-part="task"][data-paused="False"][data-held="False"]').wait_for()


async def test_stop_stops_arm_and_task(bring: Bring, watched: Watched) -> None:
    cell = await bring(*PANDA)
    page = await watched.open(cell.address)
    async with cell.listen() as bus:
        joints = bus.reader(topics.JOINT_STATES)
        await in_motion(page, joints)
        stopping = asyncio.create_task(
            until(bus.reader(PICK_PLACE_STATUS), lambda status: not status.started, PATIENCE))
        await page.get_by_role("button", name="STOP").click()
        stopped: PickPlaceStatus = await stopping
        ended: MotionStatus = await until(
            bus.reader(topics.MOTION_STATUS), lambda status: status.state != "active", PATIENCE)
        assert ended.state == "cancelled" and stopped.state != "ERROR"
        await until(joints, lambda state: not is_moving(state), PATIENCE)
        still = (await after(joints, 5)).position
        assert (await after(joints, 100)).position == pytest.approx(still, abs=1e-6)
        await page.locator('[data-part="notice"]').get_by_text("Stopped").wait_for()


async def test_escape_key_stops_too(bring: Bring, watched: Watched) -> None:
    cell = await bring(*PANDA)
    page = await watched.open(cell.address)
    async with cell.listen() as bus:
        await in_motion(page, bus.reader(topics.JOINT_STATES))
        await page.keyboard.press("Escape")
        await until(bus.reader(topics.MOTION_STATUS), lambda status: status.state == "cancelled", PATIENCE)
        await until(bus.reader(PICK_PLACE_STATUS), lambda status: not status.started, PATIENCE)


async def test_parameter_is_changed_on_the_page_and_shown_when_changed_elsewhere(
    bring: Bring, watched: Watched
) -> None:
    from playwright.async_api import expect

    cell = await bring(*PANDA)
    page = await watched.open(cell.address)
    await page.get_by_text("Tuning", exact=True).first.click()
    await page.get_by_text("camera simulator", exact=True).click()
    label = page.get_by_text("noise std", exact=True)
    field = page.locator(".mantine-Flex-root").filter(has=label).last.get_by_role("textbox")
    await expect(field).to_have_value("0", timeout=1e3 * PATIENCE)
    async with cell.listen() as bus:
        client = bus.client(topics.parameters_of("camera_simulator"))
        await field.fill("3")
        await page.locator('[data-part="tuning"]').get_by_text(f"{NOISE} set to 3.0").wait_for()
        assert await value_of(client) == 3
        await client.call(ParameterRequest(set={NOISE: 0}, by="a test"))
        await expect(field).to_have_value("0", timeout=1e3 * PATIENCE)
        await field.fill("-1")
        await expect(field).to_have_value("0", timeout=1e3 * PATIENCE)


async def value_of(client: Client[ParameterRequest, ParameterReply]) -> object:
    reply = await client.call(ParameterRequest())
    return next(parameter.value for parameter in reply.parameters if parameter.path == NOISE)


async def test_killed_service_turns_red_and_comes_back(bring: Bring, watched: Watched) -> None:
    cell = await bring(*PANDA)
    page = await watched.open(cell.address)
    line = page.locator('tr[data-service="workspace_validator"]')
    await line.and_(page.locator('[data-state="ready"]')).locator(".good").wait_for()
    async with cell.listen() as bus:
        supervisor = bus.reader(topics.SUPERVISOR_STATUS)
        status = await until(supervisor, lambda status: bool(pid_of(status)), PATIENCE)
        red = asyncio.create_task(line.locator(".bad").wait_for())
        await asyncio.sleep(0)
        os.kill(pid_of(status), signal.SIGKILL)
        await red
        await line.and_(page.locator('[data-state="ready"][data-restarts="1"]')).locator(".good").wait_for()


def pid_of(status: SupervisorStatus) -> int:
    return next((service.pid or 0 for service in status.services if service.name == "workspace_validator"), 0)


async def test_selected_object_is_traced(bring: Bring, watched: Watched) -> None:
    cell = await bring(*UR5)
    page = await watched.open(cell.address)
    async with cell.listen() as bus:
        status = bus.reader(OUTLINE_STATUS)
        found = await until(bus.reader(CONTOURS), lambda found: len(found.contours) == 3, PATIENCE)
        other = next(contour.label for contour in found.contours if contour.index != found.selected)
        await page.get_by_role("button", name=other).click()
        done: OutlineStatus = await until(status, lambda status: status.state in ("DONE", "ERROR"), 2 * PATIENCE)
        assert (done.state, done.object, done.closed) == ("DONE", other, True), done.message
        await page.locator('[data-part="task"][data-state="DONE"]').get_by_text("Done").wait_for()
