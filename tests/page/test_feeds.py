from __future__ import annotations

from typing import Any

from applications.outlining.topics import CONTOURS, OUTLINE_SELECT
from applications.pick_place.topics import VALIDATED_TARGETS
from common import messages as m
from common import topics
from common.application import find_application
from common.topics import Topic
from common.transport.local import LocalNetwork
from page.feeds import Feeds, Topics, Updater
from page.layers import find_layers

READ, ON_DEMAND = [topics.GRIPPER_STATE], [CONTOURS, topics.SCENE_OBJECTS, topics.SCENE_OBJECT_UPDATES]


def test_page_has_to_do_with_the_platform_and_one_application_and_not_with_others() -> None:
    panda, ur5 = (Topics(app, find_layers(app).values()) for app in map(find_application, ("pick_place", "outlining")))
    assert VALIDATED_TARGETS in panda.always and CONTOURS not in panda.on_demand
    assert CONTOURS in ur5.on_demand and VALIDATED_TARGETS not in [*ur5.always, *ur5.on_demand]
    assert OUTLINE_SELECT in ur5.requests and not panda.requests
    for of_cell in (panda, ur5, Topics(None, ())):
        assert topics.LOG in of_cell.always and topics.CAMERA_IMAGE in of_cell.on_demand


async def test_message_is_fresh_once_and_the_latest_for_long() -> None:
    net = LocalNetwork()
    feeds = Feeds(net.bus("viewer"), READ, ON_DEMAND)
    writer = net.bus("trajectory_executor").writer(topics.GRIPPER_STATE)
    assert feeds.latest(topics.GRIPPER_STATE) is None is feeds.fresh(topics.GRIPPER_STATE)
    writer.put(m.GripperState(width=0.01))
    first = feeds.fresh(topics.GRIPPER_STATE)
    assert first == m.GripperState(width=0.01)
    assert feeds.fresh(topics.GRIPPER_STATE) is None and feeds.latest(topics.GRIPPER_STATE) is first
    writer.put(m.GripperState(width=0.02))
    assert feeds.fresh(topics.GRIPPER_STATE) == m.GripperState(width=0.02)


async def test_topic_of_which_the_page_knows_nothing_is_not_asked_for() -> None:
    feeds = Feeds(LocalNetwork().bus("viewer"), READ, ON_DEMAND)
    assert VALIDATED_TARGETS not in feeds and feeds.reader(VALIDATED_TARGETS) is None
    feeds.listen([VALIDATED_TARGETS])
    assert feeds.latest(VALIDATED_TARGETS) is None


async def test_what_is_large_is_listened_to_while_it_is_wanted() -> None:
    net = LocalNetwork()
    feeds = Feeds(net.bus("viewer"), READ, ON_DEMAND)
    objects = net.bus("trajectory_executor").writer(topics.SCENE_OBJECTS)
    assert not objects.matched
    feeds.listen([topics.SCENE_OBJECTS])
    assert objects.matched
    feeds.listen([])
    assert not objects.matched


async def test_event_is_listened_to_also_while_nobody_looks() -> None:
    net = LocalNetwork()
    feeds = Feeds(net.bus("viewer"), READ, ON_DEMAND)
    updates = net.bus("trajectory_executor").writer(topics.SCENE_OBJECT_UPDATES)
    feeds.listen([])
    assert updates.matched


def test_part_is_told_what_is_new_once_and_no_more_often_than_it_wants() -> None:
    said: dict[str, m.Message] = {}
    told: list[tuple[str, m.Message]] = []

    class Part:
        TOPICS = (topics.GRIPPER_STATE, topics.SCENE_OBJECT_UPDATES)
        PERIOD = 0.5

        def show(self, topic: Topic[Any], message: Any) -> None:
            told.append((topic.key, message))

    news = Updater(Part(), lambda topic: said.get(topic.key))  # type: ignore[arg-type, return-value]
    said["scene_object_updates"] = m.SceneUpdate(data="add:a")  # an event: told when it comes, by others
    news.tell(1.0)
    assert told == []
    states = [m.GripperState(width=width) for width in (0.01, 0.02, 0.03)]
    for state, now in zip(states, (1.0, 1.2, 1.6), strict=True):
        said["gripper/state"] = state
        news.tell(now)
        news.tell(now)
    assert told == [("gripper/state", states[0]), ("gripper/state", states[2])]
