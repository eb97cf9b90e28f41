"""The list of steps and the state of the program as HTML of the page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from applications.programming.editing import Draft
from applications.programming.topics import ProgramStatus
from page.markup import block, line, press, row, span, table, text

CURRENT, BREAKPOINT = "▶", "●"


def list_of_steps(draft: Draft | None, status: ProgramStatus | None, problems: Mapping[str, str], chosen: str) -> str:
    """Return the steps, each as a button named `program:choose:ID`, with marks and the seconds of the dry run.

    Args:
        draft: of the open program.
        status: of the program that is loaded, which may be another one.
        problems: of steps by their id; "" for the program.
        chosen: id of the chosen step.
    """
    if draft is None:
        return block("", "steps", steps=0)
    current = status.step if status is not None and draft.name == (status.within or status.program) else ""
    stops = status.breakpoints if status is not None and status.program == draft.name else []
    seconds, failed = rehearsed(draft.name, status)
    rows = []
    for number, each in enumerate(draft.rows, 1):
        marks = (span(CURRENT, "good") if each.id == current else "") + (
            span(BREAKPOINT, "bad") if each.id in stops else "")
        label = "│ " * each.depth + ("else: " if each.body == "else" else "") + each.words
        why = problems.get(each.id) or failed.get(each.id, "")
        note = str(each.step.get("note", ""))
        below = (f'<div class="dim">{text(note)}</div>' if note else "") + (line(why, "bad") if why else "")
        rows.append(row(str(number), marks, press(label, f"program:choose:{each.id}", main=each.id == chosen) + below,
                        span(seconds.get(each.id, ""), "dim"), step=each.id, current=each.id == current))
    rest = line(problems[""], "bad") if problems.get("") else ""
    return block(table((), rows, "steps") + rest, "steps", steps=len(rows), current=current)


def rehearsed(name: str, status: ProgramStatus | None) -> tuple[dict[str, str], dict[str, str]]:
    """Return the seconds of each step in the newest dry run of a program, and the problems that it found, by id."""
    if status is None:
        return {}, {}
    found = [each for each in status.rehearsal.steps if each.program == name]
    times = Counter(each.step for each in found)
    sums = {id_: sum(each.seconds or 0.0 for each in found if each.step == id_) for id_ in times}
    unknown = {each.step for each in found if each.seconds is None or each.unknown}
    seconds = {id_: f"{'≥ ' if id_ in unknown else ''}{sums[id_]:.1f} s" + (f" ({count}x)" if count > 1 else "")
               for id_, count in times.items() if sums[id_] or id_ not in unknown}
    return seconds, {each.step: each.problem for each in reversed(found) if each.problem}


def state_of(status: ProgramStatus | None) -> str:
    """Return what the program does, why it halts, and the result of the dry run, as lines."""
    if status is None:
        return line("The service of programs does not respond", "bad")
    lines = []
    where = f"{status.within or status.program}: {status.step}" if status.step else status.program
    if status.halted:
        lines.append(line(f"Halted at {where}: {status.halted}. Resume continues there.", "busy"))
    elif status.state == "ERROR":
        lines.append(line(f"{where}: {status.message}", "bad"))
    elif status.state == "RUNNING" and status.started:
        loops = "".join(f" ({each})" for each in status.repetitions)
        lines.append(line(f"Running {where}{loops}" + (f": {status.message}" if status.message else ""), "good"))
    elif status.message:
        lines.append(line(status.message, "dim"))
    rehearsal = status.rehearsal
    if rehearsal.state == "running":
        lines.append(line(f"Dry run of {rehearsal.program}: {rehearsal.step}", "busy"))
    elif rehearsal.state == "done":
        exact = all(each.seconds is not None and not each.unknown for each in rehearsal.steps)
        lines.append(line(f"Dry run of {rehearsal.program}: cycle time {'' if exact else 'at least '}"
                          f"{rehearsal.seconds:.1f} s. {rehearsal.message}", "good"))
    elif rehearsal.state == "failed":
        lines.append(line(f"Dry run of {rehearsal.program} failed: {rehearsal.message}", "bad"))
    return "".join(lines)
