"""The first line of the status bar: what is the case, its color, and what to do next."""

from typing import Any

import pytest

from common import messages as m
from common.application import find_application
from page.situation import Situation, control_text, situation
from page.status_text import TaskText, command_blocked

STOP = m.Interlock(kind="stopped", by="page", reason="stopped on the page", since=5)
HOLD = m.Interlock(kind="held", by="anna", reason="the task is paused", since=7)
BLOCKED = m.Interlock(kind="held", by="scene_monitor", reason="ball_2 obstructs the motion", since=7)
RUNS = {"state": "GRASPING", "started": True, "done": 2, "total": 7}


def shown(task: dict[str, Any] | None, owner: str = "none", robot: m.RobotStatus | None = None,
          **motion: Any) -> Situation:
    status = m.TaskStatus(**task) if task is not None else None
    return situation(TaskText.of(find_application("pick_place")), status, m.MotionStatus(**motion),
                     m.MotionOwner(kind=owner, jogging=owner == "operator"), robot)  # type: ignore[arg-type]


@pytest.mark.parametrize(("task", "motion", "wanted"), [
    ({}, {}, Situation("Ready", "good", "Press Start to run the task.")),
    ({"message": "waiting for gripper/state, motion/status"}, {},
     Situation("Ready", "good", "waiting for the gripper, the arm")),
    (RUNS, {"state": "active"}, Situation("Grasping", "good", "2 of 7 done")),
    (RUNS, {"interlocks": [STOP, HOLD]}, Situation("Stopped by page", "busy", "Check the cell, then press Start.", 5)),
    (RUNS | {"paused": True}, {"held": True, "held_by": ["operator"], "interlocks": [HOLD]},
     Situation("Paused by anna", "busy", "Press Resume to continue.", 7)),
    (RUNS, {"held": True, "held_by": ["scene_monitor"], "interlocks": [BLOCKED]},
     Situation("Arm waits: ball_2 obstructs the motion", "busy", "It continues by itself.", 7)),
    ({"state": "ERROR", "started": True, "message": "no plan"}, {},
     Situation("Failed: no plan", "bad", "Check the cell, then press Start.")),
    ({"state": "DONE", "started": True}, {}, Situation("Done", "good", "Press Start to run the task again.")),
    ({}, {"owner": "operator"}, Situation("Jogging", "good")),
    (None, {"interlocks": [STOP]}, Situation("Stopped by page", "busy", "Check the cell.", 5)),
    (RUNS, {"fault": "motor off", "interlocks": [STOP]},
     Situation("Robot fault: motor off", "bad", "Remove the cause.")),
    (RUNS, {"robot": m.RobotStatus(mode="protective_stop", message="joint 3", controller=True)},
     Situation("Protective stop: joint 3", "bad", "Remove the cause, then press Recover.")),
])
def test_most_important_situation_is_shown_with_the_next_step(
    task: dict[str, Any] | None, motion: dict[str, Any], wanted: Situation
) -> None:
    assert shown(task, **motion) == wanted


@pytest.mark.parametrize("task", [{}, RUNS, RUNS | {"paused": True}, {"state": "DONE", "started": True}])
@pytest.mark.parametrize("motion", [
    {}, {"interlocks": [STOP]}, {"held": True, "interlocks": [HOLD]}, {"fault": "motor off"}])
def test_start_and_resume_are_never_both_possible(task: dict[str, Any], motion: dict[str, Any]) -> None:
    blocked = command_blocked(m.TaskStatus(**task), m.MotionStatus(**motion))
    assert blocked["Start"] or blocked["Resume"]


def test_commands_say_that_the_cell_has_no_task() -> None:
    blocked = command_blocked(None, m.MotionStatus(), has_task=False)
    assert blocked == dict.fromkeys(("Start", "Pause", "Resume"), "this cell has no task")


@pytest.mark.parametrize(("owner", "text"), [
    (None, "unknown"), (m.MotionOwner(), "free"), (m.MotionOwner(kind="task", owner="mover"), "task"),
    (m.MotionOwner(kind="operator", owner="page"), "you"), (m.MotionOwner(kind="operator", owner="anna"), "anna"),
])
def test_control_is_shown_as_the_operator_sees_it(owner: m.MotionOwner | None, text: str) -> None:
    assert control_text(owner, "page") == text
