"""Two Pandas that face each other over one table: real trajectory controllers and the coordinator on a virtual clock.

The judge uses pinocchio and coal on the positions of both arms at the same time, and nothing of the proof. Those are
the set-points, or what is measured in a world with physics, which counts contacts itself, too.
"""

import heapq
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import count, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.config import World
from common.config.loading import load_robot
from common.control.trajectory_controller import TrajectoryController
from common.hardware.interface import Hardware
from common.planning.arms import way_back
from common.planning.arms.arm import Observed, Options
from common.planning.arms.coordinator import Coordinator, Retreat
from common.planning.arms.pair_world import ArmGeometry
from common.planning.arms.schedules import Cancel, ScheduleKeeper
from common.planning.ik import solve_ik
from common.planning.trajectory import TimedPath, trajectory_message
from common.robot.model import RobotModel
from common.sim.interface import load_world
from lab.arm_distance import ArmDistance

Array = NDArray[np.float64]

PERIOD, TICK, REPORT = 0.01, 0.02, 0.1  # [s]
DISTANCE = 1.1  # [m] between the bases


def robots(distance: float = DISTANCE) -> dict[str, RobotModel]:
    """Return the arms: left at the origin, right opposite."""
    left = load_robot("panda")
    right = left.model_copy(update={"base_position": (distance, 0.0, 0.0), "base_rpy": (0.0, 0.0, np.pi)})
    return {"left": RobotModel.load(left), "right": RobotModel.load(right)}


@dataclass
class Result:
    """Outcome of a request: state, error, and when it was requested, started and over [s]."""

    state: str = ""
    error: str = ""
    requested: float = 0.0
    over: float = 0.0


@dataclass
class SimulatedArm:
    """One executor."""

    name: str
    robot: RobotModel
    controller: TrajectoryController
    q: Array
    dq: Array
    pending: dict[str, TimedPath] = field(default_factory=dict)  # goals to ask the coordinator about
    reported: Any = None
    reported_at: float = -1.0
    operator_hold: bool = False
    scaling: float = 1.0
    stopped: bool = False
    hardware: Hardware | None = None  # in a world with physics
    measured: Array = field(default_factory=lambda: np.empty(0))  # without physics the set-point


