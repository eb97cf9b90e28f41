"""A cell on the virtual clock whose policy is broken or means harm; its set-points are judged at every millisecond."""

from __future__ import annotations

import asyncio
import json
from collections import Counter
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from applications.policy.interface import Chunk, MotionState, Observation, PolicyFailed
from applications.policy.runner import COUNTED
from applications.policy.topics import POLICY_CONTROL, POLICY_STATUS, ControlRequest, PolicyStatus
from common import topics
from common.config import load_cell
from common.messages import HoldRequest, ParameterRequest, PlanningScene
from common.planning.robot_geometry import RobotGeometry
from common.robot.model import RobotModel
from common.scene.fixtures import fixed_objects
from common.transport.bus import Bus
from common.transport.codec import decode
from common.transport.session import RawSample
from lab.simulation import Simulation
from tests.applications.policy.hostile import KINDS, Attack, crowded, towards
from tests.applications.policy.judge import STEP, Judge
from tests.applications.policy.panda import READY, panda

Array = NDArray[np.float64]

SEQUENCE = 1.2  # [s] of chunks of one kind
LONGEST = 0.05  # [s] between set-points that are interpolated
DELIVERIES = ("prompt", "prompt", "prompt", "slow", "late", "stalled", "repeated", "failing")
SERVICES = ("trajectory_executor", "fixture_scene", "policy_runner")
POLICY = f"{__name__}:policy"


@dataclass
class Sequence:
    """Chunks of one kind, delivered in one way."""

    kind: str
    delivery: str
    rate: float
    rows: int
    ends: int  # [ns, cell time]
    given: int = 0
    first: Chunk | None = None


@dataclass
class Attacker:
    """Returns hostile chunks, of another kind each `SEQUENCE`."""

    rng: np.random.Generator
    places: Array
    sequences: int = 0
    kinds: Counter[str] = field(default_factory=Counter)
    now: Sequence | None = None

    async def infer(self, observation: Observation) -> Any:
        rng, now = self.rng, self.now
        if now is None or observation.stamp >= now.ends:
            now = self.now = self._next(observation.stamp)
        now.given += 1
        chunk = self._chunk(observation, now)
        match now.delivery:
            case "slow":
                await asyncio.sleep(float(rng.uniform(0.02, 0.5)))
            case "late":
                await asyncio.sleep(float(rng.uniform(0.5, 1.5)))
            case "stalled" if now.given > 1:
                await asyncio.sleep(60.0)
            case "repeated":
                now.first = now.first or chunk
                return replace(now.first, stamp=observation.stamp if rng.uniform() < 0.8 else now.first.stamp)
            case "failing" if rng.uniform() < 0.6:
                return self._broken(chunk)
        return chunk

    def _next(self, stamp: int) -> Sequence:
        rng = self.rng
        self.sequences += 1
        kind = "home" if rng.uniform() < 0.2 else str(rng.choice(list(KINDS)))
        delivery = str(rng.choice(DELIVERIES))
        self.kinds[f"{kind} {delivery}"] += 1
        rate = float(rng.choice([10.0, 20.0, 30.0, 50.0]))
        return Sequence(kind, delivery, rate, int(rng.integers(2, 60)), stamp + round(SEQUENCE * 1e9))

    def _chunk(self, observation: Observation, now: Sequence) -> Chunk:
        times = np.arange(1, now.rows + 1) / now.rate
        state = MotionState(observation.positions, observation.velocities, 0 * observation.velocities)
        attack = Attack(panda(), state, times, self.places, self.rng)
        rows = towards(attack, READY - state.positions) if now.kind == "home" else KINDS[now.kind](attack)
        return Chunk(observation.stamp, now.rate, "joints", rows)  # no widths: the fingers stay open, as for the judge

    def _broken(self, chunk: Chunk) -> Any:
        match self.rng.integers(6):
            case 0:
                raise PolicyFailed("out of memory")
            case 1:
                return replace(chunk, values=chunk.values[:, :5])
            case 2:
                return replace(chunk, values=np.full((3, 7), np.nan))
            case 3:
                return replace(chunk, rate=float(self.rng.choice([0.0, np.nan, -1.0, 1e9])))
            case 4:
                return None
            case _:
                raise ValueError("a bug of the policy")


