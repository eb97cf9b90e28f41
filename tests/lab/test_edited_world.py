"""What lies on the table stays there, unless somebody is asked to change it."""

from __future__ import annotations

import pytest

from common import topics
from common.config import load_cell
from common.messages import Pose, Vector3, WorldEdit, WorldEditReply, WorldObject, WorldObjects
from common.transport.codec import encode, encoding_of
from common.transport.session import RawSample
from lab.invariants import OBJECTS, Invariants
from lab.processes import RequestLog

EDIT = WorldEdit(op="move", id="ball_1", position=Vector3(x=0.5))


class Told:
    """Invariants that are told of the world."""

    def __init__(self) -> None:
        self.requests = RequestLog()
        self.invariants = Invariants(load_cell("panda"), self.requests, lambda: 0.0)

    def say(self, **places: float) -> list[str]:
        """What is broken once these objects lie there, at x [m]."""
        objects = [WorldObject(id=name, shape="sphere", pose=Pose(position=Vector3(x=x)), state="table")
                   for name, x in places.items()]
        payload = encode(WorldObjects(objects=objects))
        key = f"panda/{topics.SCENE_OBJECTS.key}"
        self.invariants.on_put("executor", "executor 1", RawSample(key, payload, encoding_of(WorldObjects)))
        return self.invariants.broken

    def answer(self) -> None:
        self.requests.on_answer("visitor", EDIT, WorldEditReply(id="ball_1", ids=["ball_1"]))


@pytest.mark.parametrize("later", [{}, {"ball_1": 0.4}, {"ball_1": 0.3, "ball_2": 0.5}])
def test_what_vanishes_moves_or_comes_by_itself_is_told(later: dict[str, float]) -> None:
    told = Told()
    assert told.say(ball_1=0.3) == []
    assert any(OBJECTS in line for line in told.say(**later))


@pytest.mark.parametrize("answered", [True, False])
def test_what_somebody_changes_is_not_whether_it_is_said_before_the_answer_or_after_it(answered: bool) -> None:
    told = Told()
    told.say(ball_1=0.3)
    told.requests.on_ask("visitor", EDIT)
    if answered:
        told.answer()
    assert told.say(ball_1=0.5) == []


def test_after_the_change_it_has_to_stay_again() -> None:
    told = Told()
    told.say(ball_1=0.3)
    told.requests.on_ask("visitor", EDIT)
    told.answer()
    assert told.say(ball_1=0.5) == []
    assert any(OBJECTS in line for line in told.say(ball_1=0.3))
