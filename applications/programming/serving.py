"""Serves the commands and edits of programs, calls functions of the user, and persists the progress."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from applications.programming.cursor import Progress
from applications.programming.files import (
    BadProgram,
    ProgramFile,
    load_all,
    load_program,
    names_in,
    parse_program,
    path_of,
    revision_of,
    save_program,
    text_of,
)
from applications.programming.flow import Flow
from applications.programming.functions import call_function
from applications.programming.rehearsal import Rehearser, static_problems
from applications.programming.task import ProgramTask
from applications.programming.topics import (
    PROGRAM_COMMAND,
    PROGRAM_EDIT,
    ProgramCommand,
    ProgramContent,
    ProgramEdit,
    ProgramStatus,
    Rehearsal,
)
from common import messages as m
from common import topics
from common.atomic_file import AtomicFile, Unreadable
from common.errors import Refused, RequestFailed, ZencellError
from common.process.task_runner import TaskMemory, TaskRunner, require_allowed
from common.tasks.stages import View
from common.time_source import monotonic
from common.transport.bus import Bus
from common.transport.reader import Reader

NAME = re.compile(r"[\w-]{1,80}")
PLAN_TIMEOUT = 30.0  # [s] wall
FIRST_MESSAGES = 5.0  # [s] wall until a dry run knows the state of the robot


class ProgramMemory(TaskMemory):
    """Persists the progress while the cell is up, and with the parameter `progress` also beyond its end."""

    def __init__(self, bus: Bus, task: ProgramTask) -> None:
        """Start with the progress of a new task."""
        super().__init__(bus, task)
        self._program = task
        self._lasting = AtomicFile(Path(task.p.progress), Progress) if task.p.progress else None
        self.on_write: Callable[[], None] = lambda: None

    async def load(self) -> None:
        """Restore the progress of the process before, or of the cell before."""
        await super().load()
        at = self._program.at
        at.saves = self._file is not None
        if self._lasting is None or at.progress.position or self._program.status.halted:
            return
        try:
            found = self._lasting.find()
        except Unreadable as error:  # the next save replaces it
            self._bus.log.warning("the progress of the program is lost: %s", error)
            return
        if found is not None:
            self._program.remember(found)

    async def _write(self, file: AtomicFile[Any]) -> None:
        await super()._write(file)
        if self._lasting is not None:
            await asyncio.to_thread(self._lasting.save, self._saved)
        self._program.at.persisted = self._saved
        self.on_write()


class ProgramRunner(TaskRunner[View]):
    """Steps the task of programs, and serves its requests."""

    def __init__(self, bus: Bus, task: ProgramTask, observe: Any, *given: Any, **more: Any) -> None:
        """Declare the requests in addition to those of each task."""
        super().__init__(bus, task, observe, *given, **more)
        self._program, self._look = task, observe
        self._planner = bus.client(topics.MOTION_PLAN)
        self._called = asyncio.Event()
        self._editing = asyncio.Lock()  # between the check of a revision and the write
        self._wanted: tuple[ProgramCommand, Flow] | None = None
        self._rehearse = asyncio.Event()
        if isinstance(self._memory, ProgramMemory):
            self._memory.on_write = self._woken.set
        bus.serve(PROGRAM_COMMAND, self._command)
        bus.serve(PROGRAM_EDIT, self._edit)

    @property
    def folder(self) -> Path:
        """Folder of the programs."""
        given = Path(self._program.p.program)
        return given.resolve().parent if given.suffix else Path(self._program.p.folder).expanduser().resolve()

    async def run(self, readers: Iterable[Reader[Any]]) -> None:
        """Step until cancelled."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._call_functions())
            group.create_task(self._rehearse_programs())
            await super().run(readers)

    def _publish(self) -> None:
        if self._program.call is not None:
            self._called.set()
        super()._publish()

    # --- functions of the user --------------------------------------------------------------------------------------

    async def _call_functions(self) -> None:
        """Carry out calls one after the other; one that the operator has left is cancelled."""
        while True:
            await self._called.wait()
            self._called.clear()
            if (call := self._program.call) is None:
                continue
            running = asyncio.create_task(call_function(call.step, call.folder), name=call.step.function)
            while not running.done() and self._program.call is call:
                await asyncio.wait({running}, timeout=0.1)
            if running.done():
                self._program.on_result(call, *running.result())
            running.cancel()
            self._woken.set()

    # --- commands -------------------------------------------------------------------------------------------------

    async def _command(self, request: ProgramCommand) -> ProgramStatus:
        with _refusals():
            if request.command in ("pause", "stop"):
                await self._obey(m.TaskCommand(command=request.command, by=request.by))
            elif request.command == "breakpoint":
                self._set_breakpoint(request)
            elif request.command == "dry_run":
                self._begin_rehearsal(request)
            else:
                await self._run_program(request)
        self._woken.set()
        return self._program.status.model_copy(update={"header": self._bus.header()}, deep=True)

    async def _run_program(self, request: ProgramCommand) -> None:
        task, status = self._program, self._program.status
        view, ended = self._look(), status.state == "DONE"
        if request.command == "resume" and not (status.halted or (status.started and not ended)):
            raise Refused("not_started", f"there is nothing to resume: {status.program or 'a program'} "
                          f"{'has ended' if ended else 'was not started'}; run it")
        continues = request.command == "resume" or (
            request.command == "step" and not request.step and request.program in ("", status.program)
            and bool(task.at.position))
        command = "start" if not status.started or status.state in ("DONE", "ERROR") or not continues else "resume"
        asked = m.TaskCommand(command=command, by=request.by, override=request.override,
                              acknowledged=request.acknowledged)
        require_allowed(asked, view.motion if view else None, self._owner.latest)
        if not continues:
            self._require_idle("stop it first")
            if request.command == "run_from" and not request.step:
                raise Refused("bad_program", "run_from needs the id of a step")
            task.at.load(self._file(request.program))
            task.go_to(request.step)
        elif task.at.flow is None:
            raise Refused("bad_program", "no program is loaded: name one")
        task.proceed(single=request.command == "step")
        await self._obey(asked)

    def _file(self, program: str) -> ProgramFile:
        """Read a program, by default the loaded one."""
        at = self._program.at
        if not program or program == self._program.status.program:
            return load_program(at.program.files[at.program.main].path)
        path = path_of(self.folder, _checked(program))
        if not path.is_file():
            raise Refused("bad_program", f"there is no program {program!r} in {self.folder}; choices: "
                          f"{', '.join(names_in(self.folder)) or 'none'}")
        return load_program(path)

    def _require_idle(self, what: str) -> None:
        if self._program.is_active:
            raise Refused("busy", f"{self._program.status.program} is at step {self._program.status.step}: {what}")

    def _set_breakpoint(self, request: ProgramCommand) -> None:
        at, status = self._program.at, self._program.status
        name = request.program or status.program
        if name and (name != status.program or request.step not in at.ids):  # the file may have steps since then
            if self._program.is_active or status.halted:
                raise Refused("busy", f"{status.program} is at step {status.step}, as it was loaded: stop it before "
                              f"you set a breakpoint at {request.step}")
            at.load(self._file(name))
        if request.step not in at.ids:
            raise Refused("bad_program", f"there is no step {request.step!r}; choices: {', '.join(sorted(at.ids))}")
        others = [each for each in status.breakpoints if each != request.step]
        status.breakpoints = [*others, request.step] if request.enabled else others

    # --- dry run --------------------------------------------------------------------------------------------------

    def _begin_rehearsal(self, request: ProgramCommand) -> None:
        self._require_idle("a dry run starts at standstill")
        file = self._file(request.program)
        flow = Flow(load_all(file), file.name)
        if request.step:
            flow.find(request.step)
        self._program.status.rehearsal = Rehearsal(program=file.name, state="running")
        self._wanted = request, flow
        self._rehearse.set()

    async def _rehearse_programs(self) -> None:
        while True:
            await self._rehearse.wait()
            self._rehearse.clear()
            if self._wanted is not None:
                (request, flow), self._wanted = self._wanted, None
                await self._plan_all(request, flow)

    async def _plan_all(self, request: ProgramCommand, flow: Flow) -> None:
        """Plan all motions by the planner of the cell, which shows each; a newer dry run ends this one."""
        task, until = self._program, monotonic() + FIRST_MESSAGES
        while (view := self._look()).missing:
            if monotonic() > until:
                missing = ", ".join(view.missing)
                task.status.rehearsal = Rehearsal(program=flow.main, state="failed", message=f"no message on {missing}")
                return
            await asyncio.sleep(0.05)
        rehearser = Rehearser(flow, task.cell, task.p.io, view, task.p.planning_time)
        planning = rehearser.run(flow.find(request.step) if request.step else flow.start)
        response: m.PlanResponse | None = None
        while not self._rehearse.is_set():
            if task.is_active:
                rehearser.result.state, rehearser.result.message = "failed", "ended, as the program runs"
                break
            try:
                wanted = next(planning) if response is None else planning.send(response)
            except StopIteration:
                break
            try:
                response = await self._planner.call(wanted, PLAN_TIMEOUT)
            except RequestFailed as error:
                response = m.PlanResponse(id=wanted.id, ok=False, error="no_answer", message=str(error))
            task.status.rehearsal = rehearser.result.model_copy(deep=True)
            self._woken.set()
            if request.paced and response.trajectory is not None:
                await asyncio.sleep(response.trajectory.points[-1].time_from_start / self._bus.clock.speed)
        task.status.rehearsal = rehearser.result.model_copy(deep=True)
        self._woken.set()

    # --- edits ----------------------------------------------------------------------------------------------------

    async def _edit(self, request: ProgramEdit) -> ProgramContent:
        task = self._program
        reply = ProgramContent(header=self._bus.header(), program=request.program, text=request.text,
                               signals=list(task.p.io.signals), poses=sorted({
                                   *task.p.robot.named_poses, *task.cell.saved().poses}))
        with _refusals():
            try:
                if request.act != "list":
                    async with self._editing:
                        await asyncio.to_thread(self._apply, request, reply)
            except BadProgram as error:
                reply.problems = error.problems[:200]
        reply.programs = names_in(self.folder)
        return reply

    def _apply(self, request: ProgramEdit, reply: ProgramContent) -> None:
        path = path_of(self.folder, _checked(request.program))
        if request.act == "load":
            reply.text = text_of(load_program(path).program)
            reply.revision = revision_of(path)
            return
        if request.act in ("save", "delete") and request.revision != (revision := revision_of(path)):
            raise Refused("changed", f"{request.program} was changed elsewhere: its file is of revision "
                          f"{revision or 'none'}, the request is for {request.revision or 'none'}; load it again")
        if request.act == "delete":
            if request.program == self._program.status.program:
                self._require_idle("stop it first")
            path.unlink(missing_ok=True)
            return
        file = parse_program(request.text, path)
        reply.text = text_of(file.program)
        if request.act == "save":
            save_program(file)
            reply.revision = revision_of(path)
            self._bus.log.info("program %s saved%s", file.name, f" by {request.by}" if request.by else "")
        load_all(file)
        task = self._program
        found = [f"{file.where(step)}: {problem}" for step, problem in static_problems(file, task.cell, task.p.io)]
        reply.problems = found[:200]


def _checked(program: str) -> str:
    if not NAME.fullmatch(program):
        raise Refused("bad_program", f"{program!r} is no name of a program: letters, digits, _ and -")
    return program


@contextmanager
def _refusals() -> Iterator[None]:
    """Refuse a request that is not valid, or whose file cannot be written."""
    try:
        yield
    except (Refused, RequestFailed):
        raise
    except OSError as error:
        raise Refused("not_saved", f"{error.filename}: {error.strerror}") from None
    except ZencellError as error:
        raise Refused("bad_program", str(error)) from None
