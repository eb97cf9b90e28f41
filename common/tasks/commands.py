"""What an operator's start, pause, resume and stop do to the status of a task, whatever it plans."""

from __future__ import annotations

from collections.abc import Callable

from common import messages as m
from common.tasks.stages import Command


def obey(command: str, status: m.TaskStatus, restart: Callable[[], None],
         stop: Callable[[str], list[Command]]) -> list[Command]:
    """Update the status; return the requests to send.

    A pause holds the arm on its path; a stop ends the motion.

    Args:
        command: start, pause, resume or stop.
        status: of the task.
        restart: called when a task that has ended starts again.
        stop: returns the requests that end the motion, given the reason.
    """
    if command == "pause":
        status.paused = True
        return [m.HoldRequest(hold=True, reason="the task is paused")]
    reason = f"the operator sent {command} to the task"
    if command in ("start", "resume"):
        status.started, status.paused = status.started or command == "start", False
        if command == "start" and status.state in ("DONE", "ERROR"):
            status.state, status.message = "IDLE", ""
            restart()
        return [m.HoldRequest(hold=False, reason=reason, stops=command == "start")]
    status.paused = status.started = False
    return stop(reason)
