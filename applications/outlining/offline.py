"""Compute the stages of outlining without a cell: from image and depth to planned motions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from applications.outlining.contour_choice import NoSuchContour, choose
from applications.outlining.contours import ContourOptions, find_contours, is_hole
from applications.outlining.solids import PerceivedSolid, perceived_solids, simplified, without_duplicates
from applications.outlining.task import MotionSegments, OutlineView, closed
from applications.outlining.top_face import TopFaceOptions, top_face
from applications.outlining.topics import Contour, OutlinePoints, OutlineSelect
from common import messages as m
from common.errors import ZencellError
from common.perception.depth import Depth, check_depth
from common.perception.pinhole import Pinhole
from common.planning.pipeline import PlanningPipeline
from common.tasks.stages import Cycle, Move

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]


class OutlineError(ZencellError):
    """The outline cannot be found or traced; ends a command with exit code 1."""

    exit_code = 1


@dataclass(frozen=True, eq=False)
class Perceived:
    """Results of perception: the selected contour (n, 2) [px], and points (n, 3) [m] in world."""

    label: str
    contours: list[Contour]
    pixels: Array
    coordinates: Array
    cleared: Array
    solids: list[PerceivedSolid]


def perceive(
    picture: Picture, depth: Depth, camera: Pinhole, wanted: OutlineSelect,
    contour_options: ContourOptions, face_options: TopFaceOptions, tolerance: float,
) -> Perceived:
    """Find contours, the selected one, its points in world, and those without duplicates.

    Args:
        picture: bgr8 (height, width, 3).
        depth: (height, width) [m].
        camera: that took both.
        wanted: which contour.
        contour_options: parameters of the first stage.
        face_options: parameters of the second stage.
        tolerance: of the third stage [m].

    Raises:
        OutlineError: no contour fits the request.
        DepthError: the depth does not show where the object is.
    """
    check_depth(depth, picture.shape[1], picture.shape[0])
    contours = find_contours(picture, contour_options)
    try:
        chosen = choose(contours, wanted)
    except NoSuchContour as error:
        raise OutlineError(str(error)) from None
    hole = is_hole(contours, chosen.index)
    face = top_face(chosen.pixels, depth, camera, face_options, hole=hole)
    cleared = simplified(without_duplicates(face.outline), tolerance)
    return Perceived(
        chosen.label, contours, np.array(chosen.pixels), face.outline, cleared,
        perceived_solids(contours, depth, camera),
    )


def plan_outline(
    pipeline: PlanningPipeline, legs: MotionSegments, points: Array, label: str, scene: m.PlanningScene, *, given: bool
) -> list[tuple[Move, m.PlanResponse]]:
    """Plan all motions that trace points (n, 3) [m], from home to home, each from the end of the one before.

    Args:
        pipeline: planning pipeline.
        legs: creates the motions.
        points: of the outline, not closed.
        label: of the object.
        scene: planning scene.
        given: the points need not surround an object of the scene.

    Raises:
        OutlineError: a motion has no plan; gives the reason.
    """
    poses = [m.Pose(position=m.Vector3(x=x, y=y, z=z)) for x, y, z in points.tolist()]
    path = OutlinePoints(header=scene.header, poses=poses, object=label, given=given)
    solid = OutlineView(now=0.0, path=path, scene=scene).solid()
    if solid is None:
        raise OutlineError(f"{label}: nothing in the planning scene lies within the outline")
    end: Sequence[float] = pipeline.robot.named("home").tolist()
    planned = []
    for leg in legs.outline(closed(path), solid, Cycle(label)):
        response = pipeline.plan(m.PlanRequest(
            id=leg.name, stage=leg.name, start=list(end), goal=leg.goal, straight=leg.straight,
            allowed_collisions=leg.touches,
        ), scene)
        if not response.ok:
            raise OutlineError(f"{label}: {response.message}")
        leg.trajectory = response.trajectory
        end = leg.end()
        planned.append((leg, response))
    return planned
