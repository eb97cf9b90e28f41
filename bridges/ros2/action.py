"""FollowJointTrajectory as a server: the services and topics of an action, and its goals as motions of the executor.

Names and types of an action on rmw_zenoh are those of rcl_action: docs/ros2.md. A goal of ROS is one goal of the cell:
interlocks, motion authority, limits and the running check against the scene are those of every motion.
"""

from __future__ import annotations

import asyncio
from collections import OrderedDict, deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from bridges.ros2 import convert, keys
from bridges.ros2.controls import OWNER
from bridges.ros2.feedback import Feedback
from bridges.ros2.graph import Graph
from bridges.ros2.keys import Qos
from bridges.ros2.scene_check import SceneCheck
from bridges.ros2.trajectories import SUCCESSFUL, Tolerances, code_of, trajectory_of
from bridges.ros2.types import CANCEL, FOLLOW, make
from common import messages as m
from common import topics
from common.client.operator_motion import OperatorMotion
from common.client.subscriptions import Subscriptions
from common.errors import Refused, RequestFailed, ZencellError
from common.topics import Topic
from common.transport.bus import Bus

NAME = "follow_joint_trajectory"
WATCH_PERIOD = 0.05  # [s] wall; feedback follows the reports of the executor, every 0.1 s of cell time
REQUEST_TIMEOUT = 2.0  # [s] wall
REMEMBERED_STATES = 50  # half a second of them
REMEMBERED = 100  # goals that are over and whose result can be read
LOST_AFTER = 3.0  # [s] wall without the executor, which survives a restart of the router
GONE = "trajectory_executor does not answer any more"
# action_msgs/msg/GoalStatus
UNKNOWN, EXECUTING, CANCELING, SUCCEEDED, CANCELED, ABORTED = 0, 2, 3, 4, 5, 6
# action_msgs/srv/CancelGoal
NONE, REJECTED, UNKNOWN_GOAL, TERMINATED = 0, 1, 2, 3
RESULT = f"{FOLLOW}_Result"
ROSOUT_WARN = 30  # rcl_interfaces/msg/Log
LOG = "rcl_interfaces/msg/Log"


@dataclass
class Goal:
    """One goal: pending while its status is UNKNOWN and `ended` is not set."""

    uuid: bytes
    stamp: int  # when it was accepted, cell time [ns]
    acknowledged: int = 0  # `since` of the newest interlock when it arrived
    tolerances: Tolerances = field(default_factory=lambda: Tolerances({}, {}))
    status: int = UNKNOWN
    error: str = ""  # code of the cell
    message: str = ""
    cancelled: bool = False  # by a client of ROS
    ended: asyncio.Event = field(default_factory=asyncio.Event)

    @property
    def id(self) -> str:
        """Id of the motion in the cell: a goal that is sent again never moves the arm twice."""
        return f"ros2-{self.uuid.hex()}"

    @property
    def result(self) -> Any:
        """The result of its action."""
        succeeded = self.status == SUCCEEDED
        return make(RESULT, error_code=SUCCESSFUL if succeeded else code_of(self.error or "unknown"),
                    error_string=self.message)


