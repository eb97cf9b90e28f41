"""The pick-and-place task: take the nearest takable ball to the container until none is left.

Its state is read from gripper, planning scene and image; `common/tasks/engine.py` does the rest.
"""

from __future__ import annotations

import math
import re

from pydantic import BaseModel

from applications.pick_place.ball_places import ViewingPoses
from applications.pick_place.choice import (
    Choice,
    ObjectCounter,
    Pick,
    PickPlaceView,
    ReleasePositions,
    Spots,
    same_place,
)
from applications.pick_place.grasping import Config
from applications.pick_place.motion_sequences import MotionSequences
from applications.pick_place.topics import PickPlaceStatus
from common import messages as m
from common.robot.home import is_home
from common.tasks.engine import Task
from common.tasks.stages import MISSES, AwaitImage, Cycle, DwellTimer, Grip, Move, Stage

GONE = "the ball is no longer where it was seen"
APPROACH = ("pre-grasp", "descend")  # stages
NUMBER = re.compile(r"[-\d.]+")
MOST = 400  # characters of a message
STANDING = 0.5  # [s] of occlusion before the arm moves aside: images arrive with a delay


class PickPlace(Task[PickPlaceView]):
    """Takes balls to the container."""

    p: Config
    status: PickPlaceStatus

    def __init__(self, config: Config, status: PickPlaceStatus, prefix: str, speed: float = 1.0) -> None:
        """Start with nothing known: see `Task`."""
        super().__init__(config, status, prefix, speed)
        self._around = config.world
        self._sequences = MotionSequences(config, self.gripper)
        self._choice = Choice(config, config.world.container, config.world.ball_radius, lambda: self.status.done)
        self._viewing, self._hidden = ViewingPoses(config), DwellTimer()
        self._counter = ObjectCounter(config)
        self._last_failure = "", ""  # id of the object that the gripper approached, and the reason without numbers
        self._missed = 0  # grasps in a row that closed on nothing

    # --- what to do next -------------------------------------------------------------------------------------

    def decide(self, view: PickPlaceView) -> None:
        """Carry a held object to the container, take the nearest ball, or end."""
        assert view.gripper is not None
        if view.holding and view.gripper.outcome in MISSES:  # another object than intended
            self._drop(view)
        elif view.holding:
            if view.attached:  # else the planning scene is not up to date yet
                self.queue += self._sequences.place_held(self._choice.held(view.attached, view), view.tool)
        elif self._looks_elsewhere(view):
            self.queue += [self.home(view), AwaitImage()]
        elif not self._queue_next(view):
            self._wait_for_the_end(view)

    def decide_ahead(self, running: Stage, view: PickPlaceView) -> None:
        """While a ball is carried across, queue the next one, or the pose from which a camera on the robot looks."""
        waiting = any(stage.cycle is not None and not stage.cycle.started for stage in self.queue)
        if running.name == "across" and self._around.on_hand:
            if not any(isinstance(stage, AwaitImage) for stage in self.queue):
                self.queue += [self.home(view.released()), AwaitImage()]
        elif running.name == "across" and not waiting:
            self._queue_next(view)

    def _looks_elsewhere(self, view: PickPlaceView) -> bool:
        """Return whether a camera on the robot is away from home, and the task is not done."""
        at_home = view.q is not None and is_home(view.q, self.p.robot.named_poses["home"])
        return self._around.on_hand and self.status.state != "DONE" and not at_home

    def _queue_next(self, view: PickPlaceView) -> bool:
        """Queue the stages for the nearest takable ball; return whether there is one."""
        assert view.gripper is not None
        if min(view.stamps) <= self.images_after or self.unseen(view):
            return False
        if self.running is None and not (view.seen and view.seen.unseen):
            self._viewing.found()
        running = _pick_of(self.running.stage) if self.running else None
        box = self._around.container
        cycle = self._choice.next(view, (box.x, box.y) if running else view.tool, [running] if running else [])
        if cycle is None and not running and self._choice.allow_retries():
            # Whether the last descent has a plan depends on the arm posture above it.
            self.queue.append(Move("home", "HOMING", Cycle(), goal=m.JointGoal(named="home")))
            return True
        if cycle is None:
            return False
        if not running and view.gripper.width < self.gripper.max_width - 0.002:
            self.queue.append(self._sequences.open())
        self.queue += self._sequences.pick_and_place(cycle)
        self.wait_timer.reset()
        self.status.message = self.status.overlooked = ""
        return True

    def _wait_for_the_end(self, view: PickPlaceView) -> None:
        """End with DONE after a moment with an empty table, or after the grace period if something cannot be taken."""
        if self.status.state == "DONE" or self._looks_for_more(view):
            return
        left = max(len(view.balls()), len(view.targets))  # one of the two sources may have just started
        done = False
        if unseen := self.unseen(view):
            self.wait_timer.reset()
            self.status.message = unseen
        else:
            # Time of images, not of the clock: without new images the table is not known to be empty.
            seen = max(self.images_after, min(view.stamps))
            done = self.wait_timer.elapsed(bool(left), seen) >= (self.p.grace if left else self.p.empty)
            done = done and self._counter.contained(view) <= self.status.done  # else it is about to be counted
            missing = self._counter.expected - self.status.done - left
            remarks = [view.seen.remark if view.seen else "",
                       f"{missing} that was seen before something fell out of the hand was not seen again"
                       if missing > 0 else ""]
            remark = "; ".join(filter(None, remarks))
            message = f"{left} objects are left that cannot be taken" if left else "the table looks empty"
            self.status.overlooked = f"{message}{':' if left else ', but'} {remark}"[:MOST] if remark else ""
            if min(view.stamps) > self.images_after:  # else the next attempt only waits for an image
                self.status.message = self.status.overlooked or message
        self.status.state, self.status.stage, self.status.subject = "DONE" if done else "IDLE", "", ""

    def unseen(self, view: PickPlaceView) -> str:
        """Return why the newest image cannot be used to decide: it is old, or shows nothing."""
        return super().unseen(view) or view.blind

    def _looks_for_more(self, view: PickPlaceView) -> bool:
        """Return whether part of the table is occluded, so that the task cannot end; move the arm aside to look."""
        why = view.blind or (view.seen.unseen if view.seen else "")
        if super().unseen(view):
            return False
        if not why:
            self._viewing.found()
            self._hidden.reset()
            return False
        self.wait_timer.reset()
        self.status.state, self.status.stage, self.status.subject = "IDLE", "", ""
        self.status.message = why if view.blind else f"{why}: it is not known to be empty"
        waited = self._hidden.elapsed(bool(view.blind), view.now)
        looked = not view.blind and waited >= STANDING and min(view.stamps) > self.images_after
        if looked and (pose := self._viewing.next()):
            self._hidden.reset()
            self.queue += [Move("look", "HOMING", goal=m.JointGoal(positions=pose)), AwaitImage()]
        elif waited >= self.p.look_timeout:
            self.end("ERROR", f"{why}, for {waited:.0f} s: what lies there is not known")
        return True

    # --- what happened ---------------------------------------------------------------------------------------

    def note(self, view: PickPlaceView) -> None:
        """Update the counters of the status."""
        if not self._waits(view):  # the time without a view only counts while the task waits for one
            self._hidden.reset()
        self.status.skipped = self._choice.rejections()
        stages = {self.status.stage, *(stage.name for stage in self.active_stages)}
        releases = "release" in stages or self.deferred_grip == "release"
        # A gripper that closed on nothing hides the object until it is away, or for good if the task ends there.
        hides = {"open", "retreat"} if self._missed else set()
        counts = not stages & ({"close", "lift", "across", "release"} | hides) and self.status.state != "ERROR"
        counts = counts and min(view.stamps) > self.images_after
        self._counter.update(view, self.status, releases=releases, counts_table=counts)

    def _waits(self, view: PickPlaceView) -> bool:
        """Return whether nothing runs and nothing prevents the next decision."""
        assert view.motion is not None
        idle = self.running is None and not self.queue and view.motion.state != "active"
        blocked = self.status.paused or view.motion.held or view.motion.fault or view.motion.stopped
        return idle and self.status.started and not blocked

    def on_restart(self) -> None:
        """Try all viewing poses again: the obstacle may be gone."""
        self._viewing.found()
        self._hidden.reset()
        self._counter.expected = self._missed = 0

    @property
    def memory(self) -> ReleasePositions:
        """Release positions: a ball leaning on others may look as if it lay on the floor."""
        return self._choice.releases

    def remember(self, memory: BaseModel) -> None:
        """Restore the release positions."""
        assert isinstance(memory, ReleasePositions)
        self._choice.releases = memory

    def succeeded(self, stage: Stage, view: PickPlaceView) -> None:
        """Count a released ball."""
        pick = _pick_of(stage)
        if stage.name == "release" and pick is not None:
            self.status.done += 1
            self._missed = 0
            self._counter.released = True
            if self._around.on_hand:
                self.images_after = view.now
            self._choice.released(pick, view)

    def missed(self, stage: Grip, view: PickPlaceView) -> None:
        """Handle a grasp that closed on nothing or on an unexpected width: open, move up and look again.

        After too many in a row the gripper is taken for broken, and the task ends.
        """
        pick = _pick_of(stage)
        assert pick is not None
        self.status.retries += 1
        self._missed += 1
        x, y, _ = pick.target.position
        self.status.message = f"{stage.problem} at ({x:.3f}, {y:.3f})"
        if self._missed >= self.failure_limit:
            self.end("ERROR", f"{self.status.message}; that makes {self._missed} grasps in a row")
            return
        self._choice.missed(pick.target, view.released(), stage.problem)
        self._drop(view)

    def _drop(self, view: PickPlaceView) -> None:
        self.clear()
        self.queue += [self._sequences.open(), *self.back_off(view.released())]
        if view.seen is not None and view.seen.unseen and (pose := self._viewing.best()):
            # The gripper occludes the ball that it did not take; the ball may have moved.
            self.queue += [Move("look", "HOMING", goal=m.JointGoal(positions=pose)), AwaitImage()]
        self.images_after = view.now

    def plan_failed(self, move: Move, response: m.PlanResponse, view: PickPlaceView) -> None:
        """Try the next yaw for a ball that is not started yet, or abandon it."""
        pick = _pick_of(move)
        if pick is None and move.cycle is not None:  # going home for a retry, which starts right here then
            self.clear()
            return
        if pick is None or pick.started or self.starts_in_contact(move, response):
            super().plan_failed(move, response, view)
            return
        pick.first_error = pick.first_error or response.message
        for stage in [stage for stage in self.queue if stage.cycle is pick]:
            self.queue.remove(stage)
        if pick.yaws:
            self.queue += self._sequences.pick_and_place(pick)
        else:
            self._choice.give_up(pick.target, pick.first_error, view, retry=not pick.again)

    def fail(self, message: str, view: PickPlaceView, *, go_home: bool = True) -> None:
        """Count a failure; after the second equal one at an object the others, or another approach, come first."""
        approached = self.status.subject if self.status.stage in APPROACH and not view.holding else ""
        failure = approached, NUMBER.sub("", message)
        ball = next((ball for ball in view.balls() if approached and ball.id == approached), None)
        if ball is not None and failure == self._last_failure:
            self._choice.give_up(ball, message, view, retry=not self._choice.was_given_up(ball))
            failure = "", ""
        self._last_failure = failure
        super().fail(message, view, go_home=go_home)

    # --- what its motions need -------------------------------------------------------------------------------

    def may_start(self, stage: Stage, view: PickPlaceView) -> bool:
        """Start a grasp only where the ball still is."""
        if not super().may_start(stage, view):
            return False
        pick = _pick_of(stage)
        if not (isinstance(stage, Move) and stage.needs_fresh_image) or pick is None:
            return True
        if self._is_there(pick, view):
            return True
        self.clear()
        self.status.message = f"{stage.name}: {GONE}"
        return False

    def outdated(self, stage: Stage, view: PickPlaceView) -> str:
        """Check during approach and descent that the ball is still there, as long as the gripper is above it."""
        pick = _pick_of(stage)
        if pick is None or not (isinstance(stage, Move) and stage.needs_fresh_image):
            return ""
        if not isinstance(stage.goal, m.SequenceGoal):
            return ""
        if self._around.on_hand:  # its images are only taken from home
            return ""
        above = self.p.grasp.approach_clearance + self.p.grasp_pos_tol
        if math.dist(view.tool, pick.target.position) < above:
            return ""
        return self.unseen(view) or ("" if self._is_there(pick, view) else GONE)

    def _is_there(self, pick: Pick, view: PickPlaceView) -> bool:
        """Return whether the newest image shows a target at the position of this ball."""
        return any(math.dist(t[:2], pick.target.position[:2]) <= self.p.moved for t in view.targets)

    def request(self, move: Move, start: list[float], view: PickPlaceView) -> m.PlanRequest:
        """Add what may touch and what is attached: the ball is an obstacle, then touchable, then part of the arm."""
        target, in_hand = self._object_of(move, view)
        pick = _pick_of(move)
        if move.name == "descend":
            move.touches = [(link, target) for link in self.gripper.links]
        if move.carries:
            move.attach = target
            move.attach_pose = self._sequences.attach_pose(pick) if pick and not in_hand else None
        request = super().request(move, start, view)
        if pick is not None and pick.again:  # other goal samples than those without a plan
            request.seed = self.p.run.seed + 1
        return request

    def _object_of(self, move: Move, view: PickPlaceView) -> tuple[str, bool]:
        """Return the track id of a move's object, and whether it is held now.

        The id is looked up by position: the scene manager may have been restarted since the choice.
        """
        pick = _pick_of(move)
        if view.holding and view.attached and (pick is None or pick.started):
            return view.attached, True
        if pick is None:
            return "", False
        place = pick.target.position
        near = min(view.balls(), key=lambda b: math.dist(b.position, place), default=pick.target)
        is_it = same_place(near.position, place, self._around.ball_radius)
        return (near if is_it else pick.target).id, False

    def obstacles(self, move: Move, view: PickPlaceView) -> Spots:
        """(x, y) of the other balls [m]."""
        pick = _pick_of(move)
        return view.spots(pick.target if pick else None, self._around.ball_radius)

    def back_off(self, view: PickPlaceView, contact: tuple[str, str] | None = None) -> list[Stage]:
        """Return a motion straight up: the camera sees enough from there."""
        return [self._sequences.retreat(view, contact), AwaitImage()]

    def time_limit(self, stage: Stage) -> float:
        """Time after which a stage is stopped [s]."""
        return self.p.goal_timeout

    @property
    def failure_limit(self) -> int:
        """Number of failures in a row after which the task gives up."""
        return self.p.max_failures

    @property
    def moved(self) -> float:
        """Distance from every earlier object at which an object is new [m]."""
        return self.p.moved


def _pick_of(stage: Stage) -> Pick | None:
    return stage.cycle if isinstance(stage.cycle, Pick) else None
