"""Convert the selected contour to the outline of the object's top face in world, by the depth of its pixels."""

from __future__ import annotations

import asyncio
from collections import OrderedDict

from applications.outlining.contours import is_hole
from applications.outlining.top_face import TopFace, TopFaceOptions, top_face
from applications.outlining.topics import CONTOUR_POINTS, CONTOURS, MAX_POINTS, Contours, OutlinePoints
from common import topics
from common.config import Surroundings
from common.errors import ZencellError
from common.messages import Header, Image, Pose, Vector3
from common.perception.camera_input import FrameError, require_in_range
from common.perception.depth import check_depth, depth_of
from common.perception.pinhole import Pinhole
from common.process.camera_reader import CameraReader
from common.process.service import main
from common.transport.bus import Bus

WORLD = "world"
BUFFERED = 4  # depth images that wait for the contours of their image


class Config(TopFaceOptions):
    """How the top face is found."""

    world: Surroundings = Surroundings()


def outline(contours: Contours, image: Image, camera: Pinhole, config: Config) -> TopFace:
    """Return the outline of the selected object.

    Raises:
        FrameError, DepthError: there is none; one line with the reason.
    """
    depth = depth_of(image)
    check_depth(depth, contours.width, contours.height)
    chosen = contours.contours[contours.selected]
    face = top_face(chosen.pixels, depth, camera, config, hole=is_hole(contours.contours, chosen.index))
    if (count := len(face.outline)) > MAX_POINTS:
        raise FrameError("crowded", f"its {count} points are more than an outline has room for: is the picture full of "
                                  "noise?")
    require_in_range(face.outline)
    return face


async def run(bus: Bus, config: Config) -> None:
    """Publish an outline for the contours of each image, or why there is none."""
    contours, depths = bus.reader(CONTOURS), bus.reader(topics.DEPTH_CAMERA_DEPTH)
    cameras = CameraReader(bus, config.world, topics.DEPTH_CAMERA_INFO)
    out = bus.writer(CONTOUR_POINTS)
    images: OrderedDict[int, Image] = OrderedDict()
    waiting: Contours | None = None  # contours whose depth image has not arrived yet
    last_warning = ""
    await bus.ready()

    async def answer() -> None:
        nonlocal waiting, last_warning
        now = waiting
        if now is None or (now.selected >= 0 and now.header.stamp not in images):
            return
        waiting = None
        points = OutlinePoints(header=Header(stamp=now.header.stamp, frame_id=WORLD), message=now.message)
        if now.selected >= 0:
            image = images[now.header.stamp]
            label = now.contours[now.selected].label
            try:
                camera = await cameras.of(image.header)
                face = await asyncio.to_thread(outline, now, image, camera, config.model_copy())
            except ZencellError as error:
                points = points.model_copy(update={"object": label, "message": f"{label}: {error}"})
            else:
                poses = [Pose(position=Vector3(x=x, y=y, z=z)) for x, y, z in face.outline.tolist()]
                found = {"object": label, "poses": poses, "invalid_depth": face.filled}
                points = points.model_copy(update=found)
        out.put(points)
        if points.message and points.message != last_warning and points.object:
            bus.log.warning("%s", points.message)
        last_warning = points.message

    async def collect() -> None:
        async for image in depths:
            images[image.header.stamp] = image
            while len(images) > BUFFERED:
                images.popitem(last=False)
            await answer()

    async def follow() -> None:
        nonlocal waiting
        async for newest in contours:
            waiting = newest
            await answer()

    async with asyncio.TaskGroup() as group:
        group.create_task(cameras.follow())
        group.create_task(collect())
        group.create_task(follow())


if __name__ == "__main__":
    main(run, Config)