class TrajectoryAction:
    """Serves NAMESPACE/follow_joint_trajectory: create it, `serve`, then `run`."""

    _check: SceneCheck  # set by `serve`, as the publishers
    _feedback: Feedback

    def __init__(self, bus: Bus, tasks: Sequence[Topic[Any]]) -> None:
        """Declare the readers and requests; `tasks` are statuses of the cell's task, which may have the arm."""
        self._bus = bus
        self._subscriptions = Subscriptions(bus)
        self._motion = OperatorMotion(bus, [bus.reader(task) for task in tasks], owner=OWNER)
        self._execute, self._stop = bus.client(topics.MOTION_EXECUTE), bus.client(topics.MOTION_STOP)
        self._status, self._joints = bus.reader(topics.MOTION_STATUS), bus.reader(topics.JOINT_STATES)
        self._subscriptions.reader(topics.PLANNING_SCENE)
        self._states: deque[m.JointState] = deque(maxlen=REMEMBERED_STATES)
        self._watched: m.MotionStatus | None = None  # newest status with feedback
        self._answered = asyncio.get_running_loop().time()  # when the executor was last there
        self._goals: OrderedDict[bytes, Goal] = OrderedDict()
        self._requests = asyncio.Lock()  # goals are accepted one after the other, and not during the scene check

    def serve(self, graph: Graph, check: SceneCheck) -> None:
        """Offer the services and topics."""
        self._check, name = check, f"{graph.node.namespace}/{NAME}"
        graph.service(f"{name}/_action/send_goal", f"{FOLLOW}_SendGoal", self._send_goal)
        graph.service(f"{name}/_action/cancel_goal", CANCEL, self._cancel_goal)
        graph.service(f"{name}/_action/get_result", f"{FOLLOW}_GetResult", self._get_result)
        self._feedback = Feedback(graph, f"{name}/_action/feedback")
        self._statuses = graph.publisher(
            f"{name}/_action/status", "action_msgs/msg/GoalStatusArray", keys.LATCHED)
        self._rosout = graph.publisher("/rosout", LOG, Qos(depth=1000))
        self._publish_statuses()

    async def run(self) -> None:
        """Follow the states of goals and publish feedback until cancelled; then stop a goal that still runs."""
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self._follow_status())
                group.create_task(self._remember_joints())
                while True:
                    await asyncio.sleep(WATCH_PERIOD)
                    await self._watch()
        finally:
            for goal in self._running():
                await self._stop_goal(goal, "the bridge to ROS 2 ends")

    # --- goals ----------------------------------------------------------------------------------------------------

    async def _send_goal(self, request: Any) -> Any:
        known = self._status.latest  # of stops: later ones, also by clients of ROS, void the goal
        goal = Goal(bytes(request.goal_id.uuid), self._bus.clock.now_ns(), known.newest if known else 0)
        if goal.uuid in self._goals:
            self._warn(f"goal {goal.id} is known already")
            return self._accepted(goal, False)
        self._goals[goal.uuid] = goal
        try:
            async with self._requests:
                await self._start(goal, request.goal)
        except ZencellError as error:
            goal.error, goal.message = getattr(error, "code", "failed"), str(error)
            goal.ended.set()
            self._warn(f"goal {goal.id} is rejected: {error}")
            self._forget()
            return self._accepted(goal, False)
        return self._accepted(goal, True)

    async def _start(self, goal: Goal, given: Any) -> None:
        """Check a goal and start its motion.

        Raises:
            ZencellError: why not.
        """
        goal.tolerances = Tolerances.of(given)
        await self._motion.release_holds(goal.acknowledged)
        measured = await self._measured()
        trajectory = await asyncio.to_thread(trajectory_of, given, measured, self._bus.clock.now_ns())
        scene = await self._subscriptions.latest(topics.PLANNING_SCENE)
        await asyncio.to_thread(self._check.require_free, trajectory, scene, list(measured.values()))
        request = m.ExecuteRequest(
            header=self._bus.header(), id=goal.id, trajectory=trajectory, owner=OWNER,
            acknowledged=goal.acknowledged, scene_stamp=scene.header.stamp)
        try:
            answer = await self._execute.call(request, REQUEST_TIMEOUT)
        except (RequestFailed, asyncio.CancelledError):  # it may have started
            await self._stop_goal(goal, "its requester got no answer")
            raise
        if answer.state == "rejected":
            raise Refused(answer.error, answer.message)
        goal.stamp, goal.status = answer.header.stamp or goal.stamp, EXECUTING
        self._feedback.start(goal.uuid, self._check.robot.joint_names, self._check.as_followed(trajectory))
        self._bus.log.info("goal %s of a client of ROS 2 is followed, for %.1f s", goal.id,
                           trajectory.points[-1].time_from_start)
        self._publish_statuses()
        self._update(goal, answer)

    async def _measured(self) -> dict[str, float]:
        """Return the positions of the robot's joints, in its order [rad or m].

        Raises:
            Refused: they are not known.
        """
        state = await self._subscriptions.next(topics.JOINT_STATES)
        positions = dict(zip(state.name, state.position, strict=True))
        names = self._check.robot.joint_names
        if missing := [name for name in names if name not in positions]:
            raise Refused("no_state", f"no position of {', '.join(missing)} is known")
        return {name: positions[name] for name in names}

    async def _get_result(self, request: Any) -> Any:
        goal = self._goals.get(bytes(request.goal_id.uuid))
        if goal is None:
            return make(f"{FOLLOW}_GetResult_Response", status=UNKNOWN, result=make(
                RESULT, error_code=code_of("unknown"), error_string="no such goal is known"))
        await goal.ended.wait()
        return make(f"{FOLLOW}_GetResult_Response", status=goal.status, result=goal.result)

    # --- cancel ---------------------------------------------------------------------------------------------------

    async def _cancel_goal(self, request: Any) -> Any:
        uuid = bytes(request.goal_info.goal_id.uuid)
        stamp = request.goal_info.stamp.sec * 1_000_000_000 + request.goal_info.stamp.nanosec
        named = self._goals.get(uuid)
        every = not any(uuid) and not stamp
        chosen = [goal for goal in self._goals.values() if not goal.ended.is_set() and (
            every or goal is named or (stamp and goal.stamp <= stamp))]
        code = NONE
        if any(uuid) and not chosen:
            code = UNKNOWN_GOAL if named is None else TERMINATED
        cancelling = [goal for goal in chosen if await self._cancel(goal)]
        if chosen and not cancelling:
            code = REJECTED
        return make(f"{CANCEL}_Response", return_code=code, goals_canceling=[self._info(goal) for goal in cancelling])

    async def _cancel(self, goal: Goal) -> bool:
        """Stop the motion of a goal, also of one that has not started; return whether the executor obeys."""
        goal.cancelled = True
        if not await self._stop_goal(goal, "cancelled by a client of ROS 2"):
            return False
        if goal.status == EXECUTING:
            goal.status = CANCELING
            self._publish_statuses()
        return goal.status != SUCCEEDED

    async def _stop_goal(self, goal: Goal, reason: str) -> bool:
        try:
            self._update(goal, await self._stop.call(
                m.StopRequest(id=goal.id, reason=reason, by="requester", owner=OWNER), REQUEST_TIMEOUT))
        except RequestFailed as error:
            self._warn(f"goal {goal.id} may still move the arm: {error}")
            return False
        return True

    # --- states ---------------------------------------------------------------------------------------------------

    def _running(self) -> list[Goal]:
        return [goal for goal in self._goals.values() if goal.status in (EXECUTING, CANCELING)]

    async def _follow_status(self) -> None:
        async for status in self._status:
            for goal in self._running():
                if status.id == goal.id:
                    self._update(goal, status)
                elif status.header.stamp > goal.stamp:
                    self._end(goal, ABORTED, "lost", "the end of this motion was not reported: another one is newer, "
                                                     "or trajectory_executor was restarted")

    async def _remember_joints(self) -> None:
        async for state in self._joints:
            self._states.append(state)

    async def _watch(self) -> None:
        """Publish the feedback of the running goal; stop it outside its own tolerance."""
        clock = asyncio.get_running_loop().time
        if self._execute.available:
            self._answered = clock()
        for goal in self._running():
            if clock() - self._answered > LOST_AFTER:
                self._end(goal, ABORTED, "lost", GONE)
                continue
            status = self._status.latest
            if status is None or status.id != goal.id or status is self._watched or not self._states:
                continue
            self._update(goal, status)  # it may have ended before the answer to its request was read
            if goal.ended.is_set():
                continue
            self._watched, stamp = status, status.header.stamp
            # Where the arm was when the executor measured its progress: 10 ms later it is somewhere else.
            state = min(self._states, key=lambda each: abs(each.header.stamp - stamp))
            off = self._feedback.publish(convert.header_of(state.header), state, status.progress, goal.tolerances.path)
            if off and not goal.error:
                goal.error, goal.message = "path_tolerance", off
                await self._stop_goal(goal, f"path_tolerance: {off}")

    def _update(self, goal: Goal, status: m.MotionStatus) -> None:
        """Take over the state of the motion of a goal that runs."""
        if goal.status not in (EXECUTING, CANCELING):
            return
        if status.state == "succeeded":
            off = self._feedback.end_violation(self._joints.latest, goal.tolerances.goal)
            self._end(goal, ABORTED if off else SUCCEEDED, "goal_tolerance" if off else "", off)
        elif status.state in ("cancelled", "aborted", "rejected"):
            stopped = goal.cancelled and status.state == "cancelled" and not goal.error
            self._end(goal, CANCELED if stopped else ABORTED, goal.error or status.error or status.state,
                      goal.message or status.message)

    def _end(self, goal: Goal, status: int, error: str, message: str) -> None:
        goal.status, goal.error, goal.message = status, error, message
        goal.ended.set()
        self._forget()
        if status == ABORTED:
            self._warn(f"goal {goal.id} is aborted: {message}")
        self._publish_statuses()

    def _forget(self) -> None:
        over = [goal.uuid for goal in self._goals.values() if goal.ended.is_set()]
        for uuid in over[:-REMEMBERED]:
            del self._goals[uuid]

    # --- messages -------------------------------------------------------------------------------------------------

    def _accepted(self, goal: Goal, accepted: bool) -> Any:
        return make(f"{FOLLOW}_SendGoal_Response", accepted=accepted, stamp=convert.time_of(goal.stamp))

    def _info(self, goal: Goal) -> Any:
        return make("action_msgs/msg/GoalInfo", goal_id=convert.uuid_of(goal.uuid), stamp=convert.time_of(goal.stamp))

    def _publish_statuses(self) -> None:
        self._statuses.put(make("action_msgs/msg/GoalStatusArray", status_list=[
            make("action_msgs/msg/GoalStatus", goal_info=self._info(goal), status=goal.status)
            for goal in self._goals.values() if goal.status != UNKNOWN]))

    def _warn(self, line: str) -> None:
        """Log a line in the cell and, as the answer of an action has no room for a reason, on /rosout."""
        self._bus.log.warning("%s", line)
        self._rosout.put(make(
            LOG, stamp=convert.time_of(self._bus.clock.now_ns()), level=ROSOUT_WARN, name=NAME, msg=line))
