"""The tab of programs: what it shows, and its buttons and fields."""

from __future__ import annotations

import asyncio
import html
import re
from typing import Any

import numpy as np
import pytest
import viser

from applications.programming.page import ProgramPanel
from applications.programming.step_fields import TYPING_DEBOUNCE
from applications.programming.topics import ProgramStatus, Rehearsal, RehearsedStep
from common import topics
from common.messages import Header, JointState, JointTrajectory
from page.manual_control import ArmReadout
from tests.applications.programming.program_service import Cell
from tests.page.scene_cell import robot_of

ROBOT = robot_of("ur5")
Q = np.array([0.1, -1.2, 1.3, -1.6, -1.5, 0.2])
TWO = "steps:\n  - {step: wait, id: wait1, seconds: 1.0}\n  - {step: move, id: move1, to: home}\n"


class Page:
    """The tab in a cell that has the program `two`."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self.cell = Cell()
        self.cell.files["two"] = TWO
        self.plan: JointTrajectory | None = None  # newest one that was published
        self.played: list[JointTrajectory] = []
        console = self.cell.console
        latest, joints = console.latest, JointState(
            header=Header(), name=list(ROBOT.joint_names), position=Q.tolist(), velocity=[0.0] * 6, effort=[0.0] * 6)
        console.latest = lambda topic: joints if topic is topics.JOINT_STATES else (
            self.plan if topic is topics.DISPLAY_TRAJECTORY else latest(topic))
        self.panel: Any = ProgramPanel(gui, console, ArmReadout(ROBOT, console.latest), self.played.append)
        self.now = 0.0

    def show(self) -> str:
        """Return the HTML of the tab."""
        self.now += 0.1
        self.panel.show("", self.now)
        return "".join(each.content for each in (
            self.panel._file, self.panel._run, self.panel._steps, self.panel._orders))

    @property
    def steps(self) -> list[str]:
        """The rows of the list of steps: number, marks, words and seconds."""
        self.show()
        found = re.findall(r"<tr [^>]*>(.*?)</tr>", self.panel._steps.content)
        return [" ".join(html.unescape(re.sub(r"<[^>]*>", " ", each)).split()) for each in found]

    def button(self, label: str) -> tuple[str, str]:
        """Return the name of a button and why it is disabled."""
        found = re.findall(rf'<button [^>]*data-press="([^"]*)"([^>]*)>{re.escape(label)}</button>', self.show())
        assert len(found) == 1, (label, found)
        why = re.search(r'title="([^"]*)"', found[0][1])
        return found[0][0], html.unescape(why[1]) if why else ""

    async def press(self, label: str) -> None:
        """Press an enabled button."""
        name, disabled = self.button(label)
        assert disabled == "", (label, disabled)
        result = self.cell.console._buttons[name][0]()
        if result is not None:
            await result
        self.show()

    async def choose(self, id_: str) -> None:
        self.show()
        self.cell.console._buttons[f"program:choose:{id_}"][0]()
        self.show()

    def field(self, label: str) -> viser.GuiInputHandle[Any]:
        """Return the only field of the form with a label."""
        (found,) = [each for each in self.panel._form._elements.values() if each.label == label]
        return found

    async def enter(self, label: str, value: Any) -> None:
        """Enter a value as a page does, without waiting for the end of typing."""
        path = next(path for path, each in self.panel._form._elements.items() if each.label == label)
        self.field(label).value = value
        task = asyncio.create_task(self.panel._form._entered(self.panel._form._id, path, value))
        await asyncio.sleep(0)
        self.tasks = [*getattr(self, "tasks", []), task]


@pytest.fixture
async def page(gui: viser.GuiApi) -> Page:
    one = Page(gui)
    await one.panel.editor.refresh()
    return one


async def test_program_of_three_steps_is_made_by_pressing_buttons_and_run(page: Page) -> None:
    assert page.button("New")[1] == "enter a new name first" and page.button("Run")[1] == "open a program first"
    page.panel._set_name(" load ")
    await page.press("New")
    assert page.button("Run")[1] == "a program needs at least one step"
    await page.press("Add here")
    page.panel._set_kind("grip")
    await page.press("Add grip")
    await page.press("Add here: tool pose")
    position = ", ".join(f"{1e3 * each:.0f}" for each in ROBOT.fk(Q)[:3, 3])
    assert page.steps == ["1 move to joints 6, -69, 74, -92, -86, 11", "2 open gripper", f"3 move to {position} mm"]
    await page.press("↑ Up")
    await page.press("Run")
    assert page.cell.files["load"].splitlines()[0] == "steps:" and page.cell.commands[0].program == "load"
    page.cell.status = ProgramStatus(program="load", within="load", step="grip1", state="RUNNING", started=True)
    assert page.steps[2] == "3 ▶ open gripper" and "Running load: grip1" in page.show()


async def test_halted_program_asks_and_is_continued(page: Page) -> None:
    await page.panel.editor.open("two")
    page.cell.status = ProgramStatus(
        program="two", within="two", step="move1", state="RUNNING", started=True, breakpoints=["wait1"],
        halted="the controller was restarted in the middle of move1")
    assert page.steps == ["1 ● wait 1 s", "2 ▶ move to home"]
    assert "Halted at two: move1: the controller was restarted in the middle of move1" in page.show()
    await page.press("Continue")
    await page.press("Next step")
    assert [(each.command, each.step) for each in page.cell.commands] == [("resume", ""), ("step", "")]


async def test_dry_run_shows_seconds_of_each_step_and_its_problem(page: Page) -> None:
    await page.panel.editor.open("two")
    steps = [RehearsedStep(program=program, step=step, kind="wait", seconds=seconds) for program, step, seconds in (
        ("two", "wait1", 1.0), ("two", "wait1", 1.0), ("two", "move1", 2.5), ("other", "move1", 9.0))]
    page.cell.status = ProgramStatus(
        program="two", rehearsal=Rehearsal(program="two", state="done", seconds=4.5, steps=steps))
    assert page.steps == ["1 wait 1 s 2.0 s (2x)", "2 move to home 2.5 s"]
    assert "Dry run of two: cycle time 4.5 s" in page.show()
    failed = RehearsedStep(program="two", step="move1", kind="move", problem="no path: table would collide")
    page.cell.status = ProgramStatus(program="two", rehearsal=Rehearsal(
        program="two", state="failed", steps=[failed], message="move1"))
    assert page.steps[1] == "2 move to home no path: table would collide"


def plan_at(stamp: int) -> JointTrajectory:
    return JointTrajectory(header=Header(stamp=stamp), joint_names=["a"], points=[])


async def test_motions_of_a_dry_run_are_animated_one_after_the_other_and_can_be_skipped(page: Page) -> None:
    await page.panel.editor.open("two")
    page.plan = plan_at(1)  # of a former motion
    await page.press("Dry run")
    page.cell.status = ProgramStatus(program="two", rehearsal=Rehearsal(program="two", state="running"))
    for stamp in (1, 2, 2, 3):
        page.plan = plan_at(stamp)
        page.show()
    await page.press("Skip motions")
    page.cell.status = ProgramStatus(program="two", rehearsal=Rehearsal(program="two", state="done"))
    page.plan = plan_at(4)
    page.show()
    assert [plan.header.stamp for plan in page.played] == [2, 3]
    assert [(each.command, each.paced) for each in page.cell.commands] == [("dry_run", True), ("dry_run", False)]


async def test_typed_value_is_applied_before_a_button_acts_or_after_a_pause(page: Page) -> None:
    await page.panel.editor.open("two")
    await page.choose("wait1")
    await page.enter("Seconds [s]", "2")
    await page.enter("Seconds [s]", "2.5")
    await page.press("Save")
    assert "seconds: 2.5" in page.cell.files["two"]
    await page.enter("Note", "for the glue")
    assert "for the glue" not in page.steps[0]
    await asyncio.sleep(1.2 * TYPING_DEBOUNCE)
    assert page.steps[0] == "1 wait 2.5 s for the glue"


async def test_invalid_value_is_explained_below_its_field_and_changes_nothing(page: Page) -> None:
    await page.panel.editor.open("two")
    await page.choose("wait1")
    before = page.panel.editor.draft.data
    await page.enter("Seconds [s]", "soon")
    with pytest.raises(Exception, match="soon"):
        await page.press("Duplicate")
    reason = page.panel._form._reasons["seconds",]
    assert "seconds: 'soon' must be a valid number" in html.unescape(reason.content)
    assert page.panel.editor.draft.data is before and page.field("Seconds [s]").value == "soon"
    await page.enter("Seconds [s]", "3")
    await page.press("Duplicate")
    assert page.steps == ["1 wait 3 s", "2 wait 3 s", "3 move to home"] and not page.panel._form._reasons


async def test_value_that_another_page_enters_for_the_former_step_is_ignored(page: Page) -> None:
    await page.panel.editor.open("two")
    await page.choose("wait1")
    entered = page.panel._form._entered("wait1", ("note",), "late")
    await page.choose("move1")
    await entered
    await page.press("Duplicate")
    assert "late" not in str(page.panel.editor.draft.data)


async def test_stop_works_with_an_invalid_value_in_a_field(page: Page) -> None:
    await page.panel.editor.open("two")
    await page.choose("wait1")
    await page.enter("Seconds [s]", "soon")
    await page.press("Stop program")
    assert page.cell.commands[-1].command == "stop"


async def test_alternative_fields_replace_each_other(page: Page) -> None:
    await page.panel.editor.open("two")
    await page.choose("move1")
    await page.enter("To", "displacement")
    page.show()
    assert page.panel.editor.step["to"] == {"by": [0.0, 0.0, 0.05]}
    assert page.field("Displacement [mm]").value == (0.0, 0.0, 50.0)
    await page.choose("wait1")
    await page.enter("Wait for", "a signal")
    page.show()
    assert page.steps[0] == "1 wait for door on"


async def test_hostile_names_and_texts_of_a_file_are_shown_escaped(page: Page) -> None:
    page.cell.files["two"] = 'steps:\n  - {step: move, id: move1, to: "<script>alert(1)</script>", note: "<b>&"}\n'
    await page.panel.editor.open("two")
    page.show()
    content = page.show()
    assert "<script>" not in content and "<b>&" not in content
    assert "&lt;script&gt;" in content
