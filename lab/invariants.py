"""Invariants that hold at every step of a simulated cell, under all injected faults."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from itertools import combinations
from typing import Any

import msgpack
import numpy as np

from common import topics
from common.application import find_application
from common.arms import arm_of, of_arm
from common.config import Cell
from common.hardware.interface import Limits, Vector
from common.messages import (
    CameraInfo,
    ExecuteRequest,
    GripperCommand,
    GripperState,
    Image,
    LogLine,
    Message,
    MotionOwner,
    MotionStatus,
    PlanRequest,
    PointCloud2,
    ServiceCounters,
    StopRequest,
    WorldEdit,
    WorldObjects,
)
from common.robot.model import RobotModel
from common.topics import AnyTopic
from common.transport.codec import decode
from common.transport.local import intersects
from common.transport.session import RawSample
from lab.arm_distance import ArmDistance
from lab.doubles import is_double
from lab.motion_invariants import ONCE, Checks, MotionInvariants
from lab.processes import RequestLog
from recording.report.application import figures_of

Position = tuple[float, float, float]  # x, y, z [m]

WITH_ID = (ExecuteRequest, GripperCommand, PlanRequest)
PUBLISHED_BY_CAMERAS = (Image, CameraInfo, PointCloud2, ServiceCounters, LogLine)  # by readers of the ground truth
LATE = 0.5  # [s] that the end of a request may come after its time-out
MEASURED = 0.02  # [rad] of a joint from which the distance between arms is measured again
MOVED = 2e-3  # [m] displacement from which an object counts as moved
CARRIED, CONTAINED, LOST = ("held", "falling"), "contained", "elsewhere"  # states of an object in the ground truth

OBJECTS = "no object is lost or duplicated"
SINGLE = "one instance per service publishes"
TRUTH = "no deciding service reads the ground truth"
OUTCOMES = "every request ends in one of five ways"
NEWER = "no message is read twice or out of order"
COUNTED = "the task counts what was placed"
APART = "arms do not touch"
ACCEPTED = "the application accepts the final state"


class WorldInvariants:
    """Checks the objects of the ground truth."""

    def __init__(self, checks: Checks, cell: Cell) -> None:
        self._checks = checks
        application = find_application(cell.application)
        self._hands = max(len(cell.robots), 1)
        self._fills, self._truth_check = application.fills_containers, application.truth_check
        self._figures = figures_of(application)()
        self._figures.parameters = cell.task_parameters
        self._physics = cell.world.simulator != "kinematic"  # objects are pushed, and roll
        self._belts = [*cell.world.conveyors.values()]  # carry objects, also off their end
        self._newest = b""  # encoded ground truth
        self._ids: list[str] = []
        self._open_edits = 0  # requested and not answered
        self._edited = False  # since the newest ground truth
        self._objects: dict[str, tuple[str, Position]] = {}  # state and position by id
        self._containers: dict[str, str] = {}  # container by id of the objects in one
        self._destinations = frozenset(cell.world.destinations)

    def on_edit_requested(self) -> None:
        """Allow any change until the edit is answered and published."""
        self._open_edits, self._edited = self._open_edits + 1, True

    def on_edit_answered(self) -> None:
        """Close an edit."""
        self._open_edits -= 1

    def on_truth(self, payload: bytes) -> None:
        """Check the encoded ground truth against the one before."""
        checks, self._newest = self._checks, payload
        objects: list[dict[str, Any]] = msgpack.unpackb(payload)["objects"]
        ids = sorted(str(each["id"]) for each in objects)
        edited, self._edited = self._edited, self._open_edits > 0
        if edited or not self._ids:
            self._ids = ids
        if checks.fails(ids == self._ids and len(set(ids)) == len(ids), OBJECTS):
            checks.add_violation(OBJECTS, f"{ids} instead of {self._ids}")
        found: dict[str, tuple[str, Position]] = {}
        for each in objects:
            position = each["pose"]["position"]
            found[each["id"]] = each["state"], (position["x"], position["y"], position["z"])
        held = [name for name, (state, _) in found.items() if state == "held"]
        if checks.fails(len(held) <= self._hands or self._physics, OBJECTS):  # fingers may close on two of a heap
            checks.add_violation(OBJECTS, f"{held} are held at once")
        self._containers = {each["id"]: each["container"] for each in objects if each["state"] == CONTAINED}
        for name, (state, position) in found.items():
            before, old_position = self._objects.get(name, (state, position))
            self._objects[name] = state, position
            distance = 0.0 if state in CARRIED else math.dist(position, old_position)
            conveyed = any(0 <= belt.along(*old_position[:2])[0] <= belt.dimensions[0] for belt in self._belts)
            legal = (edited or self._physics or state in CARRIED or before in CARRIED or conveyed
                     or (state == before and distance < MOVED))
            if checks.fails(legal and (state != LOST or self._physics or bool(self._belts)), OBJECTS):
                checks.add_violation(OBJECTS, f"{name} changed from {before} to {state} by itself, {distance:.3f} m")

    def on_end(self, done: int, state: str) -> None:
        """Compare the final ground truth with what the task reports."""
        checks = self._checks
        if state == "DONE" and self._fills and not self._physics:  # with physics one camera cannot count a pile
            contained = sum(container in self._destinations for container in self._containers.values())
            if checks.fails(done == contained, COUNTED):
                checks.add_violation(COUNTED, f"the task reports {done}, the ground truth has {contained}")
        if state == "DONE" and self._newest:
            truth = decode(WorldObjects, self._newest)
            problem = self._truth_check(truth) if self._truth_check is not None else ""
            placed = self._figures.in_place(truth)
            if placed is not None and (missing := [each.id for each in truth.objects if each not in placed]):
                problem = f"missing among the {self._figures.IN_PLACE}: {', '.join(missing)}"
            if (placed is not None or self._truth_check is not None) and checks.fails(not problem, ACCEPTED):
                checks.add_violation(ACCEPTED, problem)


class BetweenArms:
    """Checks that the set-points of two arms do not touch."""

    def __init__(self, checks: Checks, cell: Cell) -> None:
        self._checks = checks
        robots = {arm: RobotModel.load(robot) for arm, robot in cell.robots.items()}
        self._judges = {pair: ArmDistance(robots[pair[0]], robots[pair[1]]) for pair in combinations(robots, 2)}
        self._newest: dict[str, Vector] = {}
        self._measured: dict[str, Vector] = {}

    def on_set_point(self, arm: str, q: Vector) -> None:
        """Measure once a joint has moved by `MEASURED`."""
        self._newest[arm] = q
        if arm in self._measured and np.abs(q - self._measured[arm]).max() < MEASURED:
            return
        self._measured[arm] = q.copy()
        for pair, judge in self._judges.items():
            if arm in pair and all(each in self._newest for each in pair):
                distance = judge.least(*(self._newest[each] for each in pair))
                if self._checks.fails(distance > 0, APART):
                    self._checks.add_violation(APART, f"{' and '.join(pair)}: {distance:.4f} m")


class Invariants:
    """Checks all messages, set-points and requests of one run.

    `broken` lists violations, `checked` counts the checks of each invariant.
    """

    def __init__(self, cell: Cell, requests: RequestLog, now: Callable[[], float]) -> None:
        """Observe the requests of a cell; `now` returns the virtual time [s]."""
        self.checks = checks = Checks(now)
        self.finished = False  # ignore set-points from now on
        self.truth_readers: set[str] = set()  # processes that subscribe to what only cameras may read
        self._motions = {arm: MotionInvariants(checks, cell, arm) for arm in cell.robots or ("",)}
        self._between = BetweenArms(checks, cell)
        self._world = WorldInvariants(checks, cell)
        self._requests = requests
        requests.on_request, requests.on_answer = self._on_request, self._on_answer
        requests.on_serve = self._on_serve
        application = find_application(cell.application)
        self._doubles = {entry.name for entry in cell.services.values() if is_double(entry)}
        known: dict[str, AnyTopic] = {**topics.platform_topics(), **application.topics_by_key}
        self._messages = {t.message.__name__: t.message for t in known.values()}
        self._objects_key = f"{cell.name}/{topics.SCENE_OBJECTS.key}"
        self._truth_keys = [self._objects_key, *(f"{cell.name}/{view.key}" for view in application.truth_views)]
        self._log_part = f"/{topics.LOG.expression.partition('/')[0]}/"
        self._of_motion = {f"{cell.name}/{of_arm(topic, arm).key}": (topic, motion) for arm, motion in
                           self._motions.items() for topic in (topics.MOTION_STATUS, topics.GRIPPER_STATE,
                                                               topics.MOTION_OWNER)}
        self._by_id: dict[str, Message] = {}  # requests
        self._publishing: dict[str, str] = {}  # by service: the process that published last
        self._replaced: dict[str, str] = {}  # processes that another one has replaced, which is the value
        self._isolated: set[str] = set()  # processes whose link was cut at some time
        self._reported = 0  # unexpected ends of requests

    @property
    def broken(self) -> list[str]:
        """Violations: virtual time, invariant and detail."""
        return self.checks.broken

    @property
    def checked(self) -> Counter[str]:
        """Number of checks by invariant."""
        return self.checks.checked

    # --- messages -----------------------------------------------------------------------------------------------------

    def on_subscribe(self, service: str, key: str) -> None:
        """Note a subscription."""
        if any(intersects(key, truth) for truth in self._truth_keys):
            self.truth_readers.add(service)

    def on_put(self, service: str, instance: str, sample: RawSample, isolated: bool = False) -> None:
        """Check a message that a process puts.

        Args:
            service: name of the process.
            instance: name and number of the process, another after each start.
            sample: as it travels.
            isolated: whether its link was cut before, so that another process may have replaced it meanwhile.
        """
        checks = self.checks
        self._isolated |= {instance} if isolated else set()
        if self._log_part not in sample.key:  # a refused second instance may log
            last = self._publishing.setdefault(service, instance)
            successor = self._replaced.get(instance, "")
            if checks.fails(not successor or self._isolated & {instance, successor}, SINGLE):
                checks.add_violation(SINGLE, f"{instance} publishes {sample.key} after {successor} did")
            if instance != last:
                self._replaced[last], self._publishing[service] = instance, instance
        if service in self.truth_readers and service not in self._doubles:
            model = self._messages.get(sample.encoding.rpartition(";")[2], Message)
            if checks.fails(issubclass(model, PUBLISHED_BY_CAMERAS), TRUTH):
                checks.add_violation(TRUTH, f"{service} reads it and publishes {sample.key}")
        if sample.key in self._of_motion:
            topic, motion = self._of_motion[sample.key]
            message = decode(topic.message, sample.payload)
            if isinstance(message, MotionStatus):
                motion.on_motion(instance, message)
            elif isinstance(message, GripperState):
                motion.on_gripper(instance, message)
            elif isinstance(message, MotionOwner):
                motion.jogging = message.jogging
        elif sample.key == self._objects_key:
            self._world.on_truth(sample.payload)

    def on_set_point(
        self, limits: Limits, measured: Vector, q: Vector, dq: Vector, now: float, arm: str = ""
    ) -> None:
        """Check a set-point of an arm; see `MotionInvariants.on_set_point`."""
        if not self.finished:
            self._motions[arm].on_set_point(limits, measured, q, dq, now)
            self._between.on_set_point(arm, q)

    @property
    def stopped_by_operator(self) -> bool:
        """Whether the newest command of an operator to an arm was to stop, pause or hold."""
        return any(motion.stopped_by_operator for motion in self._motions.values())

    def on_clock(self, step: float) -> None:
        """Shift all cell times; see `MotionInvariants.on_clock`."""
        for motion in self._motions.values():
            motion.on_clock(step)

    # --- requests -----------------------------------------------------------------------------------------------------

    def _arms(self, key: str) -> list[MotionInvariants]:
        """Return the arm that a request is for, or all for a key that they share."""
        arm = arm_of(key, self._motions)
        return [self._motions[arm]] if arm in self._motions else [*self._motions.values()]

    def _on_serve(self, instance: str, request: Message, answer: Message, key: str = "") -> None:
        for motion in self._arms(key):
            motion.on_serve(instance, request, answer)

    def _on_request(self, service: str, request: Message, key: str = "") -> None:
        if isinstance(request, WITH_ID):
            known = self._by_id.setdefault(request.id, request)
            if self.checks.fails(known is request or known == request, ONCE):
                self.checks.add_violation(ONCE, f"{request.id} is the id of two different requests: "
                                          f"{type(known).__name__} and {type(request).__name__}")
        stops_all = isinstance(request, StopRequest) and bool(request.owner)
        for motion in self._arms("" if stops_all else key):
            motion.on_request(service, request)
        if isinstance(request, WorldEdit):
            self._world.on_edit_requested()

    def _on_answer(self, service: str, request: Message, answer: Message, key: str = "") -> None:
        if isinstance(request, WorldEdit):
            self._world.on_edit_answered()
        for motion in self._arms(key):
            motion.on_answer(service, request, answer)

    def check_requests(self) -> None:
        """Check open requests for their deadlines, and report what the request log found."""
        checks, requests, now = self.checks, self._requests, self.checks.now()
        for service, key, end in requests.open.values():
            if checks.fails(now <= end + LATE, OUTCOMES):
                checks.add_violation(OUTCOMES, f"{key} of {service} should have ended by {end:.1f} s")
        checks.checked[OUTCOMES] += requests.started
        for unexpected in requests.unexpected[self._reported:]:
            checks.add_violation(OUTCOMES, unexpected)
        for repeated in requests.repeated[:1]:
            checks.add_violation(NEWER, repeated)
        checks.checked[NEWER] = requests.read
        self._reported = len(requests.unexpected)

    def on_end(self, done: int, state: str) -> None:
        """Compare what the task reports in the end with the ground truth."""
        self._world.on_end(done, state)
