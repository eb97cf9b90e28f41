"""Record demonstrations: the project's planner picks one ball in many random layouts, on a clock of its own.

    python -m examples.policy.demonstrate demonstrations.npz --episodes 2000

The planner knows where the ball is; what is recorded is what a policy sees, and the set-points of the arm. Three of
four episodes start somewhere else than at home: high or low, next to the ball, with closed fingers. So the data show
how to come back from there. Arrays of the file, with n frames at 20 Hz of e episodes:
    episode (n,), positions (n, 7) [rad], velocities (n, 7) [rad/s], gripper (n,) [m], command (n,) [m],
    image (n,) index into images (k, 96, 96, 3) RGB, ball (e, 3) [m] and seed (e,), for training and its figures.
"""

import argparse
import math
from pathlib import Path

import numpy as np

from common.messages import JointGoal, PlanRequest, PoseGoal
from common.planning.ik import solve_ik
from common.planning.trajectory import sample, timed_path
from common.robot.transforms import matrix_to_pose, tool_down
from examples.policy.simulated_pick import CYCLE, SimulatedPick, pipeline, scene

FIRST_SEED = 100_000  # of the layouts of demonstrations; evaluations use 0 to 999
FRAME = 5  # cycles
ABOVE, LIFTED = 0.15, 0.20  # [m] height before the descent, and with the ball
YAWS = (0.0, 0.5, -0.5, 1.0, -1.0, 1.5, -1.5)  # [rad] of the fingers; the first that touches nothing
SCALES = {"velocity_scaling": 0.25, "acceleration_scaling": 0.15}
WAIT = 1.0  # [s] for the fingers
PAUSE = 0.8  # [s] at rest with the ball


class NoDemonstration(Exception):
    """The planner has no motion for a layout."""


class Recorder:
    """A pick that is recorded."""

    def __init__(self, pick: SimulatedPick) -> None:
        self.pick, self.rows, self.images = pick, [], []
        self.cycles, self.command = 0, pick.width

    def step(self, q: np.ndarray) -> None:
        """Record every `FRAME` cycles, then advance to a set-point."""
        if self.cycles % FRAME == 0:
            seen = self.pick.observe()
            image = seen.images["camera"]
            if not self.images or not np.array_equal(image, self.images[-1]):
                self.images.append(image)
            self.rows.append([*seen.positions, *seen.velocities, seen.gripper, self.command, len(self.images) - 1])
        self.cycles += 1
        self.pick.step(q)

    def fingers(self, width: float) -> None:
        """Command a width [m]."""
        self.command = width
        self.pick.command(width)

    def wait(self, seconds: float, until=lambda: False) -> None:
        """Stay at rest for a time [s], or until a condition is met."""
        q = self.pick.q
        for _ in range(round(seconds / CYCLE)):
            if until():
                return
            self.step(q)

    def move(self, planner: str, goal: JointGoal | PoseGoal, scale: float = 1.0) -> None:
        """Follow a motion of a planner, slower by `scale`.

        Raises:
            NoDemonstration: there is none.
        """
        request = PlanRequest(id="demonstration", start=self.pick.q.tolist(), goal=goal, planner=planner,
                              straight=planner == "lin", **{name: scale * value for name, value in SCALES.items()})
        answer = pipeline().plan(request, scene())
        if not answer.ok:
            raise NoDemonstration(answer.message)
        path = timed_path(answer.trajectory)
        for q in sample(path, np.minimum(np.arange(CYCLE, path.duration + CYCLE, CYCLE), path.duration)):
            self.step(q)


