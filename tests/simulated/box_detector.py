"""A detector for a test: finds blue boxes of one size in the picture and says how they are turned."""

from __future__ import annotations

import math

import cv2
import numpy as np

from applications.pick_place.topics import DETECTED_OBJECTS
from common import topics
from common.config import Parameters, Surroundings
from common.messages import Color, Header, Marker, MarkerArray, Pose, Quaternion, Vector3
from common.perception.image import image_to_array
from common.perception.pinhole import Pinhole
from common.transport.bus import Bus

SIZE = (0.05, 0.03, 0.03)  # [m]


class Config(Parameters):
    """Where the camera is."""

    world: Surroundings


def boxes(picture: np.ndarray, camera: Pinhole) -> list[Marker]:
    """A marker for each blue patch: a box whose middle is seen in the middle of the patch."""
    hsv = cv2.cvtColor(picture, cv2.COLOR_BGR2HSV)
    mask = cv2.inRange(hsv, np.array((100, 150, 80)), np.array((130, 255, 255)))
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    found = []
    for contour in contours:
        if cv2.contourArea(contour) < 200:
            continue
        corners = camera.on_plane(cv2.boxPoints(cv2.minAreaRect(contour)).astype(float), SIZE[2])
        sides = corners[1] - corners[0], corners[2] - corners[1]
        long = max(sides, key=lambda side: float(np.hypot(*side)))
        yaw = math.atan2(long[1], long[0])
        moments = cv2.moments(contour)
        u, v = moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]
        x, y = camera.on_plane(np.array([(u, v)]), SIZE[2] / 2)[0]
        found.append(Marker(
            ns="box", id=len(found), type="box", scale=Vector3(x=SIZE[0], y=SIZE[1], z=SIZE[2]),
            pose=Pose(position=Vector3(x=float(x), y=float(y), z=SIZE[2] / 2),
                      orientation=Quaternion(z=math.sin(yaw / 2), w=math.cos(yaw / 2))),
            color=Color(r=0.1, g=0.2, b=1.0), pixel=(u, v),
        ))
    return found


async def run(bus: Bus, config: Config) -> None:
    """Look at every picture."""
    images, found = bus.reader(topics.CAMERA_IMAGE), bus.writer(DETECTED_OBJECTS)
    camera = Pinhole.from_config(config.world.camera)
    await bus.ready()
    async for image in images:
        header = Header(stamp=image.header.stamp, frame_id="world")
        found.put(MarkerArray(header=header, markers=boxes(image_to_array(image), camera)))
