"""Offer the detections within reach to the task, and report why others are rejected."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from pydantic import Field

from applications.pick_place.ball_places import MOST_HIDDEN, VisibleTable
from applications.pick_place.detections import (
    HIDDEN,
    CameraDetections,
    DetectionViews,
    OccludedTargets,
    Validation,
    ViewsParameters,
)
from applications.pick_place.topics import (
    REJECTED_TARGETS,
    VALIDATED_TARGETS,
    WORKSPACE_MARKERS,
)
from applications.pick_place.tracks import Place
from common.config import Arms, Grasp, RobotConfig, Surroundings, Tunable
from common.messages import Color, Header, Marker, MarkerArray, Pose, PoseArray, Rejections, Vector3
from common.messages.basics import MAX_POSES
from common.process.service import main
from common.robot.model import RobotModel
from common.scene.workspace import ReachCache, WorkspaceBounds
from common.transport.bus import Bus

WORLD = "world"
IK_WAIT = 0.008  # [s, wall time] for which a frame waits for the inverse kinematics of new positions


class Config(ViewsParameters, WorkspaceBounds):
    """Bounds of the workspace."""

    world: Surroundings
    robot: RobotConfig
    arms: Arms = Arms()
    grasp: Grasp
    may_hide: Tunable[float] = Field(
        MOST_HIDDEN, ge=0, le=1, description="part of the table within reach that may be hidden while it counts as seen"
    )
    forget_after: Tunable[float] = Field(
        2.0, ge=0, le=3600, description="time unseen after which a rejection is reported again [s, cell time]"
    )


class OcclusionReport:
    """Reports which part of the table the newest images do not show."""

    def __init__(self, around: Surroundings, bounds: WorkspaceBounds, base: Sequence[float]) -> None:
        """Start; the grid of the table about a base [m] is created on the first occlusion."""
        self._around, self._bounds, self._base = around, bounds, base
        self._region: VisibleTable | None = None

    def unseen(self, seen: list[CameraDetections], views: DetectionViews, most: float) -> tuple[str, bool]:
        """Return a description, empty while at most this fraction is occluded, and whether nothing is visible at all.

        All views are needed: what only one of them sees is unknown without it.
        """
        if missing := views.missing():
            return f"no image received from {' and '.join(missing)}", False
        hiding = [one.hidden for one in seen if one.hidden is not None]
        if not hiding:
            return "", False
        if len(hiding) == len(seen) and all(hidden.covers_image for hidden in hiding):
            return hiding[0].by, True
        self._region = self._region or VisibleTable(self._around, self._bounds, self._base)
        robot, silhouettes = views.robot
        share = self._region.hidden((self._region.within(one.camera, silhouettes, robot), one.hidden) for one in seen)
        by = " and ".join(dict.fromkeys(hidden.by for hidden in hiding))
        return (f"{by} hides {100 * share:.0f} % of the table within reach" if share > most else ""), False


def hiding(seen: list[CameraDetections], radius: float) -> Callable[[tuple[float, float, float]], bool] | None:
    """Return whether a position is occluded in all views, for an object of this radius [m]; None: nothing is."""
    hidden = [one.hidden for one in seen if one.hidden is not None]
    if len(hidden) < len(seen) or not hidden:
        return None
    return lambda place: all(bool(one.occludes([place], radius)[0]) for one in hidden)


def shells(config: Config, header: Header) -> MarkerArray:
    """Return the reachable shell, and the excluded column around the base axis."""
    height = config.max_height - config.min_height
    inner = max(config.min_radius, config.singularity_radius)
    cylinders = (("reachable shell", config.max_radius, (0.2, 0.8, 0.3)), ("excluded column", inner, (0.9, 0.2, 0.2)))
    x, y, _ = config.robot.base_position
    pose = Pose(position=Vector3(x=x, y=y, z=(config.max_height + config.min_height) / 2))
    return MarkerArray(
        header=header,
        markers=[
            Marker(
                ns="workspace", id=index, type="cylinder", pose=pose, text=text,
                scale=Vector3(x=2 * radius, y=2 * radius, z=height), color=Color(r=r, g=g, b=b, a=0.15),
            )
            for index, (text, radius, (r, g, b)) in enumerate(cylinders)
        ],
    )


def targets(visible: list[Place], occluded: list[Place], **fields: Any) -> PoseArray:
    """Return targets as a message with these other fields; labels only if some targets are occluded.

    Targets of several crowded views may not fit into a message: the rest is offered later.
    """
    visible = visible[:MAX_POSES]
    occluded = occluded[: MAX_POSES - len(visible)]
    poses = [Pose(position=Vector3(x=x, y=y, z=z)) for x, y, z in [*visible, *occluded]]
    labels = [*("" for _ in visible), *(HIDDEN for _ in occluded)] if occluded else []
    return PoseArray(poses=poses, labels=labels, **fields)


async def run(bus: Bus, config: Config) -> None:
    """Validate every frame with the known reachability; compute that of new positions concurrently."""
    views = DetectionViews(bus, config.views, config.world, config.robot, config.arms, bus.log)
    validated, rejected = bus.writer(VALIDATED_TARGETS), bus.writer(REJECTED_TARGETS)
    markers = bus.writer(WORKSPACE_MARKERS)
    reach = ReachCache(RobotModel.load(config.robot), config.grasp, config)
    validation = Validation(config.world, reach, forget_after=config.forget_after)

    watched = OcclusionReport(config.world, config, config.robot.base_position)
    remembered, radius = OccludedTargets(), config.world.ball_radius

    def publish_shells() -> None:
        markers.put(shells(config, bus.header(WORLD)))

    publish_shells()
    bus.on_parameters(publish_shells)
    places: list[tuple[float, float, float]] = []
    work, idle = asyncio.Event(), asyncio.Event()
    unfinished: list[CameraDetections] = []  # sent without the positions that were still being computed
    await bus.ready()

    def publish(seen: list[CameraDetections]) -> None:
        nonlocal unfinished
        validation.forget_after = config.forget_after
        result = validation.validate_views([(one.frame, one.camera) for one in seen])
        unfinished = seen if result.unknown else []
        header = Header(stamp=min(one.frame.header.stamp for one in seen), frame_id=WORLD)
        occluded = remembered.hidden(result.targets, [place for place, _ in result.refused], hiding(seen, radius))
        unseen, blind = watched.unseen(seen, views, config.may_hide)
        validated.put(targets(
            result.targets, occluded, header=header, remark=result.remark, unseen=unseen, blind=blind))
        if result.rejections:
            rejected.put(Rejections(header=header, rejected=result.rejections))
        for one in result.rejections:
            bus.log.info("rejected (%s, %s): %s", f"{one.position.x:z.3f}", f"{one.position.y:z.3f}", one.reason)

    async def validate(_view: int, _seen: CameraDetections) -> None:
        seen = views.newest()
        places[:] = [place for one in seen for place in validation.unknown(one.frame, one.camera)]
        if places:
            idle.clear()
            work.set()
            with suppress(TimeoutError):  # the rest goes out with a later frame
                async with asyncio.timeout(IK_WAIT):  # wait_for of Python 3.11 can lose a cancellation
                    await idle.wait()
        publish(seen)

    async def compute_reach() -> None:
        while True:
            await work.wait()
            work.clear()
            while places:
                await asyncio.to_thread(reach.reason, places.pop(0))
            idle.set()
            if unfinished:
                publish(unfinished)

    async with asyncio.TaskGroup() as group:
        group.create_task(views.watch(validate))
        group.create_task(compute_reach())


if __name__ == "__main__":
    main(run, Config)