def grasp_of(pick: SimulatedPick, ball: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the yaw of the fingers [rad], and joint positions (7,) [rad] above a ball (3,) [m] and at it.

    Raises:
        NoDemonstration: it is out of reach, or every yaw touches something.
    """
    azimuth = math.atan2(ball[1], ball[0])
    for turn in YAWS:
        seed = pick.robot.named("home")
        seed[0], seed[6] = azimuth, seed[6] - turn
        above = solve_ik(pick.robot, tool_down(*ball[:2], ABOVE, azimuth + turn), seed, restarts=0)
        low = None if above is None else solve_ik(
            pick.robot, tool_down(*ball, azimuth + turn), above, restarts=0)
        if low is not None and np.abs(low - above).max() < 0.7 and not (pick.collides(above) or pick.collides(low)):
            return azimuth + turn, above, low
    raise NoDemonstration("no grasp")


def start_of(pick: SimulatedPick, low: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """Return joint positions (7,) [rad] and the width of the fingers [m] where an episode starts."""
    robot, home, ball = pick.robot, pick.robot.named("home"), pick.ball
    kind = rng.choice(4)
    if kind == 0:
        return home + rng.normal(0, 0.02, 7), 0.08
    while True:
        azimuth, radius = rng.uniform(-1.4, 1.4), rng.uniform(0.3, 0.72)
        x, y, z = radius * math.cos(azimuth), radius * math.sin(azimuth), rng.uniform(0.06, 0.5)
        if kind == 2:  # near the ball
            angle, away = rng.uniform(0, 2 * math.pi), rng.uniform(0.03, 0.12)
            x, y, z = ball[0] + away * math.cos(angle), ball[1] + away * math.sin(angle), rng.uniform(0.035, 0.25)
        seed = home.copy()
        seed[0] = math.atan2(y, x)
        q = solve_ik(robot, tool_down(x, y, z, seed[0] + rng.normal(0, 0.2)), seed, restarts=0)
        if q is not None:
            q = q + rng.normal(0, 0.03, 7)
            if robot.within_limits(q) and not pick.collides(q):
                return q, float(rng.choice([0.08, 0.08, 0.0]))


def demonstrate(seed: int) -> tuple[Recorder, np.ndarray]:
    """Return the recorded pick of a layout, and where the ball was (3,) [m].

    Raises:
        NoDemonstration: the planner has no motion, or the ball was not lifted.
    """
    pick, rng = SimulatedPick(seed), np.random.default_rng(seed)
    ball = pick.ball
    yaw, above, low = grasp_of(pick, ball)
    start, width = start_of(pick, low, rng)
    pick.place(start, width)
    out = Recorder(pick)
    out.fingers(0.08)
    out.move("ptp", JointGoal(positions=above.tolist()))
    out.move("lin", PoseGoal(pose=matrix_to_pose(tool_down(*ball, yaw))), 0.6)
    out.fingers(0.0)
    out.wait(WAIT, lambda: pick.held)
    out.wait(0.15)
    out.move("lin", PoseGoal(pose=matrix_to_pose(tool_down(*ball[:2], LIFTED, yaw))))
    out.wait(PAUSE)
    if not pick.lifted or pick.contacts:
        raise NoDemonstration("not lifted" if not pick.lifted else "touched something")
    return out, ball


def main() -> None:
    """Record the episodes, and say how many layouts had none."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help=".npz file")
    parser.add_argument("--episodes", type=int, default=2000)
    parser.add_argument("--first", type=int, default=FIRST_SEED, help="seed of the first layout")
    given = parser.parse_args()
    rows, images, episodes, balls, seeds, failed = [], [], [], [], [], {}
    seed = given.first
    while len(balls) < given.episodes:
        try:
            made, ball = demonstrate(seed)
        except NoDemonstration as why:
            failed[seed] = str(why)
        else:
            table = np.array(made.rows)
            table[:, -1] += len(images)
            rows.append(table)
            images += made.images
            episodes.append(np.full(len(table), len(balls)))
            balls.append(ball)
            seeds.append(seed)
            if len(balls) % 100 == 0:
                print(f"{len(balls)} episodes, {len(failed)} layouts without", flush=True)
        seed += 1
    table = np.concatenate(rows)
    np.savez_compressed(
        given.out, episode=np.concatenate(episodes), positions=table[:, :7], velocities=table[:, 7:14],
        gripper=table[:, 14], command=table[:, 15], image=table[:, 16].astype(int), images=np.array(images),
        ball=np.array(balls), seed=np.array(seeds))
    for number, why in list(failed.items())[:20]:
        print(f"layout {number}: {why}")
    print(f"{given.out}: {len(balls)} episodes, {len(table)} frames; {len(failed)} layouts without a demonstration")


if __name__ == "__main__":
    main()
