"""Topics that the page reads, always or on demand."""

from types import SimpleNamespace

from applications.outlining.topics import CONTOURS, OUTLINE_SELECT
from applications.pick_place.topics import VALIDATED_TARGETS
from common import messages as m
from common import topics
from common.application import find_application
from common.transport.local import LocalNetwork
from page.feeds import Feeds, Topics, Updater
from page.layers import find_layers

ALWAYS, ON_DEMAND = [topics.GRIPPER_STATE], [CONTOURS, topics.SCENE_OBJECTS, topics.SCENE_OBJECT_UPDATES]


def test_page_reads_topics_of_the_platform_and_of_its_application_only() -> None:
    panda, ur5 = (Topics(app, find_layers(app).values()) for app in map(find_application, ("pick_place", "outlining")))
    assert VALIDATED_TARGETS in panda.always and CONTOURS not in panda.on_demand
    assert CONTOURS in ur5.on_demand and VALIDATED_TARGETS not in [*ur5.always, *ur5.on_demand]
    assert OUTLINE_SELECT in ur5.requests and not panda.requests
    for found in (panda, ur5, Topics(None, ())):
        assert topics.LOG in found.always and topics.CAMERA_IMAGE in found.on_demand


async def test_message_is_taken_once_and_remains_the_latest() -> None:
    net = LocalNetwork()
    feeds, writer = Feeds(net.bus("viewer"), ALWAYS, ON_DEMAND), net.bus("executor").writer(topics.GRIPPER_STATE)
    assert feeds.latest(topics.GRIPPER_STATE) is None is feeds.take(topics.GRIPPER_STATE)
    for message in (m.GripperState(width=0.01), m.GripperState(width=0.02)):
        writer.put(message)
        assert feeds.take(topics.GRIPPER_STATE) == feeds.latest(topics.GRIPPER_STATE) == message
        assert feeds.take(topics.GRIPPER_STATE) is None


async def test_on_demand_topics_are_read_while_selected_and_events_always() -> None:
    net = LocalNetwork()
    feeds, publisher = Feeds(net.bus("viewer"), ALWAYS, ON_DEMAND), net.bus("executor")
    objects, events = publisher.writer(topics.SCENE_OBJECTS), publisher.writer(topics.SCENE_OBJECT_UPDATES)
    for selected in (False, True, False):
        feeds.select([topics.SCENE_OBJECTS] if selected else [])
        assert objects.matched is selected and events.matched
    assert VALIDATED_TARGETS not in feeds and feeds.reader(VALIDATED_TARGETS) is None
    feeds.select([VALIDATED_TARGETS])
    assert feeds.latest(VALIDATED_TARGETS) is None


def test_part_of_the_page_receives_new_messages_once_per_period_but_no_events() -> None:
    messages: dict[str, m.Message] = {topics.SCENE_OBJECT_UPDATES.key: m.SceneUpdate(data="add:a")}
    shown: list[m.Message] = []
    part = SimpleNamespace(TOPICS=(topics.GRIPPER_STATE, topics.SCENE_OBJECT_UPDATES), PERIOD=0.5,
                           show=lambda _topic, message: shown.append(message))
    updater = Updater(part, lambda topic: messages.get(topic.key))
    states = [m.GripperState(width=width) for width in (0.01, 0.02, 0.03)]
    for state, now in zip(states, (1.0, 1.2, 1.6), strict=True):
        messages[topics.GRIPPER_STATE.key] = state
        updater.update(now)
        updater.update(now)
    assert shown == [states[0], states[2]]