_current: list[Attacker] = []


async def policy(observation: Observation) -> Any:
    """Attack the arm of the simulation that runs."""
    return await _current[-1].infer(observation)


@dataclass
class Verdict:
    """What hostile sequences led to."""

    sequences: int = 0
    chunks: dict[str, int] = field(default_factory=dict)  # received, proved, ... refused
    causes: str = ""  # of violations, with their numbers
    checked: int = 0  # positions, one each millisecond
    moving: float = 0.0  # [s]
    contacts: int = 0
    most: dict[str, float] = field(default_factory=dict)  # largest share of each limit, by differences of set-points
    broken: list[str] = field(default_factory=list)
    crashes: list[str] = field(default_factory=list)


def scene_of(rng: np.random.Generator, solids: int) -> PlanningScene:
    """Return solids around an arm at READY, which touches none of them."""
    robot = panda()
    geometry = RobotGeometry(robot)
    while True:
        scene = crowded(rng, solids)
        if not Judge(robot, geometry, scene).contacts(READY[None]):
            return scene


class _Newest:
    """Takes the place of a trace: the newest status."""

    def __init__(self) -> None:
        self.status = PolicyStatus()

    def add(self, raw: RawSample, _now: int) -> None:
        if raw.key.endswith(f"/{POLICY_STATUS.key}"):
            self.status = decode(PolicyStatus, raw.payload)


async def _interfere(bus: Bus, rng: np.random.Generator, seconds: float, refuses: bool) -> None:
    """Hold and release the arm, change its speed, and take control and give it back, at random times."""
    hold, control = bus.client(topics.MOTION_HOLD), bus.client(POLICY_CONTROL)
    parameters = bus.client(topics.of_service(topics.PARAMETERS, "trajectory_executor"))
    await bus.ready()
    ends = bus.clock.now() + seconds
    while bus.clock.now() < ends:
        await bus.clock.sleep(float(rng.uniform(0.1, 0.6) if refuses else rng.uniform(0.5, 3.0)))
        if refuses:
            await control.call(ControlRequest(take=False, owner="operator"), 1.0)
        match rng.integers(3):
            case 0:
                await hold.call(HoldRequest(hold=True, by="watchdog"), 1.0)
                await bus.clock.sleep(float(rng.uniform(0.02, 0.5)))
                await hold.call(HoldRequest(hold=False, by="watchdog"), 1.0)
            case 1:
                share = float(rng.choice([0.1, 0.5, 1.0]))
                await parameters.call(ParameterRequest(set={"services.trajectory_executor.speed_scaling": share}), 1.0)
            case 2:
                await control.call(ControlRequest(take=True, owner="operator"), 1.0)
                await bus.clock.sleep(float(rng.uniform(0.02, 0.7)))
                await control.call(ControlRequest(take=False, owner="operator"), 1.0)


