from __future__ import annotations

from common import messages as m
from common import topics
from common.applications.outlining.topics import CONTOURS
from common.applications.pick_place.topics import VALIDATED_TARGETS
from common.config import Members, load_cell
from common.transport.local import LocalNetwork
from common.viewer.feeds import Feeds, in_cell

PANDA, UR5 = (load_cell(name).section(Members) for name in ("panda", "ur5"))


def members(application: str = "pick_place") -> Members:
    return Members(services=["trajectory_executor", "viewer"], task="", application=application)


def test_cell_has_the_topics_of_the_platform_and_of_its_application() -> None:
    assert isinstance(PANDA, Members) and isinstance(UR5, Members)
    assert in_cell(VALIDATED_TARGETS, PANDA) and not in_cell(VALIDATED_TARGETS, UR5)
    assert in_cell(CONTOURS, UR5) and not in_cell(CONTOURS, PANDA)
    for topic in (topics.LOG, topics.SUPERVISOR_STATUS, topics.COUNTERS, topics.CAMERA_IMAGE):
        assert in_cell(topic, PANDA) and in_cell(topic, UR5)


def test_application_that_is_not_known_here_may_have_anything() -> None:
    assert in_cell(CONTOURS, members("somebodys.own")) and in_cell(VALIDATED_TARGETS, members(""))


async def test_message_is_fresh_once_and_the_latest_for_long() -> None:
    net = LocalNetwork()
    feeds = Feeds(net.bus("viewer"), members())
    writer = net.bus("trajectory_executor").writer(topics.GRIPPER_STATE)
    assert feeds.latest(topics.GRIPPER_STATE) is None is feeds.fresh(topics.GRIPPER_STATE)
    writer.put(m.GripperState(width=0.01))
    first = feeds.fresh(topics.GRIPPER_STATE)
    assert first == m.GripperState(width=0.01)
    assert feeds.fresh(topics.GRIPPER_STATE) is None and feeds.latest(topics.GRIPPER_STATE) is first
    writer.put(m.GripperState(width=0.02))
    assert feeds.fresh(topics.GRIPPER_STATE) == m.GripperState(width=0.02)


async def test_topic_that_the_cell_does_not_have_is_not_asked_for() -> None:
    feeds = Feeds(LocalNetwork().bus("viewer"), members())
    assert CONTOURS not in feeds and feeds.reader(CONTOURS) is None
    feeds.listen([CONTOURS])
    assert feeds.latest(CONTOURS) is None


async def test_what_is_large_is_listened_to_while_it_is_wanted() -> None:
    net = LocalNetwork()
    feeds = Feeds(net.bus("viewer"), members())
    objects = net.bus("trajectory_executor").writer(topics.SCENE_OBJECTS)
    assert not objects.matched
    feeds.listen([topics.SCENE_OBJECTS])
    assert objects.matched
    feeds.listen([])
    assert not objects.matched
