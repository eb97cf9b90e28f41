"""How exact balls are found in any light: random scenes with lamp, shadow, colour of light, noise, lens and arm.

    python benchmarks/light.py [--side] [--scenes 200] [--seed 1] [--save FOLDER]

Each scene has one to seven balls, a lamp of 100 to 10000 lx and 2700 to 10000 K from one side, in whose shadow the
other side lies, a camera that exposes by itself, a lens with distortion that is taken out again, and the arm about
home. The camera is above the table, or where docs/detection.md has one at the side. Balls that reach into
what the arm or the container hides, or out of the picture, count neither as found nor as missed.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

import cv2
import numpy as np

from applications.pick_place.detector import Detector, DetectorOptions
from benchmarks.detection import objects
from common.config import Cell, Light, Scenery, Surroundings, load_cell
from common.messages import Header, JointState, WorldObjects
from common.perception.occlusion import RobotSilhouettes
from common.perception.pinhole import silhouettes as outlines
from common.robot.model import RobotModel
from common.sim.camera import CameraParameters, Lens, SimulatedCamera
from drivers.mujoco.gl import select_gl

DISTORTION = [0.08, -0.15, 0.001, -0.001]
SIDE = {"position": (1.15, 0.0, 0.85), "rpy": (-2.4, 0.0, 1.5708)}  # of docs/detection.md
FAR = 15.0  # [mm] what is found further from any ball than that is no ball


def balls(rng: np.random.Generator, around: Surroundings) -> np.ndarray:
    """Places (n, 3) [m] wholly in view from above, apart and clear of the box."""
    found: list[tuple[float, float, float]] = []
    count = int(rng.integers(1, 8))
    while len(found) < count:
        x, y = rng.uniform((0.09, -0.44), (0.71, 0.44))
        box = around.container
        clear = max(abs(x - box.x), abs(y - box.y)) > box.half_side + 0.09
        if clear and all(math.dist((x, y), one[:2]) >= 0.065 for one in found):
            found.append((float(x), float(y), around.ball_radius))
    return np.array(found)


def scenery(rng: np.random.Generator, simulator: str) -> Scenery:
    """A lamp from one side, and light from everywhere that is a tenth to a half of it."""
    lux, turn, height = 10 ** rng.uniform(2, 4), rng.uniform(0, 2 * math.pi), math.radians(rng.uniform(30, 80))
    at = (0.4 + 2 * math.cos(turn) * math.cos(height), 2 * math.sin(turn) * math.cos(height), 2 * math.sin(height))
    lamp = Light(position=at, aim=(0.4, 0.0, 0.0), illuminance=lux, parallel=bool(rng.integers(2)),
                 temperature=float(rng.choice([2700, 4000, 6500, 10_000])))
    return Scenery(simulator=simulator, lights={"lamp": lamp}, ambient=float(lux * rng.uniform(0.1, 0.5)))


def at_random(robot: RobotModel, rng: np.random.Generator) -> JointState:
    """The arm about home."""
    locked = robot.config.locked_joints
    q = robot.named("home") + rng.uniform(-0.5, 0.5, robot.dof) * np.array([3.0, *[1.0] * (robot.dof - 1)])
    return JointState(header=Header(), name=[*robot.joint_names, *locked], position=[*q.tolist(), *locked.values()])


def main() -> None:
    """Print errors, misses and surplus."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--side", action="store_true", help="with the camera at the side")
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--save", type=Path, help="folder for the pictures in which something is wrong")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    cell: Cell = load_cell("panda")
    camera = cell.world.camera.model_copy(update={"d": DISTORTION, **(SIDE if options.side else {})})
    around = Surroundings.model_validate({f: getattr(cell.world, f) for f in Surroundings.model_fields})
    around = around.model_copy(update={"cameras": {"camera": camera}, "camera": camera})
    robot = RobotModel.load(cell.robot)
    silhouettes, detector = RobotSilhouettes(robot, around.ball_radius), Detector(around, DetectorOptions())
    print(f"drawn by {select_gl() or 'rays'}")
    errors: list[tuple[float, str]] = []
    missed, refused, surplus, reported, shown, spent = 0, 0, 0, 0, 0, 0.0
    for number in range(options.scenes):
        rng = np.random.default_rng((options.seed, number))
        places, light, joints = balls(rng, around), scenery(rng, "mujoco"), at_random(robot, rng)
        sensor = CameraParameters(auto_exposure=True, full_well=10_000, white_balance="off" if number % 2 else "auto")
        eye = SimulatedCamera(around, light, [cell.robot], sensor, rng, plain=True,
                              lens=Lens(camera, distorted=True, rectify=True))
        picture = eye.capture(WorldObjects(objects=objects(places, around)), [joints], 0).colour
        q = robot.order(joints.name, joints.position)
        assert q is not None
        hidden = silhouettes.occlusion(eye.pinhole, [q])
        began = time.thread_time()
        found = detector.detect(picture, eye.pinhole)
        spent += time.thread_time() - began
        seen = [d for d in found if not hidden.touches([d.position], around.ball_radius)[0]]
        shapes = outlines(eye.pinhole, places, around.ball_radius, 32)
        whole = np.array([bool(eye.pinhole.in_image(shape).all())
                          and not any(detector.resting.shows_container(eye.pinhole, pixel) for pixel in shape)
                          for shape in shapes])
        clear = places[whole & ~hidden.touches(places, around.ball_radius)]
        odd = [one for one in detector.outliers if not hidden.touches([one.position], around.ball_radius)[0]]
        lamp = light.lights["lamp"]
        label = f"{lamp.illuminance:.0f} lx, {lamp.temperature:.0f} K"
        wrong = []
        for place in clear:
            # Of all detections: a ball next to an occluded one may be detected as a partly occluded one.
            near = min((math.dist(place[:2], d.position[:2]) * 1e3 for d in found), default=1e3)
            if near > FAR:
                missed += 1
                refused += any(math.dist(place[:2], one.position[:2]) * 1e3 < 2 * FAR for one in odd)
                wrong.append(f"missed {place[:2].round(3)}")
            else:
                errors.append((near, label))
                if near > 3:
                    wrong.append(f"{near:.1f} mm at {place[:2].round(3)}")
        extra = [d for d in seen if all(math.dist(place[:2], d.position[:2]) * 1e3 > FAR for place in places)]
        surplus += len(extra)
        reported += len(odd)
        wrong += [f"at ({one.position[0]:.3f}, {one.position[1]:.3f}) {one.reason}" for one in odd]
        wrong += [f"surplus at ({d.position[0]:.3f}, {d.position[1]:.3f})" for d in extra]
        shown += len(clear)
        if wrong:
            print(f"scene {number}: {label}, {'; '.join(wrong)}")
            if options.save:
                options.save.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(options.save / f"{number}.png"), picture)
    off = np.array([error for error, _ in errors])
    print(f"{shown} balls in {options.scenes} scenes: median {np.median(off):.2f}, p99 {np.percentile(off, 99):.2f}, "
          f"most {off.max():.2f} mm; over 3 mm {int((off > 3).sum())}, missed {missed} "
          f"(of these reported as no ball {refused}), surplus {surplus}, reported as no ball {reported}; "
          f"{1e3 * spent / options.scenes:.1f} ms a picture")


if __name__ == "__main__":
    main()
