"""Figures of the world with physics: runs by seeds, how exactly servos follow, the grip force needed, what it costs.

`python -m benchmarks.physics` does all but the runs; `--seeds 1-20` has the first cell's table cleared on the virtual
clock with a random layout for each seed, and counts by the world's own truth. Needs the extra `physics`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from common.config import World, load_cell
from common.hardware.interface import Limits
from common.planning.ik import solve_ik
from common.robot.model import RobotModel
from common.robot.transforms import tool_down
from common.sim.interface import load_world
from drivers.mujoco.scene import TIMESTEP
from drivers.mujoco.world import PhysicsWorld
from tests.simulated.visited import SimulatedCell

Array = NDArray[np.float64]
PERIOD = 0.01  # [s] of control
PHYSICS = "world.simulator=mujoco"
SETTLED = 2e-3  # [rad] the tolerance of a goal


class Arm:
    """An arm in its world, driven by hand."""

    def __init__(self, cell: str, objects: Sequence[dict[str, Any]] | None = None) -> None:
        """The cell's own world, or one with these objects alone."""
        config = load_cell(cell, [PHYSICS])
        world = config.world
        if objects is not None:
            world = World.model_validate({"fixtures": world.fixtures, "objects": objects, "simulator": "mujoco"})
        self.robot = robot = RobotModel.load(config.robot)
        limits = Limits(tuple(robot.joint_names), robot.lower, robot.upper, robot.velocity, robot.acceleration)
        made = load_world(world, world.objects, None, config.robot.gripper)
        assert isinstance(made, PhysicsWorld)
        self.world, self.q, self.now = made, robot.named("home"), 0.0
        self.arm = made.hardware(robot, limits, self.q)

    def wait(self, seconds: float) -> Array:
        """Joints (n, dof) [rad] while nothing is sent."""
        found = []
        for _ in range(round(seconds / PERIOD)):
            self.now += PERIOD
            found.append(self.arm.read(self.now)[0])
        return np.array(found)

    def move(self, to: Array, scaling: float = 1.0) -> Array:
        """Go there by a cubic in time, as fast as the limits allow; (n, dof) measured less commanded [rad]."""
        way, start, robot = to - self.q, self.q, self.robot
        seconds = scaling * max(float((1.5 * np.abs(way) / robot.velocity).max()),
                                float(np.sqrt((6 * np.abs(way) / robot.acceleration).max())), PERIOD)
        errors = []
        for t in np.arange(PERIOD, seconds + PERIOD, PERIOD):
            share = min(t / seconds, 1.0)
            self.now += PERIOD
            measured = self.arm.read(self.now)[0]
            self.q = start + (3 * share**2 - 2 * share**3) * way
            errors.append(measured - self.q)
            self.arm.write(self.q, (6 * share - 6 * share**2) / seconds * way, self.now)
        self.arm.write(to, 0 * to, self.now)
        self.q = to
        return np.array(errors)


def following(cell: str, motions: int = 20) -> None:
    """How far joints are behind their set-points, which without servos they are not at all, and when they settle."""
    arm, rng = Arm(cell, []), np.random.default_rng(1)
    largest, ends, settled = np.zeros(arm.robot.dof), np.zeros(arm.robot.dof), []
    for _ in range(motions):
        to = arm.robot.named("home") + rng.uniform(-0.5, 0.5, arm.robot.dof)
        largest = np.maximum(largest, np.abs(arm.move(np.clip(to, arm.robot.lower, arm.robot.upper))).max(axis=0))
        rest = np.abs(arm.wait(1.0) - arm.q)
        late = np.flatnonzero((rest > SETTLED).any(axis=1))
        settled.append(PERIOD * (late[-1] + 1) if len(late) else 0.0)
        ends = np.maximum(ends, rest[-1])
    print(f"{cell}: {motions} motions at the full limits")
    print("  largest error while moving [mrad]:", np.round(1e3 * largest, 1).tolist())
    print("  1 s after the end [mrad]:         ", np.round(1e3 * ends, 2).tolist())
    print(f"  within {1e3 * SETTLED:g} mrad: after {1e3 * np.median(settled):.0f} ms (median), "
          f"{1e3 * max(settled):.0f} ms (worst)")