def run_hostile(seed: int, sequences: int, solids: int = 15, interfere: bool = True) -> Verdict:
    """Return the verdict about so many sequences of one cell."""
    rng = np.random.default_rng(seed)
    scene, verdict = scene_of(rng, solids), Verdict()
    mode = str(rng.choice(["shorten", "shorten", "slow", "slow", "refuse"])) if interfere else "shorten"
    fixtures = [{"id": item.id, "shape": item.shape, "dimensions": item.dimensions, "position": [
        item.pose.position.x, item.pose.position.y, item.pose.position.z], "rpy": [
        0.0, 0.0, 2 * float(np.arctan2(item.pose.orientation.z, item.pose.orientation.w))]} for item in scene.objects]
    runner = {"source": {"callable": POLICY, "timeout": 2.0}, "cameras": {}, "until": {"holding": False},
              "seconds": 36_000, "most_failures": 1000, "on_violation": mode, "interval": float(rng.uniform(0.02, 0.3)),
              "blend": float(rng.choice([0.0, 0.15, 0.5]))}
    loaded = load_cell("policy_panda", [f"world.fixtures={json.dumps(fixtures)}"])
    services = {name: loaded.services[name] for name in SERVICES}
    services["policy_runner"] = services["policy_runner"].model_copy(update={"parameters": runner})
    cell = loaded.model_copy(update={"services": services})
    places = np.array([[item.pose.position.x, item.pose.position.y, item.pose.position.z] for item in scene.objects])
    attacker = Attacker(rng, places)
    limit = sequences * SEQUENCE + 3.0
    newest = _Newest()
    simulation = Simulation(cell, seed, limit=limit, trace=newest, visit=(  # type: ignore[arg-type]
        lambda bus: _interfere(bus, rng, limit - 3.0, mode == "refuse")) if interfere else None)
    sent: list[tuple[float, Array, Array]] = []
    check = simulation.invariants.on_set_point

    def on_set_point(limits: Any, measured: Array, q: Array, dq: Array, now: float, arm: str) -> None:
        sent.append((now, q.copy(), dq.copy()))
        check(limits, measured, q, dq, now, arm)

    simulation.invariants.on_set_point = on_set_point  # type: ignore[method-assign]
    _current.append(attacker)
    try:
        outcome = simulation.run()
    finally:
        _current.pop()
    status = newest.status
    verdict.chunks.update({name: getattr(status, name) for name in COUNTED})
    verdict.causes = str(status.figures.get("violations", ""))
    verdict.sequences, verdict.broken, verdict.crashes = attacker.sequences, outcome.broken, outcome.crashes
    if outcome.state not in ("NOT ENDED", "BROKEN"):
        verdict.broken.append(f"the run ended: {outcome.state} {outcome.message}")
    _judge(verdict, sent, panda(), PlanningScene(header=scene.header, objects=fixed_objects(cell.world)))
    return verdict


def _judge(verdict: Verdict, sent: list[tuple[float, Array, Array]], robot: RobotModel, scene: PlanningScene) -> None:
    times, q, dq = (np.array(column) for column in zip(*sent, strict=True))
    h = np.diff(times)
    regular = (h > 1e-6) & (h < LONGEST)
    path = [q[:1]]
    for i in np.flatnonzero(regular & (np.abs(np.diff(q, axis=0)).max(axis=1) > 0)):
        u = (np.arange(1, round(h[i] / STEP) + 1) / round(h[i] / STEP))[:, None]
        v0, v1 = dq[i] * h[i], dq[i + 1] * h[i]
        path.append(q[i] * (1 - u)**2 * (1 + 2 * u) + q[i + 1] * u**2 * (3 - 2 * u)
                    + v0 * u * (1 - u)**2 - v1 * u**2 * (1 - u))
    every = np.concatenate(path)
    verdict.checked, verdict.moving = len(every), len(every) * STEP
    verdict.contacts = Judge(robot, RobotGeometry(robot), scene).contacts(every)
    middle = (robot.upper + robot.lower) / 2
    verdict.most["position"] = float((np.abs(every - middle) / (robot.upper - middle)).max())
    period = float(np.median(h))
    even = np.abs(h - period) < 1e-4 * period
    v = np.diff(q, axis=0) / period
    a, j = np.diff(v, axis=0) / period, np.diff(v, n=2, axis=0) / period**2
    two, three = even[1:] & even[:-1], even[2:] & even[1:-1] & even[:-2]
    verdict.most["velocity"] = float((np.abs(v[even]) / robot.velocity).max(initial=0.0))
    braking = np.array(robot.config.deceleration_limits or 2 * robot.acceleration)
    verdict.most["acceleration"] = float((np.abs(a[two]) / robot.acceleration).max(initial=0.0))
    verdict.most["deceleration"] = float((np.abs(a[two]) / braking).max(initial=0.0))
    verdict.most["jerk"] = float((np.abs(j[three]) / robot.jerk).max(initial=0.0))
