"""Commands of programs: check, dry-run and export of a file; run, step, resume and breakpoints in a running cell."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from common.terminal import echo
from common.verbs import BeforeRun, Verbs

if TYPE_CHECKING:
    from applications.programming.topics import ProgramStatus

File = Annotated[Path, typer.Argument(metavar="FILE", help="a program")]
InCell = Annotated[
    str | None, typer.Option("--cell", metavar="CELL", help="name or file; default: that of the program")
]
Name = Annotated[str | None, typer.Argument(metavar="[PROGRAM]", help="name of its file; default: the loaded one")]
At = Annotated[str | None, typer.Option("--from", metavar="STEP", help="id of a step; default: the first")]
Step = Annotated[str, typer.Argument(metavar="STEP", help="id of a step")]
RunIn = Annotated[str | None, typer.Option("--cell", metavar="CELL", help="for a program: the cell, by name or file, "
                                                                          "whose task it replaces")]


def check(file: File, on: InCell = None, overrides: list[str] | None = None) -> None:
    """Check poses, signals and functions of a program, and plan each motion; exit 2 with all problems."""
    from applications.programming import offline

    found = offline.rehearse(file, on, tuple(overrides or ()), everything=True)
    offline.require_no_problems(found)
    items = found.result.steps
    steps = {(item.program, item.step) for item in items}
    echo(f"{file}: no problem found in {len(steps)} steps, {found.planned} motions planned from home")
    for note in dict.fromkeys(f"  {item.step}: {item.unknown}" for item in items if item.unknown):
        echo(note)


def dry_run(file: File, on: InCell = None, overrides: list[str] | None = None) -> None:
    """Plan a program from home without a running cell: each step with its time, and the cycle time."""
    from applications.programming import offline

    found = offline.rehearse(file, on, tuple(overrides or ()))
    for line in offline.report(found):
        echo(line)
    unknown = sum(item.seconds is None for item in found.result.steps)
    more = f", and {unknown} steps of unknown time" if unknown else ""
    echo(f"{found.result.seconds:6.2f}s  cycle time{more}")
    if found.result.message:
        echo(found.result.message)
    offline.require_no_problems(found)


def export(file: File, on: InCell = None) -> None:
    """Print a Python script over `zencell.blocking` that does the same as a program."""
    from applications.programming.offline import exported

    echo(exported(file, on), nl=False)


def _command(cell: str | None, domain: str | None, connect: str | None, **fields: Any) -> None:
    from applications.programming.topics import PROGRAM_COMMAND
    from common.client.cell import Cell
    from common.client.joining import newest_interlock

    async def send() -> ProgramStatus:
        async with Cell(cell, domain=domain, connect=connect) as joined:
            status: ProgramStatus = await joined.call(
                PROGRAM_COMMAND, {**fields, "by": joined.owner, "acknowledged": await newest_interlock(joined.bus)})
            return status

    status = asyncio.run(send())
    where = f"step {status.step} (line {status.line})" if status.step else status.state
    halts = f"; breakpoints: {', '.join(status.breakpoints)}" if status.breakpoints else ""
    echo(f"{status.program}: {where}{halts}")


def run(
    program: Name = None, at: At = None, cell: str | None = None, domain: str | None = None, connect: str | None = None,
) -> None:
    """Run a program of a running cell, from its first step or another one."""
    _command(cell, domain, connect, command="run_from" if at else "run", program=program or "", step=at or "")


def step(cell: str | None = None, domain: str | None = None, connect: str | None = None) -> None:
    """Do one step, then halt."""
    _command(cell, domain, connect, command="step")


def resume(cell: str | None = None, domain: str | None = None, connect: str | None = None) -> None:
    """Let a program continue after a breakpoint, a single step, a pause, or a restart in the middle."""
    _command(cell, domain, connect, command="resume")


def breakpoint_(
    step: Step, remove: Annotated[bool, typer.Option("--remove", help="remove it")] = False, cell: str | None = None,
    domain: str | None = None, connect: str | None = None,
) -> None:
    """Set a breakpoint: the program halts before this step."""
    _command(cell, domain, connect, command="breakpoint", step=step, enabled=not remove)


def before_run(cell: str, overrides: list[str], world: str | None, *, on: RunIn = None) -> BeforeRun:
    """Replace a program by its cell, which runs it instead of its task."""
    from common.errors import ConfigError

    if Path(cell).suffix not in (".yaml", ".yml"):
        if on:
            raise ConfigError("--cell", on, f"is for a program, and {cell!r} is a cell")
        return BeforeRun(overrides)
    from applications.programming import offline
    from applications.programming.files import load_program

    if not offline.is_program(cell):
        if on:
            raise ConfigError("--cell", on, f"is for a program, and {cell!r} is none: it has no steps")
        return BeforeRun(overrides)
    file = load_program(Path(cell).expanduser())
    name = offline.cell_of(file, on)
    own, progress = offline.overrides_for(file, name, tuple(overrides))

    def check_motions() -> None:
        found = offline.rehearse(file.path, name, tuple(overrides), everything=True)
        offline.require_no_problems(found, certain=True)

    def forget() -> None:
        """The operator has ended the run: the next one begins at the first step."""
        for each in progress.parent.glob(f"{progress.name}*"):  # also the files that replace it
            each.unlink(missing_ok=True)

    return BeforeRun([*own, *overrides], cell=name, after=forget, check=check_motions)


VERBS = Verbs(
    commands={"program check": check, "program dry-run": dry_run, "program export": export, "program run": run,
              "program step": step, "program resume": resume, "program breakpoint": breakpoint_},
    groups={"program": "Check, rehearse, export and run programs of steps."}, before_run=before_run)
