"""One run of the sorting cell on the virtual clock, judged by the ground truth of its physics.

What decides sees only what the cell's services see. The ground truth is read here alone: which objects the fingers
lifted, and where each came to rest.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal
from unittest.mock import patch

import cv2
import numpy as np

from applications.sorting.objects.kinds import PALETTE
from applications.sorting.rules import Rule
from applications.sorting.topics import HEAP, SORTING_STATUS, GraspCandidate, Heap, SeenObject, SortingStatus
from common import messages as m
from common import topics
from common.config import Cell, load_cell
from common.errors import RequestFailed
from common.perception.pinhole import camera_in_mount
from common.robot.transforms import invert, matrix_to_rpy, pose_to_matrix, transform
from common.transport.bus import Bus
from lab.simulation import Outcome, Simulation

TRAY, CELL = "tray", "sorting"
GENERATOR = "applications.sorting.objects.heap"
MASSES, FRICTIONS = (0.05, 0.5), (0.2, 0.6)  # [kg]; of all contacts of an object
SHIFT, TURN = 0.003, math.radians(3.0)  # [m], [rad] of the calibration's error at the tray
LIFTED = 0.02  # [m] by which the fingers must have lifted an object
SETTLED = 1.5  # [s] after which an object in a container stays there
SINGLE_LIMIT, HEAP_LIMIT = 60.0, 600.0  # [s] of cell time
IMAGES, CANDIDATES = 5, 10  # of a measurement of latency

Mode = Literal["single", "heap", "latency"]


@dataclass(frozen=True)
class Case:
    """What to run."""

    mode: Mode
    seed: int
    force: float = 20.0  # of each finger [N]
    count: int = 1  # objects
    meshes: str = ""  # folder of meshes of others in place of drawn objects
    cell: str = CELL
    sets: tuple[str, ...] = ()  # further overrides


@dataclass
class Attempt:
    """The fingers closed once: what they lifted and what came to rest where until they closed again."""

    at: float  # cell time [s]
    subject: str
    noticed: str = ""  # what the task's own check found
    lifted: set[str] = field(default_factory=set)
    landed: dict[str, str] = field(default_factory=dict)  # container by object
    heights: dict[str, float] = field(default_factory=dict)  # of all objects before [m]
    grasp: dict[str, float] = field(default_factory=dict)  # of the grasp as it was seen
    places: dict[str, str] = field(default_factory=dict)  # of all objects when the next one began


class Finished(Exception):  # noqa: N818 - not an error
    """Ends a run before its task does."""


def pose_error(cell: Cell, seed: int) -> list[float]:
    """Draw a calibration error: 3 mm in any direction, and 3 degrees about any axis through the middle of the tray.

    About the optical center, 3 degrees would be 5 cm at the tray: no calibration that was checked once is that wrong.

    Returns:
        The true optical frame in the configured one: x, y, z [m], roll, pitch, yaw [rad].
    """
    rng = np.random.default_rng([seed, 3])
    shift, axis = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    tray = cell.world.containers[TRAY]
    middle = np.array([tray.x, tray.y, cell.world.table_height])
    turn = cv2.Rodrigues(TURN * axis)[0]
    moved = transform(turn, middle - turn @ middle + SHIFT * shift)
    T = camera_in_mount(cell.world.camera)
    error = invert(T) @ moved @ T
    return [*error[:3, 3].tolist(), *matrix_to_rpy(error[:3, :3])]


def cell_of(case: Case) -> Cell:
    """Load the cell of a case, with its objects, noise and errors."""
    generator: dict[str, Any] = {
        "module": GENERATOR, "count": case.count, "kinds": "test", "masses": list(MASSES),
        "frictions": list(FRICTIONS)}
    if case.meshes:
        generator["meshes"] = str(Path(case.meshes).resolve())
    sets = [f"seed={case.seed}", f"world.generator={json.dumps(generator)}",
            f"robot.gripper.effort={case.force:g}", f"robot.gripper.max_effort={case.force:g}"]
    if case.mode == "latency":
        sets.append("autostart=false")
    error = pose_error(load_cell(case.cell), case.seed)
    sets.append(f"services.depth_camera.pose_error={json.dumps(error)}")
    return load_cell(case.cell, [*sets, *case.sets])


class Truth:
    """Attempts by what really happened."""

    def __init__(self) -> None:
        """Start without messages."""
        self.attempts: list[Attempt] = []
        self.sorted: dict[str, str] = {}  # container by object
        self.objects: dict[str, m.WorldObject] = {}
        self.status, self.heap = SortingStatus(), Heap(header=m.Header())
        self.latencies: list[float] = []  # [s] processor time
        self._grasps: dict[str, GraspCandidate] = {}
        self.proved = False  # whether any grasp was ever proved
        self.planned: list[str] = []  # errors of motions to the best candidates, empty for a success

    def on_status(self, status: SortingStatus, now: float) -> None:
        """Start an attempt when the task counts one."""
        if status.attempts > len(self.attempts):
            heights = {name: each.pose.position.z for name, each in self.objects.items()}
            if self.attempts:
                self.attempts[-1].places = self._places()
            grasp = self._grasps.get(status.grasp)
            self.attempts.append(Attempt(now, status.subject or self.status.subject, heights=heights,
                                         grasp={} if grasp is None else seen(grasp)))
        elif self.attempts and status.held:
            self.attempts[-1].noticed = status.held
        self.status = status

    def on_objects(self, world: m.WorldObjects) -> None:
        """Note what the fingers lift and what lies in a container."""
        self.objects = {each.id: each for each in world.objects}
        last = self.attempts[-1] if self.attempts else None
        for name, each in self.objects.items():
            z = each.pose.position.z
            if last is not None and each.state == "held" and z > last.heights.get(name, z) + LIFTED:
                last.lifted.add(name)
            if each.state == "contained" and each.container != TRAY and name not in self.sorted:
                self.sorted[name] = each.container
                if last is not None:
                    last.landed[name] = each.container

    def on_heap(self, heap: Heap) -> None:
        """Note how long images took."""
        if heap.at_home and heap.objects:
            self.heap = heap
            self._grasps |= {grasp.id: grasp for grasp in heap.grasps}
            self.latencies.append(heap.seconds)
            self.proved = self.proved or any(grasp.proved for grasp in heap.grasps)

    def failure(self, attempt: Attempt) -> str:
        """Return why an attempt brought nothing into a container; empty if it did."""
        if attempt.landed:
            return ""
        if not attempt.lifted:
            return "empty"
        now = attempt.places or self._places()
        places = {now[name] for name in attempt.lifted}
        if attempt.noticed == "two" and places <= {TRAY, "held"}:  # the next one may have started
            return "put back"
        if places == {TRAY}:
            return "slipped"
        if places & {"held", "falling"}:
            return "not released" if self.status.state in ("DONE", "ERROR") else "unfinished"
        return "fell in transit"

    def _places(self) -> dict[str, str]:
        """Return the container of each object, or its state outside of all."""
        return {name: each.container or each.state for name, each in self.objects.items()}

    def nothing_tried(self) -> str:
        """Return why the fingers never closed."""
        if self.proved:
            return "plan failed"
        return "no grasp proved" if self.heap.objects else "not seen"


def seen(grasp: GraspCandidate) -> dict[str, float]:
    """Return figures of a grasp."""
    T = pose_to_matrix(grasp.pose)
    return {"x": round(T[0, 3], 3), "y": round(T[1, 3], 3), "z": round(T[2, 3], 4), "score": round(grasp.score, 3),
            "width": round(grasp.width, 4), "opening": round(grasp.opening, 4),
            "tilt": round(math.degrees(math.acos(np.clip(-T[2, 2], -1, 1))), 1)}


async def watch(bus: Bus, truth: Truth, case: Case) -> None:
    """Feed the truth until the case is decided.

    Raises:
        Finished: it is decided.
    """
    start = bus.clock.now()
    statuses, worlds, heaps = bus.reader(SORTING_STATUS), bus.reader(topics.SCENE_OBJECTS), bus.reader(HEAP)
    decided = asyncio.Event()

    async def read_statuses() -> None:
        async for status in statuses:
            truth.on_status(status, bus.clock.now() - start)
            second_try = case.mode == "single" and status.attempts > 1
            if second_try or status.state in ("DONE", "ERROR"):
                decided.set()

    async def read_worlds() -> None:
        async for world in worlds:
            truth.on_objects(world)
            if case.mode == "single" and truth.sorted:
                decided.set()

    async def read_heaps() -> None:
        async for heap in heaps:
            truth.on_heap(heap)
            if case.mode == "latency" and len(truth.latencies) >= IMAGES:
                decided.set()

    reading = [asyncio.create_task(each) for each in (read_statuses(), read_worlds(), read_heaps())]
    await decided.wait()
    if case.mode == "latency":
        truth.planned = await planned(bus, truth.heap)
    else:
        await bus.clock.sleep(SETTLED)
    for task in reading:
        task.cancel()
    raise Finished


async def planned(bus: Bus, heap: Heap) -> list[str]:
    """Plan motions from home to the first candidates; return the error of each, empty for a success."""
    errors = []
    plan = bus.client(topics.MOTION_PLAN)
    for number, grasp in enumerate(heap.grasps[:CANDIDATES]):
        goal: m.JointGoal | m.PoseGoal = (
            m.JointGoal(positions=grasp.q_approach) if grasp.q_approach else m.PoseGoal(pose=grasp.approach))
        try:
            answer = await plan.call(m.PlanRequest(
                id=f"candidate_{number}", goal=goal, gripper_width=grasp.opening), timeout=30.0)
        except RequestFailed as error:
            errors.append(str(error))
        else:
            errors.append("" if answer.ok else answer.error or "no plan")
    return errors


def run(case: Case) -> dict[str, Any]:
    """Run a case; return what it shows, in plain values."""
    truth, began = Truth(), time.perf_counter()
    lines: list[str] = []
    cell = cell_of(case)
    simulation = Simulation(
        cell, case.seed, limit=SINGLE_LIMIT if case.mode == "single" else HEAP_LIMIT, log=lines.append,
        visit=lambda bus: watch(bus, truth, case))
    outcome = simulation.outcome
    processor = SimpleNamespace(perf_counter=time.process_time)  # wall time would be that of a busy machine
    with contextlib.suppress(Finished), patch("services.grasp_detector.time", processor):
        simulation.run()
    return {
        **asdict(case), **judged(truth, outcome, cell), "wall": round(time.perf_counter() - began, 1),
        "log": [line for line in lines if "WARNING" in line or "ERROR" in line or "Traceback" in line][-10:],
    }


def rule_of(cell: Cell) -> Rule:
    """Return the rule of the cell's sorter."""
    given = next(entry.parameters for entry in cell.services.values() if entry.kind == "sorter")
    destinations = [name for name in cell.world.containers if name != TRAY]
    return Rule(given.get("by", "color"), given.get("where", {}), destinations)


