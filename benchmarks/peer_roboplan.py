"""Runs in an environment of its own, which has roboplan and nothing of this project: see benchmarks.peers.

Reads a line of JSON for the robot, then one for each problem; answers each with a line.
"""

import json
import sys
import time
from itertools import combinations

import numpy as np
from roboplan.core import (
    Box,
    Cylinder,
    JointConfiguration,
    PathShortcutter,
    PathShortcuttingOptions,
    Scene,
    Sphere,
    loadUrdfSceneDescriptionFromXml,
)
from roboplan.rrt import RRT, RRTOptions

COLOR = np.array([0.5, 0.5, 0.5, 1.0])
GROUP = "planned"


def main() -> None:
    """Answer problems until the input ends."""
    robot = json.loads(sys.stdin.readline())
    scene = Scene("peer", loadUrdfSceneDescriptionFromXml(robot["urdf"], robot["packages"]))
    scene.addGroup(GROUP, robot["joints"])
    scene.setCollisions([tuple(pair) for pair in robot["disabled"]], False)
    step = robot["step"]
    print(json.dumps({"ready": True}), flush=True)
    there: list[str] = []
    for line in sys.stdin:
        problem = json.loads(line)
        for name in there:
            scene.removeGeometry(name)
        there = []
        for solid in problem["solids"]:
            kind, sides = solid["shape"], solid["dimensions"]
            T = np.asfortranarray(np.array(solid["T"]))
            if kind == "box":
                scene.addBoxGeometry(solid["name"], "universe", Box(*sides), T, COLOR)
            elif kind == "sphere":
                scene.addSphereGeometry(solid["name"], "universe", Sphere(*sides), T, COLOR)
            else:
                scene.addCylinderGeometry(solid["name"], "universe", Cylinder(*sides), T, COLOR)
            there.append(solid["name"])
        apart = [(base, name) for base in robot["base"] for name in there] + list(combinations(there, 2))
        scene.setCollisions(apart, False)
        options = RRTOptions(
            group_name=GROUP, max_nodes=1_000_000, max_connection_distance=1.0, collision_check_step_size=step,
            max_planning_time=60.0, rrt_connect=True,
        )
        start, goal = (JointConfiguration(robot["joints"], np.array(problem[end])) for end in ("start", "goal"))
        began = time.perf_counter()
        path, error = None, ""
        try:
            rrt = RRT(scene, options)
            rrt.setRngSeed(problem["seed"])
            found = rrt.plan(start, goal)
            if found is not None:
                shorter = PathShortcutter(scene, PathShortcuttingOptions(
                    group_name=GROUP, max_step_size=step, seed=problem["seed"]))
                path = [list(map(float, q)) for q in shorter.shortcut(found).positions]
        except RuntimeError as problem_of_its_own:
            error = str(problem_of_its_own)
        print(json.dumps({"seconds": time.perf_counter() - began, "path": path, "error": error}), flush=True)


main()  # it is run only, never imported
