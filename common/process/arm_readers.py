"""The arms of a cell on the bus, as their coordinator reads and holds them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from common import topics
from common.errors import RequestFailed, ZencellError
from common.messages import (
    ArmsStatus,
    AttachedObject,
    CollisionObject,
    ExecuteRequest,
    Header,
    HoldRequest,
    PlanningScene,
    Pose,
    ReserveRequest,
    StopRequest,
)
from common.planning.arms.arm import Observed
from common.planning.arms.coordinator import Coordinator, Decision, Retreat
from common.planning.arms.pair_world import ArmBody
from common.planning.arms.schedules import Cancel, ScheduleKeeper
from common.planning.collision import CollisionWorld
from common.planning.obstacles import ObstacleCache
from common.planning.robot_geometry import RobotGeometry
from common.planning.trajectory import timed_path, trajectory_message
from common.robot.model import RobotModel
from common.time_source import monotonic
from common.transport.bus import Bus

Array = NDArray[np.float64]

HOLDER: Literal["coordinator"] = "coordinator"
STILL = 0.005  # [rad/s] an arm whose joints are slower is at standstill
RETRY = 0.1  # [s] wall, before a hold or its release is requested again
TIMEOUT = 0.5  # [s] wall
RETREAT_SECONDS = 3.0  # [s] wall, in which an arm must accept its way back


class Scenes:
    """Newest planning scene of each arm, in which straight ways home are checked."""

    def __init__(self, robots: Mapping[str, RobotModel], padding: float) -> None:
        """Check these robots; perceived objects have `padding` [m]."""
        self.robots, self._padding = robots, padding
        self._caches = {name: ObstacleCache(RobotGeometry(robot)) for name, robot in robots.items()}
        self.newest: dict[str, PlanningScene] = {}

    def line_free(self, arm: str, start: Array, end: Array) -> bool:
        """Return whether the straight line of an arm is free of what its planning scene has; False without one."""
        scene = self.newest.get(arm)
        if scene is None:
            return False
        try:
            world = CollisionWorld(self.robots[arm], scene, start=start, padding=self._padding, cache=self._caches[arm])
            return world.edge_free(start, end)
        except ZencellError:
            return False


class ArmLink:
    """Topics and requests of one arm."""

    def __init__(self, bus: Bus, name: str) -> None:
        """Declare them."""
        self.name, own = name, bus.of_arm(name)
        self.motion, self.joints = own.reader(topics.MOTION_STATUS), own.reader(topics.JOINT_STATES)
        self.gripper, self.owner = own.reader(topics.GRIPPER_STATE), own.reader(topics.MOTION_OWNER)
        self.scene = own.reader(topics.PLANNING_SCENE)
        self._hold, self._execute = own.client(topics.MOTION_HOLD), own.client(topics.MOTION_EXECUTE)
        self._stop = own.client(topics.MOTION_STOP)
        self._clock, self._log = bus.clock, bus.log
        self._tasks: set[asyncio.Task[None]] = set()
        self._asked_at = -1e9  # monotonic time of the newest hold request [s]
        self._key: object = None

    def load(self, coordinator: Coordinator, scenes: Scenes, carried: float) -> None:
        """Report to this coordinator; `carried` is the radius of an unknown object in the gripper [m]."""
        self._coordinator, self._scenes, self._carried = coordinator, scenes, carried
        self._robot = scenes.robots[self.name]

    def ask(self, request: ReserveRequest, coordinator: Coordinator, now: float) -> Decision:
        """Return the decision about a request of this arm."""
        path, body = None, None
        if request.trajectory is not None:
            names, trajectory = self._robot.joint_names, request.trajectory
            if sorted(trajectory.joint_names) != sorted(names) or len(trajectory.points) < 2 or request.joins:
                return Decision("refused", "not_proved", "only a motion of all joints of the arm from rest is proved")
            path = timed_path(trajectory)
            order = [trajectory.joint_names.index(name) for name in names]
            path = type(path)(path.times, path.positions[:, order], path.velocities[:, order],
                              path.accelerations[:, order])
            if request.attached:
                body = self._body([*self._attached(), *request.attached])
        return coordinator.request(self.name, request.id, path, now, body, request.may_touch)

    def observe(self) -> bool:
        """Pass on the newest state; return whether there is a complete one."""
        status, state, scene = self.motion.latest, self.joints.latest, self.scene.latest
        q = None if state is None else self._robot.order(state.name, state.position)
        if status is None or state is None or q is None:
            return False
        if scene is not None:
            self._scenes.newest[self.name] = scene
        speeds = self._robot.order(state.name, state.velocity)
        owner, gripper = self.owner.latest, self.gripper.latest
        controlled = owner is not None and (owner.jogging or owner.kind in ("operator", "script"))
        self._coordinator.observe(self.name, Observed(
            status.header.stamp * 1e-9, q, status.id if status.state == "active" else "", status.path_time,
            any(holder != HOLDER for holder in status.held_by), HOLDER in status.held_by, status.speed_scaling,
            speeds is None or float(np.abs(speeds).max()) < STILL,
            not (status.stopped or status.fault or controlled), gripper is not None and gripper.moving))
        attached = self._attached()
        key = tuple(each.model_dump_json() for each in attached)
        if key != self._key:
            self._key = key
            self._coordinator.carry(self.name, self._body(attached))
        return True

    def _attached(self) -> list[AttachedObject]:
        scene, gripper = self.scene.latest, self.gripper.latest
        found = [] if scene is None else list(scene.attached)
        if not found and gripper is not None and gripper.holding and self._carried > 0:
            found.append(AttachedObject(link=self._robot.config.tcp_link, object=CollisionObject(
                id="carried", role="attached", shape="sphere", dimensions=[self._carried], pose=Pose())))
        return found

    def _body(self, attached: list[AttachedObject]) -> ArmBody:
        return self._coordinator.arms[self.name].geometry.body(attached)

    # --- requests -------------------------------------------------------------------------------------------------

    def apply(self) -> None:
        """Request the hold of a committed motion, or its release, where the arm's state differs."""
        arm = self._coordinator.arms[self.name]
        if arm.committed is None or arm.state is None or arm.state.goal != arm.committed.goal:
            return
        if bool(arm.hold) != arm.state.held and monotonic() - self._asked_at >= RETRY:
            self._asked_at = monotonic()
            self._start(self._request_hold(HoldRequest(
                hold=bool(arm.hold), reason=arm.hold, by=HOLDER, goal=arm.committed.goal)))

    async def _request_hold(self, request: HoldRequest) -> None:
        await self._hold.call(request, TIMEOUT)
        if request.hold:
            self._log.info("%s is held: %s", self.name, request.reason)

    def move_back(self, retreat: Retreat) -> None:
        """Let the arm follow its way back."""
        self._log.info("%s moves back: %s", self.name, retreat.why)
        self._start(self._move_back(retreat))

    async def _move_back(self, retreat: Retreat) -> None:
        end = monotonic() + RETREAT_SECONDS
        while monotonic() < end:
            status = await self._execute.call(ExecuteRequest(
                header=Header(stamp=self._clock.now_ns()), id=f"{retreat.goal}-{self._clock.now_ns()}",
                trajectory=trajectory_message(self._robot, retreat.path), may_touch=list(retreat.may_touch)), TIMEOUT)
            if status.state != "rejected":
                return
            problem = status.message
            await asyncio.sleep(RETRY)
        self._log.warning("%s does not move back: %s", self.name, problem)

    def cancel(self, action: Cancel) -> None:
        """End the motion of the arm."""
        self._log.warning("%s: its motion ends: %s", self.name, action.why)
        self._start(self._cancel(action))

    async def _cancel(self, action: Cancel) -> None:
        await self._stop.call(StopRequest(id=action.goal, reason=action.why, by="requester"), TIMEOUT)

    def _start(self, request: Coroutine[Any, Any, None]) -> None:
        async def ask() -> None:
            try:
                await request
            except RequestFailed as error:
                self._log.warning("%s: %s", self.name, error)

        task = asyncio.create_task(ask(), name=f"request to {self.name}")
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def close(self) -> None:
        """Stop requesting."""
        for task in self._tasks:
            task.cancel()