class TwoArms:
    """The simulation."""

    def __init__(
        self, options: Options | None = None, *, message: float = 0.01, seed: int = 0, distance: float = DISTANCE,
        line: Callable[[str, Array, Array], bool] | None = lambda *_: True, coordinate: bool = True,
        world: World | None = None,
    ) -> None:
        """Both arms at home; messages take `message` [s]; `line` says where a straight way home is free.

        Servos move the arms in a world with physics, if given.
        """
        self.now, self.message, self.coordinate = 0.0, message, coordinate
        self.rng = np.random.default_rng(seed)
        self.robots = robots(distance)
        self.geometry = {name: ArmGeometry(name, robot) for name, robot in self.robots.items()}
        self.coordinator = Coordinator(self.geometry.values(), options or Options(), line)
        self.keeper = ScheduleKeeper(self.coordinator)
        self.arms: dict[str, SimulatedArm] = {}
        for name, robot in self.robots.items():
            home = robot.named("home")
            self.arms[name] = SimulatedArm(name, robot, TrajectoryController(
                self.coordinator.arms[name].limits, home, name=name), home, np.zeros(robot.dof))
        self.results: dict[str, Result] = {}
        self.states: list[tuple[float, Array, Array]] = []
        self._queue: list[tuple[float, int, Callable[[], None]]] = []
        self._order = count()
        self._next_tick = 0.0
        self.largest_gap = 0.0  # of the lags of two committed arms, seen by their true progress [s]
        self.alive = True  # the coordinator
        self.contacts = 0  # steps of physics in which a link of one arm touches one of the other
        self.physics: Any = None
        if world is not None:
            self._enter(world)

    def _enter(self, world: World) -> None:
        self.physics = load_world(world, world.objects, None, self.robots["left"].config.gripper)
        for name, arm in self.arms.items():
            arm.hardware = last = self.physics.arm(name, arm.robot, self.coordinator.arms[name].limits, arm.q)
        measure = last.measure

        def measured() -> None:
            """Look for contacts after each step."""
            measure()
            self.contacts += bool(self.touching())

        last.measure = measured

    def touching(self) -> list[tuple[str, str]]:
        """Return the bodies of different arms that touch each other now, by MuJoCo."""
        from drivers.mujoco.scene import ROBOT

        cell, data = self.physics.simulation
        model, pairs = cell.model, data.contact.geom[data.contact.dist <= 0].astype(int)
        return [tuple(model.body(model.geom_bodyid[geom]).name for geom in pair) for pair in pairs
                if (model.geom_contype[pair] & ROBOT).all()]

    def later(self, delay: float, action: Callable[[], None]) -> None:
        """Run an action after a delay [s]."""
        heapq.heappush(self._queue, (self.now + delay, next(self._order), action))

    # --- executor side --------------------------------------------------------------------------------------------

    def execute(self, arm: str, goal: str, path: TimedPath) -> None:
        """Request a motion of an arm."""
        own = self.arms[arm]
        self.results.setdefault(goal, Result(requested=self.now))
        if self.coordinate:
            own.controller.hold(True, "waits for the coordinator", "coordinator")
        status = own.controller.accept(goal, trajectory_message(own.robot, path), self.now, own.q)
        if status.state == "rejected":
            self._finish(goal, status.state, status.error)
        elif self.coordinate:
            self._ask(own, goal, path)

    def _ask(self, own: SimulatedArm, goal: str, path: TimedPath) -> None:
        if own.controller.goal != goal:
            return

        def answer() -> None:
            if not self.alive:
                return
            if "coordinator" not in own.controller.reports.holds:
                self.later(0.25, lambda: self._ask(own, goal, path))
                return
            decision = self.coordinator.request(own.name, goal, path, self.now)
            if decision.state == "refused":
                self.later(self.message, lambda: self._refused(own, goal, decision.error, decision.message))
            else:
                self.later(0.25, lambda: self._ask(own, goal, path))

        self.later(self.message, answer)

    def _refused(self, own: SimulatedArm, goal: str, error: str, message: str) -> None:
        if own.controller.goal == goal:
            self.results[goal].error = error
            own.controller.cancel(goal, message, self.now)

    def _finish(self, goal: str, state: str, error: str) -> None:
        result = self.results[goal]
        result.state, result.over = state, self.now
        result.error = result.error or error

    # --- time -----------------------------------------------------------------------------------------------------

    def run(self, seconds: float, each: Callable[[], None] | None = None) -> None:
        """Advance all cycles by so many seconds."""
        end = self.now + seconds
        while self.now < end - 1e-9:
            self.now += PERIOD
            while self._queue and self._queue[0][0] <= self.now:
                heapq.heappop(self._queue)[2]()
            for arm in self.arms.values():
                self._cycle(arm)
            self.states.append((self.now, self.arms["left"].measured.copy(), self.arms["right"].measured.copy()))
            if self.coordinate and self.alive and self.now >= self._next_tick:
                self._next_tick = self.now + TICK
                self._tick()
            if each is not None:
                each()

    def _cycle(self, arm: SimulatedArm) -> None:
        controller = arm.controller
        controller.reports.speed_scaling = arm.scaling
        q, dq = (arm.q, arm.dq) if arm.hardware is None else arm.hardware.read(self.now)
        found = controller.update(self.now, q, dq)
        if found is not None:
            arm.q, arm.dq = found
            if arm.hardware is not None:
                arm.hardware.write(*found, self.now)
        arm.measured = arm.q if arm.hardware is None else q
        status = controller.status
        if status.id in self.results and status.state not in ("active", "none") and not self.results[status.id].state:
            self._finish(status.id, status.state, status.error)
        key = status.id, status.state, status.held, tuple(status.held_by), arm.scaling, controller.at_rest
        if key != arm.reported or self.now - arm.reported_at >= REPORT:
            arm.reported, arm.reported_at = key, self.now
            held_by = status.held_by
            observed = Observed(
                self.now, arm.q.copy(), status.id if status.state == "active" else "", status.path_time,
                any(holder != "coordinator" for holder in held_by), "coordinator" in held_by, arm.scaling,
                controller.at_rest, not arm.stopped)
            self.later(self.message, lambda: self.coordinator.observe(arm.name, observed))

    def _tick(self) -> None:
        actions: list[Retreat | Cancel] = [*self.keeper.step(self.now), *self.coordinator.step(self.now)]
        for action in actions:
            if isinstance(action, Retreat):
                self.later(2 * self.message + 0.3, lambda a=action: self.execute(a.arm, a.goal, a.path))  # type: ignore[misc]
            else:
                self.later(self.message, lambda a=action: self._refused(  # type: ignore[misc]
                    self.arms[a.arm], a.goal, "obstructed", a.why))
        for name, arm in self.coordinator.arms.items():
            if arm.committed is not None and arm.state is not None and arm.state.goal == arm.committed.goal and (
                    bool(arm.hold) != arm.state.held):
                self.later(self.message, lambda n=name, g=arm.committed.goal, h=arm.hold: self._hold(n, g, h))  # type: ignore[misc]
        running = [arm for arm in self.coordinator.arms.values() if arm.committed is not None]
        if len(running) == 2 and not any(arm.is_frozen or arm.hold for arm in running):
            lags = []
            for arm in running:
                assert arm.committed is not None
                goal = self.arms[arm.name].controller._goal
                done = goal.time if goal is not None and goal.id == arm.committed.goal else arm.done
                late = self.now - arm.committed.schedule.time(done)
                ends = done >= arm.committed.motion.duration - 1e-3
                lags.append(0.0 if ends else max(late, 0.0) if arm.committed.schedule.is_starting(done) else late)
            self.largest_gap = max(self.largest_gap, abs(lags[0] - lags[1]))

    def _hold(self, name: str, goal: str, reason: str) -> None:
        controller = self.arms[name].controller
        if controller.goal == goal:
            controller.hold(bool(reason), reason, "coordinator")

    def unfinished(self) -> dict[str, float]:
        """Return the age of all requests that are not over [s]."""
        return {goal: self.now - result.requested for goal, result in self.results.items() if not result.state}

    # --- what is asked in tests -----------------------------------------------------------------------------------

    def path_to(self, arm: str, q: Array, share: float = 0.4) -> TimedPath:
        """Return the straight path of an arm from where it is to q (dof,) [rad]."""
        return way_back.straight(self.arms[arm].q, q, self.coordinator.arms[arm].limits, share)

    def judged(self, step: float = 0.02) -> list[float]:
        """Return the distances between the arms [m] along all recorded states, about a step [rad] of a joint apart."""
        return judged(self.robots["left"], self.robots["right"], [(a, b) for _, a, b in self.states], step)

    def moved_at(self, arm: str, after: float) -> float:
        """Return when an arm moved first after a time [s]."""
        index = list(self.arms).index(arm) + 1
        times = [state for state in self.states if state[0] > after]
        return next(b[0] for a, b in pairwise(times) if not np.array_equal(a[index], b[index]))


