"""Remove redundant points from the outline; the rest is the path to trace."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import Field, ValidationError

from applications.outlining.solids import simplified, without_duplicates
from applications.outlining.stage_files import StageFileError, read_coordinates
from applications.outlining.topics import CONTOUR_PATH, CONTOUR_POINTS, OutlinePoints
from common.config import Parameters, Tunable
from common.errors import ConfigError, expected_text
from common.messages import Pose, Vector3
from common.messages.basics import MAX_NAME
from common.process.service import main
from common.terminal import printable
from common.transport.bus import Bus


class Config(Parameters):
    """Which points are redundant."""

    tolerance: Tunable[float] = Field(
        0.00005, ge=0, le=0.1, description="points without which the outline moves by no more than this go [m]; 0: none"
    )
    coordinates: str = Field(
        "", description="file with points [[x, y, z], ...] [m] that are traced instead of what is seen; `run --from`"
    )


def cleared(poses: list[Pose], tolerance: float) -> list[Pose]:
    """Return the outline without duplicates and redundant points."""
    if not poses:
        return poses
    places = np.array([(p.position.x, p.position.y, p.position.z) for p in poses])
    simplified_places = simplified(without_duplicates(places), tolerance)
    return [Pose(position=Vector3(x=x, y=y, z=z)) for x, y, z in simplified_places.tolist()]


def points_of(file: Path) -> list[Pose]:
    """Return the points in a file.

    Raises:
        ConfigError: it is missing, malformed, or too long for a path.
    """
    try:
        points = read_coordinates(file).tolist()
        return OutlinePoints(poses=[Pose(position=Vector3(x=x, y=y, z=z)) for x, y, z in points]).poses
    except StageFileError as error:
        raise ConfigError("services.duplicate_remover.coordinates", ..., str(error)) from None
    except ValidationError as error:
        problem = expected_text(error.errors(include_url=False)[0])
        raise ConfigError("services.duplicate_remover.coordinates", ..., f"{file}: {problem}") from None


async def run(bus: Bus, config: Config) -> None:
    """Publish a path for every outline, or the points of a file instead."""
    outlines = bus.reader(CONTOUR_POINTS)
    paths = bus.writer(CONTOUR_PATH)
    file = Path(config.coordinates)
    given = cleared(points_of(file), 0.0) if config.coordinates else []
    name = printable(f"{file.parent.name}/{file.name}")[-MAX_NAME:]
    await bus.ready()
    async for seen in outlines:
        if given:
            paths.put(OutlinePoints(header=seen.header, poses=given, object=name, given=True))
        else:
            paths.put(seen.model_copy(update={"poses": cleared(seen.poses, config.tolerance), "ids": [], "labels": []}))


if __name__ == "__main__":
    main(run, Config)