def grip(cell: str, mass: float) -> None:
    """The least force with which a sphere is carried through a swift motion, and how far it slips."""
    print(f"{cell}: a sphere of 60 mm and {1e3 * mass:g} g, lifted and carried at the full limits")
    for effort in (0.25, 0.5, 1.0, 2.0, 5.0, 20.0, 70.0):
        arm = Arm(cell, [{"id": "it", "shape": "sphere", "radius": 0.03, "x": 0.45, "y": 0.0, "mass": mass}])
        for z in (0.15, 0.03):
            found = solve_ik(arm.robot, tool_down(0.45, 0.0, z), arm.q)
            assert found is not None
            arm.move(found, 2.0)
            arm.wait(0.3)
        assert arm.arm.gripper is not None
        arm.arm.gripper.command(0.0, arm.now, effort)
        arm.wait(0.8)
        before = _in_hand(arm)
        for x, y, z in ((0.45, 0.0, 0.3), (0.45, 0.35, 0.3), (0.45, -0.35, 0.3)):
            found = solve_ik(arm.robot, tool_down(x, y, z), arm.q)
            assert found is not None
            arm.move(found)
        arm.wait(0.3)
        slipped = float(np.linalg.norm(_in_hand(arm) - before))
        holds = arm.arm.gripper.read(arm.now).holding
        became = f"held, moved {1e3 * slipped:.1f} mm in the hand" if holds else "lost"
        print(f"  {effort:5.2f} N: {became}")


def _in_hand(arm: Arm) -> Array:
    """Centre (3,) of the object in the frame of the tool as it is measured [m]."""
    T = arm.robot.fk(arm.arm.read(arm.now)[0])
    cell, data = arm.world._built
    return np.asarray(T[:3, :3].T @ (cell.pose_of(data, "it")[:3, 3] - T[:3, 3]))


def cost(cell: str, seconds: float = 5.0) -> None:
    """Time of a step, of a cycle with its looks, and until the world is there."""
    began = time.perf_counter()
    arm = Arm(cell)
    there = time.perf_counter() - began
    arm.wait(0.5)
    began = time.perf_counter()
    arm.wait(seconds)
    whole = time.perf_counter() - began
    built, data = arm.world._built
    began = time.perf_counter()
    mujoco.mj_step(built.model, data, round(seconds / TIMESTEP))
    bare = time.perf_counter() - began
    print(f"{cell}: there after {there:.2f} s (cell and robot included); {1e6 * bare * TIMESTEP / seconds:.0f} us a "
          f"step, {seconds / whole:.0f} times real time with control and looks at all objects")


def runs(first: int, last: int) -> None:
    """Whole cells on the virtual clock, a random layout for each seed."""
    cleared = []
    for seed in range(first, last + 1):
        try:
            run = SimulatedCell("panda", [PHYSICS, "world.layout=random", f"seed={seed}"], seed=seed)
        except AssertionError as problem:
            print(f"  seed {seed}: {str(problem).splitlines()[0]}")
            cleared.append(False)
            continue
        truth, summary = run.summary["truth"], run.summary
        cleared.append(summary["state"] == "DONE" and truth["on_table"] == truth["elsewhere"] == 0)
        print(f"  seed {seed}: {summary['state']}, {truth['in_box']} in the box, {truth['on_table']} on the table, "
              f"{truth['elsewhere']} elsewhere, {summary['seconds']['task']:.1f} s")
    print(f"cleared {sum(cleared)} of {len(cleared)}")


def main() -> None:
    """Print all figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", metavar="A-B", help="runs of whole cells, in the place of the other figures")
    seeds = parser.parse_args().seeds
    if seeds:
        first, _, last = seeds.partition("-")
        runs(int(first), int(last or first))
        return
    for cell in ("panda", "ur5"):
        cost(cell)
        following(cell)
    grip("panda", 0.1)


if __name__ == "__main__":
    main()
