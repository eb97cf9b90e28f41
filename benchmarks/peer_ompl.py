"""Runs in an environment of its own, which has OMPL and pinocchio and nothing of this project: see benchmarks.peers.

Reads a line of JSON for the robot, then one for each problem; answers each with a line. RRT-Connect and OMPL's own
simplification, states asked of coal about the convex hulls of the links.
"""

import json
import sys
import time
from collections.abc import Callable
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou

BUDGET = 60.0  # [s]


class Robot:
    """Hulls and disabled pairs; solids come and go."""

    def __init__(self, problem: dict[str, Any]) -> None:
        """Of the URDF, its locked joints being fixed."""
        self.model = pin.buildModelFromXML(problem["urdf"])
        self.hulls = pin.buildGeomFromUrdfString(
            self.model, problem["urdf"], pin.GeometryType.COLLISION, package_dirs=problem["packages"])
        for one in self.hulls.geometryObjects:
            if isinstance(one.geometry, coal.BVHModelBase):
                one.geometry.buildConvexRepresentation(True)
                one.geometry = one.geometry.convex
        links = [self.model.frames[one.parentFrame].name for one in self.hulls.geometryObjects]
        disabled = {frozenset(pair) for pair in problem["disabled"]}
        for i, a in enumerate(links):
            for j, b in enumerate(links[:i]):
                if a != b and frozenset((a, b)) not in disabled:
                    self.hulls.addCollisionPair(pin.CollisionPair(j, i))
        self.moving = [i for i, link in enumerate(links) if link not in problem["base"]]
        joints = [self.model.getJointId(name) for name in problem["joints"]]
        self.order = [self.model.joints[joint].idx_q for joint in joints]
        self.lower = self.model.lowerPositionLimit[self.order]
        self.upper = self.model.upperPositionLimit[self.order]
        self.step = problem["step"]

    def among(self, solids: list[dict[str, Any]]) -> Callable[[Any], bool]:
        """Whether a state is free among the solids, as a function."""
        geometry = self.hulls.copy()
        for solid in solids:
            shape = {"box": coal.Box, "cylinder": coal.Cylinder, "sphere": coal.Sphere}[solid["shape"]]
            T = np.array(solid["T"])
            number = geometry.addGeometryObject(pin.GeometryObject(
                solid["name"], 0, 0, pin.SE3(T), shape(*solid["dimensions"])))
            for link in self.moving:
                geometry.addCollisionPair(pin.CollisionPair(link, number))
        data, shapes = self.model.createData(), pin.GeometryData(geometry)
        q, order, dof = pin.neutral(self.model), self.order, len(self.order)

        def free(state: Any) -> bool:
            q[order] = state[0:dof]
            return not pin.computeCollisions(self.model, data, geometry, shapes, q, True)

        return free


def solve(robot: Robot, problem: dict[str, Any]) -> list[list[float]] | None:
    """Waypoints (N, dof) [rad]; None where none is found."""
    ou.RNG.setSeed(problem["seed"])
    dof = len(robot.order)
    space, bounds = ob.RealVectorStateSpace(dof), ob.RealVectorBounds(dof)
    for i in range(dof):
        bounds.setLow(i, float(robot.lower[i]))
        bounds.setHigh(i, float(robot.upper[i]))
    space.setBounds(bounds)
    setup = og.SimpleSetup(space)
    si = setup.getSpaceInformation()
    setup.setStateValidityChecker(robot.among(problem["solids"]))
    si.setStateValidityCheckingResolution(robot.step / space.getMaximumExtent())
    setup.setPlanner(og.RRTConnect(si))
    ends = []
    for place in (problem["start"], problem["goal"]):
        state = space.allocState()
        state[0:dof] = place
        ends.append(state)
    setup.setStartAndGoalStates(*ends)
    end = time.perf_counter() + BUDGET
    found = setup.solve(ob.PlannerTerminationCondition(lambda: time.perf_counter() > end))
    if found.getStatus() != ob.PlannerStatus.EXACT_SOLUTION:
        return None
    setup.simplifySolution()
    return [list(map(float, state[0:dof])) for state in setup.getSolutionPath().getStates()]


def main() -> None:
    """Answer problems until the input ends."""
    ou.setLogLevel(ou.LogLevel.LOG_NONE)
    robot = Robot(json.loads(sys.stdin.readline()))
    print(json.dumps({"ready": True}), flush=True)
    for line in sys.stdin:
        problem = json.loads(line)
        began = time.perf_counter()
        path = solve(robot, problem)
        print(json.dumps({"seconds": time.perf_counter() - began, "path": path, "error": ""}), flush=True)


main()  # it is run only, never imported
