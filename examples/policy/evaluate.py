"""Measure how often a policy picks the ball, in layouts that no demonstration has.

    python -m examples.policy.evaluate pick_ball.onnx --layouts 100 --proof slow
    python -m examples.policy.evaluate scripted --proof none

A success is a ball that is held and 0.1 m higher within 20 s of cell time, by the ground truth of the simulated world.
`--proof none` executes rows as they are, with straight interpolation. Else each chunk is proved before the arm
moves, as the task `policy_runner` does, but without its latency.
"""

import argparse
import asyncio
import json
import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from applications.policy.decoding import decode
from applications.policy.interface import Chunk, MotionState, Observation, PolicyFailed
from applications.policy.proof import ChunkProver, ProofOptions
from applications.policy.sources.onnx_file import OnnxPolicy
from applications.policy.sources.settings import SourceConfig
from common.hardware.interface import Limits
from common.planning.trajectory import TimedPath, sample
from examples.policy import scripted
from examples.policy.simulated_pick import CYCLE, SimulatedPick, policy_cell, scene

LIMIT = 20.0  # [s]
PERIOD = 0.4  # [s] between chunks
MOVED, MOVED_SEED = 2.0, 500  # [s] at which the ball is moved, and where: the layout of this seed and more
Policy = Callable[[Observation], Chunk]


def load_policy(name: str) -> Policy:
    """Return the scripted policy, or a network by the path of its file."""
    if name == "scripted":
        return scripted.policy
    network = OnnxPolicy(SourceConfig(onnx=name, timeout=60), policy_cell())
    return lambda observation: asyncio.run(network.infer(observation))


class Direct:
    """Executes rows as they are."""

    def __init__(self, pick: SimulatedPick) -> None:
        self.pick, self.causes = pick, Counter()

    def follow(self, rows: np.ndarray, rate: float) -> None:
        """Execute the rows of one period."""
        times = np.arange(1, round(PERIOD / CYCLE) + 1) * CYCLE
        at = np.arange(len(rows) + 1) / rate
        path = np.vstack([self.pick.q, rows])
        for t in times:
            self.pick.step(np.array([np.interp(t, at, column) for column in path.T]))


class Proved:
    """Executes what of a chunk is proved, joined to the motion that is executed."""

    def __init__(self, pick: SimulatedPick, prover: ChunkProver) -> None:
        self.pick, self.prover, self.causes = pick, prover, Counter()
        self._state = MotionState(pick.q, 0 * pick.q, 0 * pick.q)
        self._path = TimedPath(np.array([0.0, 1e-3]), np.array([pick.q] * 2), *np.zeros((2, 2, pick.robot.dof)))
        self._began = pick.now

    def follow(self, rows: np.ndarray, rate: float) -> None:
        """Prove a chunk, and execute the motion for one period; without a new one, the end of the one before."""
        motion = self.prover.prove(self._state, rows, np.arange(1, len(rows) + 1) / rate)
        if motion.violation is not None:
            self.causes[motion.violation.cause] += 1
        if motion.slowed > 1:
            self.causes["slowed"] += 1
        if motion.moving > 0:
            self._path = TimedPath(motion.times, motion.positions, motion.velocities, motion.accelerations)
            self._began = self.pick.now
        for _ in range(round(PERIOD / CYCLE)):
            t = min(self.pick.now + CYCLE - self._began, self._path.duration)
            self.pick.step(sample(self._path, [t])[0])
        t = min(self.pick.now - self._began, self._path.duration)
        columns = [np.array([np.interp(t, self._path.times, column) for column in values.T])
                   for values in (self._path.velocities, self._path.accelerations)]
        self._state = MotionState(self.pick.q, *columns)


