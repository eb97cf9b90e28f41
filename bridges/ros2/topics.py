"""The topics of a cell as topics of ROS 2; a stream is read only while there is a subscription."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable
from typing import Any

from bridges.cell_topics import Pumps, drain
from bridges.ros2 import keys
from bridges.ros2.convert import calibration, conversion_of
from bridges.ros2.graph import Graph, Publisher
from common import topics as t
from common.messages import CameraInfo, Header, Image, PointCloud2
from common.topics import Topic, general_key
from common.transport.bus import Bus
from common.transport.ownership import Owner
from common.transport.reader import Reader
from common.transport.session import owns_key

LARGE = (Image, PointCloud2)  # converted and sent in a thread
# Topics with a name of their own in ROS, whatever the cell is called.
GLOBAL = {t.TF.key: "/tf", t.TF_STATIC.key: "/tf_static", t.SUPERVISOR_STATUS.key: "/diagnostics"}
INFO = "camera_info"


def name_of(namespace: str, key: str) -> str:
    """Return the name of a topic in ROS, such as /cell/joint_states."""
    return GLOBAL.get(key) or f"{namespace}/{keys.ros_name(key)}"


class Topics:
    """Publishers of the topics that a service of the cell writes; they appear with their writers and stay."""

    def __init__(self, bus: Bus, topics: Iterable[Topic[Any]], rate: Callable[[], float]) -> None:
        """Declare a reader for each topic that has a type in ROS, without reading anything.

        Args:
            bus: of the bridge, on the running loop.
            topics: that may be published.
            rate: returns the maximum rate of a stream, wall time [Hz].
        """
        self._bus, self._rate = bus, rate
        self._loop = asyncio.get_running_loop()
        self._readers: dict[str, Reader[Any]] = {
            topic.key: bus.reader(topic, listening=False) for topic in topics
            if not topic.signed and conversion_of(topic.message) is not None}
        self._publishers: dict[str, Publisher] = {}
        self._pumps = Pumps(bus, "ros2")

    def watch(self, graph: Graph) -> None:
        """Publish each topic that has a writer, now and later, by a node."""
        self._graph = graph

        def on_owner(token: str) -> None:  # on a network thread
            self._loop.call_soon_threadsafe(self._found, general_key(Owner.of(token).key))

        self._bus.raw_watch_tokens(owns_key(self._bus.cell), on_owner)
        self._found(t.SUPERVISOR_STATUS.key)  # each host's supervisor writes it, so no process owns it

    def close(self) -> None:
        """Stop reading."""
        self._pumps.close()

    def _found(self, key: str) -> None:
        reader = self._readers.get(key)
        if reader is None or key in self._publishers:
            return
        conversion = conversion_of(reader.topic.message)
        assert conversion is not None
        is_state = reader.topic.kind == "state" and not issubclass(reader.topic.message, CameraInfo)
        qos = keys.LATCHED if is_state else keys.STREAM
        publisher = self._graph.publisher(name_of(self._graph.node.namespace, key), conversion[0], qos)
        self._publishers[key] = publisher
        if reader.topic.kind == "state":
            self._bus.listen(reader, True)
            if is_state:
                self._pumps.start(key, self._pump(reader, publisher, conversion[1]))
            return

        def on_change(matched: bool) -> None:  # on a network thread
            self._loop.call_soon_threadsafe(self._matched, key, matched)

        publisher.watch(on_change)
        self._matched(key, publisher.matched)
        info = f"{key.partition('/')[0]}/{INFO}"
        if issubclass(reader.topic.message, Image) and info in self._readers:
            self._found(info)
            self._publishers[info].watch(on_change)

    def _matched(self, key: str, _: bool) -> None:
        """Read a stream while its publisher, or that of its calibration, has a subscription."""
        reader, publisher = self._readers[key], self._publishers[key]
        info = self._publishers.get(f"{key.partition('/')[0]}/{INFO}") if self._is_image(key) else None
        wanted = publisher.matched or (info is not None and info.matched)
        if wanted and key not in self._pumps:
            conversion = conversion_of(reader.topic.message)
            assert conversion is not None
            self._bus.listen(reader, True)
            self._pumps.start(key, self._pump(reader, publisher, conversion[1]))
        elif not wanted and self._pumps.stop(key):
            self._bus.listen(reader, False)

    def _is_image(self, key: str) -> bool:
        return issubclass(self._readers[key].topic.message, Image)

    async def _pump(self, reader: Reader[Any], publisher: Publisher, convert: Callable[[Any], Any]) -> None:
        await drain(reader)
        while True:
            message = await reader.next()
            try:
                if isinstance(message, LARGE):
                    await asyncio.to_thread(lambda found: publisher.put(convert(found)), message)
                    self._publish_calibration(reader.topic.key, message.header)
                else:
                    publisher.put(convert(message))
            except (ValueError, ArithmeticError) as error:  # a message that ROS cannot represent
                self._pumps.report(reader.topic.key, str(error))
            if reader.topic.kind == "stream":
                await asyncio.sleep(1 / self._rate())

    def _publish_calibration(self, key: str, header: Header) -> None:
        """Publish a camera's calibration with the stamp of each image, as subscribers of both expect."""
        info = f"{key.partition('/')[0]}/{INFO}"
        publisher, reader = self._publishers.get(info), self._readers.get(info)
        if self._is_image(key) and publisher is not None and reader is not None and reader.latest is not None:
            publisher.put(calibration(reader.latest.model_copy(update={"header": header})))
