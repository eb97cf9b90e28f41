"""Offers the detections that the arm can take to the task, and says why it does not offer the others."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress

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
from common.config import Grasp, RobotConfig, Surroundings, Tunable
from common.messages import Color, Header, Marker, MarkerArray, Pose, PoseArray, Rejections, Vector3
from common.messages.basics import MAX_POSES
from common.process.service import main
from common.robot.model import RobotModel
from common.scene.workspace import ReachCache, WorkspaceBounds
from common.transport.bus import Bus

WORLD = "world"
PATIENCE = 0.008  # wall time for which a frame with new places waits for their inverse kinematics [s]


class Config(ViewsParameters, WorkspaceBounds):
    """Bounds of the workspace."""

    world: Surroundings
    robot: RobotConfig
    grasp: Grasp
    may_hide: Tunable[float] = Field(
        MOST_HIDDEN, ge=0, le=1, description="part of the table within reach that may be hidden while it counts as seen"
    )
    forget_after: Tunable[float] = Field(
        2.0, ge=0, le=3600, description="a rejection is told again once its place was empty for so long [s, cell time]"
    )


class OcclusionReport:
    """Says what the newest pictures do not show of where things may lie."""

    def __init__(self, around: Surroundings, bounds: WorkspaceBounds) -> None:
        """Begin; the table is divided up when something is hidden for the first time."""
        self._around, self._bounds = around, bounds
        self._region: VisibleTable | None = None

    def unseen(self, seen: list[CameraDetections], views: DetectionViews, most: float) -> tuple[str, bool]:
        """In words, empty where at most that share of the table is hidden; and whether nothing is seen at all.

        Of several views all are needed: what only one of them sees is not known without it.
        """
        if missing := views.missing():
            return f"no picture comes from {' and '.join(missing)}", False
        hiding = [one.hidden for one in seen if one.hidden is not None]
        if not hiding:
            return "", False
        if len(hiding) == len(seen) and all(hidden.everything for hidden in hiding):
            return hiding[0].by, True
        self._region = self._region or VisibleTable(self._around, self._bounds)
        robot, silhouettes = views.robot
        share = self._region.hidden((self._region.within(one.camera, silhouettes, robot), one.hidden) for one in seen)
        by = " and ".join(dict.fromkeys(hidden.by for hidden in hiding))
        return (f"{by} hides {100 * share:.0f} % of the table within reach" if share > most else ""), False


def hiding(seen: list[CameraDetections], radius: float) -> Callable[[tuple[float, float, float]], bool] | None:
    """Whether a place is hidden in all views, for what is as large as that [m]; None where any shows everything."""
    hidden = [one.hidden for one in seen if one.hidden is not None]
    if len(hidden) < len(seen) or not hidden:
        return None
    return lambda place: all(bool(one.occludes([place], radius)[0]) for one in hidden)


def shells(config: Config, header: Header) -> MarkerArray:
    """The reachable shell, and the column about the base axis that is left out of it."""
    height = config.max_height - config.min_height
    inner = max(config.min_radius, config.singularity_radius)
    cylinders = (("reachable shell", config.max_radius, (0.2, 0.8, 0.3)), ("excluded column", inner, (0.9, 0.2, 0.2)))
    pose = Pose(position=Vector3(z=(config.max_height + config.min_height) / 2))
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


async def run(bus: Bus, config: Config) -> None:
    """Judge every frame with what is known; the inverse kinematics of new places is worked out beside that."""
    views = DetectionViews(bus, config.views, config.world, config.robot, bus.log)
    validated, rejected = bus.writer(VALIDATED_TARGETS), bus.writer(REJECTED_TARGETS)
    markers = bus.writer(WORKSPACE_MARKERS)
    reach = ReachCache(RobotModel.load(config.robot), config.grasp, config)
    validation = Validation(config.world, reach, forget_after=config.forget_after)

    watched, remembered, radius = OcclusionReport(config.world, config), OccludedTargets(), config.world.ball_radius

    def show() -> None:
        markers.put(shells(config, bus.header(WORLD)))

    show()
    bus.on_parameters(show)
    places: list[tuple[float, float, float]] = []
    work, idle = asyncio.Event(), asyncio.Event()
    unfinished: list[CameraDetections] = []  # sent without the places that were still worked on
    await bus.ready()

    def send(seen: list[CameraDetections]) -> None:
        nonlocal unfinished
        validation.forget_after = config.forget_after
        verdict = validation.validate_views([(one.frame, one.camera) for one in seen])
        unfinished = seen if verdict.unknown else []
        header = Header(stamp=min(one.frame.header.stamp for one in seen), frame_id=WORLD)
        kept = remembered.hidden(verdict.targets, [place for place, _ in verdict.refused], hiding(seen, radius))
        # Of several crowded views not all can be told of: what is left out is nobody's target for now.
        verdict.targets, kept = verdict.targets[:MAX_POSES], kept[: max(0, MAX_POSES - len(verdict.targets))]
        poses = [Pose(position=Vector3(x=x, y=y, z=z)) for x, y, z in [*verdict.targets, *kept]]
        labels = [*("" for _ in verdict.targets), *(HIDDEN for _ in kept)] if kept else []
        unseen, blind = watched.unseen(seen, views, config.may_hide)
        validated.put(PoseArray(header=header, poses=poses, labels=labels, remark=verdict.remark, unseen=unseen,
                                blind=blind))
        if verdict.rejections:
            rejected.put(Rejections(header=header, rejected=verdict.rejections))
        for one in verdict.rejections:
            bus.log.info("rejected (%s, %s): %s", f"{one.position.x:z.3f}", f"{one.position.y:z.3f}", one.reason)

    async def look(_view: int, _seen: CameraDetections) -> None:
        seen = views.newest()
        places[:] = [place for one in seen for place in validation.unknown(one.frame, one.camera)]
        if places:
            idle.clear()
            work.set()
            with suppress(TimeoutError):  # what is not known by then goes out with a later frame
                async with asyncio.timeout(PATIENCE):  # wait_for of Python 3.11 can lose a cancellation
                    await idle.wait()
        send(seen)

    async def work_out() -> None:
        while True:
            await work.wait()
            work.clear()
            while places:
                await asyncio.to_thread(reach.reason, places.pop(0))
            idle.set()
            if unfinished:
                send(unfinished)

    async with asyncio.TaskGroup() as group:
        group.create_task(views.watch(look))
        group.create_task(work_out())


if __name__ == "__main__":
    main(run, Config)