def prover_of(pick: SimulatedPick, on_violation: str) -> ChunkProver:
    """Return the prover for the arm among the fixtures."""
    robot = pick.robot
    limits = Limits(tuple(robot.joint_names), robot.lower, robot.upper, robot.velocity, robot.acceleration, None,
                    robot.jerk)
    prover = ChunkProver(robot, limits, ProofOptions(on_violation=on_violation))
    prover.set_scene(scene(), pick.q, width=robot.config.gripper.max_width)
    return prover


def attempt(policy: Policy, seed: int, proof: str, moved: bool = False) -> dict:
    """Return the result of one layout; `moved`: the ball is put where another layout has it after `MOVED` seconds."""
    pick = SimulatedPick(seed)
    there = SimulatedPick(MOVED_SEED + seed).ball if moved else None
    arm = Direct(pick) if proof == "none" else Proved(pick, prover_of(pick, proof))
    ball, failed = pick.ball.round(3).tolist(), ""
    while pick.now < LIMIT and not pick.lifted:
        if there is not None and pick.now > MOVED:
            pick.move_ball(*there[:2])
            there = None
        observation = pick.observe()
        try:
            chunk = policy(observation)
            rows, widths = decode(chunk, observation, pick.robot)
        except PolicyFailed as why:
            failed = str(why)
            break
        pick.command(0.0 if widths[: round(PERIOD * chunk.rate)].mean() < pick.robot.config.gripper.max_width / 2
                     else pick.robot.config.gripper.max_width)
        arm.follow(rows, chunk.rate)
    return {"seed": seed, "success": pick.lifted, "seconds": round(pick.now, 2), "ball": ball, "failed": failed,
            "contacts": pick.contacts, "limits_broken": pick.limits_broken, "causes": dict(arm.causes)}


def interval(successes: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a share (Wilson, 1927)."""
    z, p = 1.959964, successes / count
    middle = (p + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * math.sqrt(p * (1 - p) / count + z * z / (4 * count * count))
    return max(middle - half, 0.0), min(middle + half, 1.0)


def summary(results: list[dict]) -> dict:
    """Return the figures of all layouts."""
    done = [each for each in results if each["success"]]
    low, high = interval(len(done), len(results))
    causes = sum((Counter(each["causes"]) for each in results), Counter())
    return {"layouts": len(results), "successes": len(done), "interval": [round(low, 3), round(high, 3)],
            "median_seconds": float(np.median([each["seconds"] for each in done])) if done else None,
            "layouts_with_contact": sum(each["contacts"] > 0 for each in results),
            "layouts_with_broken_limits": sum(each["limits_broken"] > 0 for each in results), "causes": dict(causes)}


def write_figures(network: str, what: str, figures: dict) -> None:
    """Write figures to the card of a network."""
    path = Path(network).with_suffix(".json")
    card = json.loads(path.read_text(encoding="utf-8"))
    card["training"].setdefault("evaluation", {})[what] = figures
    path.write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    """Evaluate, and print the failures and the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", help="scripted, or an .onnx file with its card")
    parser.add_argument("--layouts", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="seed of the first layout; demonstrations begin at 100000")
    parser.add_argument("--proof", choices=("none", "shorten", "slow", "refuse"), default="slow")
    parser.add_argument("--moved", action="store_true", help="move the ball while the arm is on its way to it")
    parser.add_argument("--card", action="store_true", help="write the figures to the card of the network")
    given = parser.parse_args()
    policy, results = load_policy(given.policy), []
    for seed in range(given.first, given.first + given.layouts):
        results.append(attempt(policy, seed, given.proof, given.moved))
        if not results[-1]["success"] or results[-1]["contacts"] or results[-1]["limits_broken"]:
            print(json.dumps(results[-1]), flush=True)
    figures = summary(results)
    print(json.dumps(figures))
    if given.card:
        last = given.first + given.layouts - 1
        write_figures(given.policy, f"layouts {given.first} to {last}, proof {given.proof}"
                      f"{', moved ball' if given.moved else ''}", figures)


if __name__ == "__main__":
    main()