def true_object(thing: m.WorldObject) -> SeenObject:
    """Return what perfect perception would report for a rule by color or size."""
    color = np.array([thing.color.r, thing.color.g, thing.color.b])
    name = min(PALETTE, key=lambda each: float(np.abs(color - PALETTE[each]).max()))
    return SeenObject(id=thing.id, center=thing.pose.position, size=thing.size, color=thing.color, color_name=name)


def judged(truth: Truth, outcome: Outcome, cell: Cell) -> dict[str, Any]:
    """Return the result of a run by ground truth."""
    attempts = [
        {"subject": each.subject, "noticed": each.noticed, "lifted": sorted(each.lifted), "landed": each.landed,
         "grasp": each.grasp, "failure": truth.failure(each)} for each in truth.attempts]
    rule = rule_of(cell)
    wanted = {name: rule.destination(true_object(each)) for name, each in truth.objects.items()}
    containers: dict[str, str] = {name: each.container or each.state for name, each in truth.objects.items()}
    first = attempts[0]["failure"] if attempts else truth.nothing_tried()
    if not attempts and truth.status.state not in ("DONE", "ERROR") and not truth.planned:
        first = "timeout"
    if outcome.crashes or outcome.broken or outcome.state == "NOT STARTED":
        first = "crash"
    return {
        "first": first, "attempts": attempts, "ended_in": containers, "wanted": wanted,
        "state": truth.status.state, "message": truth.status.message, "seconds": truth.status.task_seconds,
        "left": [f"{each.object}: {each.reason}" for each in truth.heap.left],
        "latencies": [round(each, 4) for each in truth.latencies[-IMAGES:]], "planned": truth.planned,
        "scorer": truth.heap.scorer,
        "crashes": outcome.crashes, "broken": outcome.broken,
        "outcome": f"{outcome.state} {outcome.message}".strip(), "cpu": round(outcome.cpu_seconds, 1),
    }
