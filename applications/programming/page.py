"""Programs on the operator's page: a tab that edits a program and runs it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import viser

from applications.programming import editing
from applications.programming.editor import ProgramEditor
from applications.programming.form import Known, fields_of
from applications.programming.model import STEPS
from applications.programming.step_fields import StepFields
from applications.programming.step_list import list_of_steps, state_of
from applications.programming.topics import PROGRAM_COMMAND, PROGRAM_EDIT, PROGRAM_STATUS, ProgramStatus
from common import topics
from common.messages import JointTrajectory
from page.application import ApplicationPage, ApplicationTab
from page.console import Console, assign
from page.markup import Html, block, buttons, line, press
from page.status_text import command_blocked

if TYPE_CHECKING:
    from page.manual_control import ArmReadout

NONE = "–"  # in place of the name of a program
LIST_PERIOD = 5.0  # [s] between two queries of the names of programs
CHECK_DEBOUNCE = 0.7  # [s] without an edit, after which the service checks the draft
LOST = "the service of programs does not respond"


class ProgramPanel:
    """The tab: programs, buttons to run one, its steps, the fields of the chosen step."""

    def __init__(
        self, gui: viser.GuiApi, console: Console, readout: ArmReadout, play: Callable[[JointTrajectory], None]
    ) -> None:
        """Build the tab.

        Args:
            gui: of the server.
            console: runs the buttons and sends requests.
            readout: of the arm, for its present pose.
            play: animates the ghost of the robot.
        """
        self._console, self._readout, self._play = console, readout, play
        self._played: int | None = None  # stamp of the newest plan when a dry run was first seen, or that was animated
        self.editor = ProgramEditor(console, self._known)
        self._name, self._kind, self._listed = "", "move", -LIST_PERIOD
        self._checked: object = None  # draft and data of the newest check
        self._actions: set[str] = set()
        self._open = gui.add_dropdown("Program", [NONE], initial_value=NONE)
        console.on_change(self._open, self._opened)
        console.on_change(gui.add_text("New name", "", hint="of a program: letters, digits, - and _"), self._set_name)
        self._file, self._run, self._steps = Html(gui), Html(gui), Html(gui)
        kind = gui.add_dropdown("Step to add", list(STEPS), initial_value=self._kind)
        console.on_change(kind, self._set_kind)
        self._orders = Html(gui)
        self._form = StepFields(gui, console, self.editor.apply)

    # --- display ---

    def show(self, arm_blocked: str, now: float) -> None:
        """Update the tab; `arm_blocked` is why no operator can move the arm, `now` the wall time [s]."""
        editor, available = self.editor, self._console.is_available(PROGRAM_EDIT)
        if available and now - self._listed >= LIST_PERIOD:
            self._listed = now
            self._console.put(editor.refresh)
        status = self._console.latest(PROGRAM_STATUS) if available else None
        draft, step = editor.draft, editor.step
        if step is None:
            editor.chosen = ""
        self._show_file("" if available else LOST)
        self._show_run(status)
        problems = {**editor.problems, **editing.problems(draft.data)} if draft is not None else {}
        self._steps.set(list_of_steps(draft, status, problems, editor.chosen))
        for row in draft.rows if draft is not None else ():
            self._on_press(f"choose:{row.id}", partial(editor.choose, row.id))
        self._show_orders(status)
        self._show_ghost(status)
        self._form.show(editor.chosen, fields_of(step, self._known(), editor.point) if step is not None else [])
        state = (draft, draft.data if draft is not None else None)
        if available and state != self._checked:
            self._checked = state
            self._console.put(partial(self._check, state))

    def _show_file(self, lost: str) -> None:
        editor, draft = self.editor, self.editor.draft
        name = draft.name if draft is not None else NONE
        options = list(dict.fromkeys([NONE, *editor.content.programs, name]))
        if options != list(self._open.options):
            self._open.options = options
        if self._open.value != name:
            assign(self._open, name)
        closed = "" if draft is not None else "open a program first"
        unsaved, undo = draft is not None and (draft.unsaved or self._form.pending), draft.undoes if draft else ""
        rows = buttons(
            self._button("New", "new", lambda: editor.new(self._name), lost or (
                "" if self._name else "enter a new name first")),
            self._button("Save", "save", editor.save, lost or editor.incomplete or (
                "" if unsaved else "nothing has changed"), main=unsaved),
            self._button("Confirm deletion" if editor.confirms_deletion else "Delete program", "delete", editor.delete,
                         lost or closed))
        rows += buttons(
            self._button(f"Undo: {undo}" if undo else "Undo", "undo", editor.undo, "" if undo else "there is no edit"),
            self._button("Reload file", "reload", editor.reload, lost or closed or (
                "" if draft is not None and draft.revision else "it has no file yet")))
        if editor.changed_elsewhere:
            rows += line(f"{name} is not saved, as its file was changed elsewhere. Reload shows the new content; Undo "
                         "then returns to the steps of this page.", "bad")
        elif draft is not None:
            rows += line("Not saved" if unsaved else "Saved", "busy" if unsaved else "dim")
        self._file.set(block(rows, "program", open=name, unsaved=unsaved))

    def _show_run(self, status: ProgramStatus | None) -> None:
        editor, console = self.editor, self._console
        task = status if console.is_available(PROGRAM_COMMAND) else None
        motion = console.latest(topics.MOTION_STATUS) if console.is_available(topics.MOTION_STOP) else None
        blocked, halted = command_blocked(task, motion), status is not None and bool(status.halted)
        start = editor.incomplete or ("" if halted else blocked["Start"])
        chosen = start or ("" if editor.chosen else "choose a step first")
        at, send = editor.chosen, editor.command
        rehearsing = status is not None and status.rehearsal.state == "running"
        rows = buttons(
            self._button("Run", "run", partial(send, "run"), start, arm=True, main=not halted),
            self._button("Run from here", f"run_from:{at}", partial(send, "run_from", at), chosen, arm=True),
            self._button("Single step", f"step:{at}", partial(send, "step", at), chosen, arm=True) if not halted else
            self._button("Next step", "step:", partial(send, "step"), "", arm=True))
        rows += buttons(
            self._button("Pause program", "pause", partial(send, "pause"), blocked["Pause"]),
            self._button("Continue", "resume", partial(send, "resume"), "" if halted else blocked["Resume"], arm=True,
                         main=halted),
            self._button("Stop program", "stop", partial(send, "stop"), "" if task is not None else LOST),
            self._button("Skip motions" if rehearsing else "Dry run", f"dry_run:{not rehearsing}",
                         partial(send, "dry_run", paced=not rehearsing), editor.incomplete or (
                "" if task is not None else LOST)))
        self._run.set(block(rows + state_of(status), "run", state=status.state if status else ""))

    def _show_ghost(self, status: ProgramStatus | None) -> None:
        """Animate each motion that a dry run plans, while it waits for as long as the motion takes."""
        plan = self._console.latest(topics.DISPLAY_TRAJECTORY)
        stamp = plan.header.stamp if plan is not None else 0
        if status is None or status.rehearsal.state != "running" or self._played is None:
            self._played = stamp
        elif plan is not None and stamp != self._played:
            self._played = stamp
            self._play(plan)

    def _show_orders(self, status: ProgramStatus | None) -> None:
        editor, draft, step, id_ = self.editor, self.editor.draft, self.editor.step, self.editor.chosen
        closed = "" if draft is not None else "open a program first"
        kind, button, edit = self._kind, self._button, self.editor.edit
        rows = buttons(
            button(f"Add {kind}", f"add:{kind}:{id_}", partial(editor.add, kind, id_), closed),
            *(button(f"Add {kind} in {name}", f"add:{kind}:{id_}:{name}", partial(editor.add, kind, id_, name))
              for name in (editing.bodies(step) if step is not None else ())),
            button("Add here", f"here:{id_}", partial(editor.add_here, id_), closed),
            button("Add here: tool pose", f"here:{id_}:tool", partial(editor.add_here, id_, tool=True), closed))
        if step is not None and draft is not None:
            stops = status is not None and status.program == draft.name and id_ in status.breakpoints
            rows += buttons(
                button("↑ Up", f"up:{id_}", partial(edit, f"move {id_}", editing.move, id_, -1)),
                button("↓ Down", f"down:{id_}", partial(edit, f"move {id_}", editing.move, id_, 1)),
                button("Duplicate", f"duplicate:{id_}", partial(edit, f"duplicate {id_}", editing.duplicate, id_)),
                button("Delete step", f"remove:{id_}", partial(edit, f"delete {id_}", editing.delete, id_)))
            rows += buttons(
                button("Use present pose", f"present:{id_}", partial(editor.use_present_pose, id_)),
                button("Remove breakpoint" if stops else "Breakpoint", f"breakpoint:{id_}:{not stops}",
                       partial(editor.command, "breakpoint", id_, enabled=not stops), editor.incomplete))
            if points := step.get("points"):
                at = min(editor.point, len(points) - 1)
                rows += buttons(
                    *(button(f"{number + 1}", f"point:{id_}:{number}", partial(editor.choose, id_, number),
                             main=number == at) for number in range(len(points))),
                    button("Add present pose", f"point:{id_}:add", partial(editor.use_present_pose, id_, add=True)),
                    button("Remove", f"unpoint:{id_}:{at}", partial(
                        edit, f"change {id_}", editing.remove_point, id_, at)), label="Points")
        self._orders.set(block(rows, "step orders", chosen=id_))

    def _button(
        self, label: str, name: str, action: Callable[[], Any], disabled: str = "", *, arm: bool = False,
        main: bool = False,
    ) -> str:
        """Return a button; its name has what it acts on, as another page may choose another step meanwhile."""
        self._on_press(name, action)
        return press(label, f"program:{name}", disabled, arm=arm, main=main)

    def _on_press(self, name: str, action: Callable[[], Any]) -> None:
        if name not in self._actions:

            def flushed() -> Any:
                if name not in ("pause", "stop", "resume"):  # these must work whatever is in a field
                    self._form.flush()
                return action()

            self._actions.add(name)
            self._console.on_press(f"program:{name}", flushed, f"Program: {name.replace(':', ' ')}")

    def _known(self) -> Known:
        content, q, draft = self.editor.content, self._readout.joints(), self.editor.draft
        signals = self._console.latest(topics.IO_STATE)
        outputs = [each.name for each in signals.signals if each.direction == "output"] if signals is not None else []
        others = [each for each in content.programs if draft is None or each != draft.name]
        known = Known(content.poses, content.signals, outputs, others, scales=self._readout.scales.tolist())
        if q is None:
            return known
        position, rpy = self._readout.tool(q)
        return Known(content.poses, content.signals, outputs, others, q.tolist(), position, rpy, known.scales)

    # --- fields ---

    async def _opened(self, name: str) -> None:
        if name != NONE:
            self._form.flush()
            await self.editor.open(name)

    async def _check(self, state: object) -> None:
        await asyncio.sleep(CHECK_DEBOUNCE)
        if state == self._checked:
            await self.editor.check()

    def _set_name(self, name: str) -> None:
        self._name = name.strip()

    def _set_kind(self, kind: str) -> None:
        self._kind = kind


PAGE = ApplicationPage(
    tab=ApplicationTab("Programs", ProgramPanel), requests=(PROGRAM_COMMAND, PROGRAM_EDIT),
    states={"RUNNING": "The program runs"})
