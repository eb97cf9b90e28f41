"""Task commands as services std_srvs/Trigger."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from bridges.ros2.graph import Graph
from bridges.ros2.types import TRIGGER, make
from common import topics
from common.client.subscriptions import Subscriptions
from common.client.task import TaskControl
from common.errors import ZencellError
from common.messages import MotionStatus
from common.transport.bus import Bus

OWNER = "ros2"  # of its commands and motions: what it holds, it can release
CALLED: Sequence[topics.Request[Any, Any]] = (topics.TASK_COMMAND, topics.MOTION_STOP, topics.MOTION_HOLD)
COMMANDS = ("start", "pause", "resume", "stop")


class Commands:
    """Serves task/start, task/pause, task/resume and task/stop; they never override other operators."""

    def __init__(self, bus: Bus) -> None:
        """Declare the requests."""
        for request in CALLED:
            bus.client(request)  # so that `zencell graph` and access rules know them
        self._bus, self._task = bus, TaskControl(Subscriptions(bus), OWNER)

    def serve(self, graph: Graph) -> None:
        """Offer the services."""
        for command in COMMANDS:
            graph.service(
                f"{graph.node.namespace}/task/{command}", TRIGGER, partial(_obey, self._bus, self._task, command))


async def _obey(bus: Bus, task: TaskControl, command: str, _request: Any) -> Any:
    try:
        answer = await getattr(task, command)()
    except ZencellError as error:
        return make(f"{TRIGGER}_Response", success=False, message=str(error))
    bus.log.info("task %s by %s", command, OWNER)
    done = answer.state if isinstance(answer, MotionStatus) else f"{answer.state}{', paused' if answer.paused else ''}"
    return make(f"{TRIGGER}_Response", success=True, message=f"{command}: {done}")