def judged(one: RobotModel, other: RobotModel, states: list[tuple[Array, Array]], step: float) -> list[float]:
    """Return the distances [m] of two arms along states (dof,) of both, about a step [rad] of a joint apart."""
    judge, found = ArmDistance(one, other), []
    last = np.concatenate(states[0])
    for number, pair in enumerate(states):
        both = np.concatenate(pair)
        move = float(np.abs(both - last).max())
        if move < step / 2 and 0 < number < len(states) - 1:
            continue
        count = max(1, int(np.ceil(move / step)))
        for k in range(1, count + 1):
            q = last + (both - last) * k / count
            found.append(judge.least(q[:7], q[7:]))
        last = both
    return found


def reachable(robot: RobotModel, count: int, seed: int) -> list[Array]:
    """Return joint positions (dof,) [rad] with the tool down at random places of the shared middle of the table."""
    rng, home, found = np.random.default_rng(seed), robot.named("home"), list[Array]()
    while len(found) < count:
        T = robot.fk(home)
        T[:3, 3] = rng.uniform([0.4, -0.3, 0.1], [0.7, 0.3, 0.4])
        q = solve_ik(robot, T, home, restarts=0)
        if q is not None:
            found.append(q)
    return found


class RandomRequests:
    """Requests random motions of both arms, each a random time after its last one was over."""

    def __init__(self, sim: TwoArms, seed: int, poses: int = 20) -> None:
        """Choose among so many poses of each arm."""
        self.sim, self.rng, self._count = sim, np.random.default_rng(seed), 0
        self._poses = {name: [*reachable(robot, poses, 7), robot.named("home")] for name, robot in sim.robots.items()}
        self._goals = dict.fromkeys(sim.arms, "")
        self._due = dict.fromkeys(sim.arms, 0.0)

    def __call__(self) -> None:
        """Request what is due; call it in each cycle."""
        sim = self.sim
        for name, arm in sim.arms.items():
            goal = self._goals[name]
            if goal and not sim.results[goal].state:
                continue
            if goal:
                self._goals[name] = ""
                self._due[name] = sim.now + float(self.rng.choice([0.0, 0.3, 2.5], p=[0.5, 0.3, 0.2]))
            if sim.now >= self._due[name] and not arm.controller.goal and arm.controller.at_rest:
                self._count += 1
                q = self._poses[name][self.rng.integers(len(self._poses[name]))]
                if np.abs(q - arm.q).max() > 0.01:
                    self._goals[name] = f"{name}-{self._count}"
                    sim.execute(name, self._goals[name], sim.path_to(name, q, float(self.rng.uniform(0.2, 0.8))))
