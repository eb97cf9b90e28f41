"""What has changed in a simulated world since somebody asked last."""

from __future__ import annotations

from typing import Literal

from common.messages import Pose, SceneUpdate, Vector3
from common.robot.transforms import matrix_to_pose
from common.sim.bodies import Body


class News:
    """A world that tells what was taken away and what came to lie.

    Attributes:
        version: grows whenever something has changed that is worth telling.
    """

    def __init__(self) -> None:
        """Nothing has changed yet."""
        self.version = 0
        self._events: list[SceneUpdate] = []

    def take_events(self) -> list[SceneUpdate]:
        """What was taken away or came to lie since the last call, in order."""
        events, self._events = self._events, []
        return events

    def _say(self, what: Literal["add", "remove"], body: Body) -> None:
        pose = None
        if what == "add":
            x, y, z = (float(v) for v in body.T[:3, 3])
            pose = Pose(position=Vector3(x=x, y=y, z=z)) if body.solid.shape == "sphere" else matrix_to_pose(body.T)
        self._events.append(SceneUpdate(data=f"{what}:{body.name}", pose=pose))
        self.version += 1
