"""A task that closes a clamp, moves while it is closed, and waits for a machine."""

from __future__ import annotations

from common import messages as m
from common.application import Application, ApplicationTopics
from common.process.task_runner import run_task
from common.tasks.decisions import TaskConfig
from common.tasks.engine import Task
from common.tasks.signals import Output, WaitFor
from common.tasks.stages import Move, View
from common.topics import Topic
from common.transport.bus import Bus

STATUS = Topic("clamping_status", m.TaskStatus, "state", "status of the task")
Config = TaskConfig
OVER = m.PoseGoal(pose=m.Pose(position=m.Vector3(x=0.5, y=0.2, z=0.4), orientation=m.Quaternion(x=1.0, w=0.0)))


class Clamping(Task[View]):
    def decide(self, view: View) -> None:
        if self.status.done:
            self.end("DONE")
            return
        self.status.done = self.status.total = 1
        self.queue += [
            Output("clamp"), WaitFor("clamp_closed", timeout=1.0),
            Move("reach", "MOVING", goal=OVER, requires={"clamp_closed": True}), Output("start"),
            WaitFor("busy", True, 1.0), Output("start", False), WaitFor("busy", False, 10.0),
            Move("home", "MOVING", goal=m.JointGoal(named="home")), Output("clamp", False),
            WaitFor("clamp_closed", False)]


async def run(bus: Bus, config: TaskConfig) -> None:
    await run_task(bus, config, Clamping, STATUS, View)


APPLICATION = Application(topics=ApplicationTopics(status=STATUS), task="clamping")
