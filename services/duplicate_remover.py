"""Clears the outline of points that add nothing: what is left is the path to trace."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from common import topics
from common.config import Parameters
from common.messages import OutlinePoints, Pose, Vector3
from common.perception.duplicates import simplified, without_duplicates
from common.transport.bus import Bus
from common.transport.service import main


class Config(Parameters):
    """What counts as nothing."""

    tolerance: float = Field(
        0.00005, ge=0, le=0.1, description="points without which the outline moves by no more than this go [m]; 0: none"
    )


def cleared(points: OutlinePoints, tolerance: float) -> OutlinePoints:
    """The same outline without duplicates and without points that are not needed."""
    if not points.poses:
        return points
    places = np.array([(p.position.x, p.position.y, p.position.z) for p in points.poses])
    kept = simplified(without_duplicates(places), tolerance)
    poses = [Pose(position=Vector3(x=x, y=y, z=z)) for x, y, z in kept.tolist()]
    return points.model_copy(update={"poses": poses, "ids": [], "labels": []})


async def run(bus: Bus, config: Config) -> None:
    """Clear every outline as it comes."""
    outlines = bus.reader(topics.CONTOUR_POINTS)
    paths = bus.writer(topics.CONTOUR_PATH)
    await bus.ready()
    async for points in outlines:
        paths.put(cleared(points, config.tolerance))


if __name__ == "__main__":
    main(run, Config)