class CoordinatorLoop:
    """Steps of the coordinator on the bus."""

    def __init__(self, coordinator: Coordinator, links: Mapping[str, ArmLink], publish: Callable[[ArmsStatus], None],
                 header: Callable[[], Header]) -> None:
        """Publish the status at each change."""
        self._coordinator, self._links, self._publish, self._header = coordinator, links, publish, header
        self._keeper = ScheduleKeeper(coordinator)
        self._settled, self._last = False, ArmsStatus(message="not published yet")

    def step(self, now: float) -> None:
        """Observe, decide, and request what follows; cell time [s]."""
        known = [link.observe() for link in self._links.values()]
        if not all(known):
            return
        arms = self._coordinator.arms
        if not self._settled:  # motions from before the start were proved: they end first
            self._settled = all(arm.state is not None and (not arm.state.goal or arm.state.held) and arm.state.at_rest
                                for arm in arms.values())
            if not self._settled:
                return
        for action in (*self._keeper.step(now), *self._coordinator.step(now)):
            link = self._links[action.arm]
            link.move_back(action) if isinstance(action, Retreat) else link.cancel(action)
        for link in self._links.values():
            link.apply()
        self._report()

    def _report(self) -> None:
        arms = self._coordinator.arms.values()
        waiting = sorted((arm.ticket.number, f"{arm.name}: {arm.ticket.reason}") for arm in arms if arm.ticket)
        running = [arm.committed.braking for arm in arms if arm.committed]
        status = ArmsStatus(
            waiting=[text for _, text in waiting], moving=[arm.name for arm in arms if arm.committed],
            held=[arm.name for arm in arms if arm.hold], band=self._coordinator.options.delays.band(*running))
        if not status.equals_except(self._last, "header"):
            self._last = status
            self._publish(status.model_copy(update={"header": self._header()}))
