"""The pick-and-place task decides: the nearest ball that can be taken goes to the container, until none is left.

What is held, done and next is read from gripper, planning scene and picture; `common/tasks/engine.py` does the rest.
"""

from __future__ import annotations

import math

from pydantic import BaseModel

from applications.pick_place.ball_places import Looking
from applications.pick_place.choice import Choice, LetGo, Pick, PickPlaceView, Spot, Spots, same_place
from applications.pick_place.grasping import Config
from applications.pick_place.motion_sequences import Rows
from applications.pick_place.topics import PickPlaceStatus
from common import messages as m
from common.scene.home import is_home
from common.tasks.engine import Task
from common.tasks.stages import MISSES, Cycle, Grip, Look, Move, Stage
from common.tasks.watchdogs import Patience

GONE = "the ball is no longer where it was seen"
MOST = 400  # characters of a message
STANDING = 0.5  # [s] for which the arm hides something before it goes out of the way: pictures are a little late
CONTAINED_FOR = 0.5  # [s] balls that are seen in the container for so long are there
AT_REST = 0.3  # [s] for which what fell is seen in one place before it counts as seen again: it may roll out of view


class PickPlace(Task[PickPlaceView]):
    """Takes balls to the container."""

    p: Config
    status: PickPlaceStatus

    def __init__(self, config: Config, status: PickPlaceStatus, prefix: str, speed: float = 1.0) -> None:
        """Start from nothing known: see `Task`."""
        super().__init__(config, status, prefix, speed)
        self._around = config.world
        self._rows = Rows(config, self.gripper)
        self._choice = Choice(config, config.world.container, config.world.ball_radius, lambda: self.status.done)
        self._contained, self._released = Patience(), False
        self._looking, self._hidden = Looking(config), Patience()
        self._carried, self._due = False, 0  # how many there were as one fell out of the hand, until all are seen again
        self._still, self._places = Patience(), list[Spot]()  # where everything is seen to lie since then

    # --- what to do next -------------------------------------------------------------------------------------

    def decide(self, view: PickPlaceView) -> None:
        """Carry what is held to the container, take the nearest ball, or find an end."""
        assert view.gripper is not None
        if view.holding and view.gripper.outcome in MISSES:  # it is not what was to be taken
            self._let_go(view)
        elif view.holding:
            if view.attached:  # else the planning scene has not caught up yet
                self.row += self._rows.place_held(self._choice.held(view.attached, view), view.tool)
        elif self._looks_elsewhere(view):
            self.row += [self.home(view), Look()]
        elif not self._queue_next(view):
            self._wait_for_the_end(view)

    def decide_ahead(self, running: Stage, view: PickPlaceView) -> None:
        """While one ball is carried across, the way to the next is planned, or to where a camera on the hand looks."""
        waiting = any(stage.cycle is not None and not stage.cycle.begun for stage in self.row)
        if running.name == "across" and self._around.on_hand:
            if not any(isinstance(stage, Look) for stage in self.row):
                self.row += [self.home(view.let_go()), Look()]
        elif running.name == "across" and not waiting:
            self._queue_next(view)

    def _looks_elsewhere(self, view: PickPlaceView) -> bool:
        """Whether a camera on the hand is away from where it looks; at the end nobody asked to move any more."""
        at_home = view.q is not None and is_home(view.q, self.p.robot.named_poses["home"])
        return self._around.on_hand and self.status.state != "DONE" and not at_home

    def _queue_next(self, view: PickPlaceView) -> bool:
        """Append the stages for the nearest ball that can be taken; whether there is one."""
        assert view.gripper is not None
        if min(view.stamps) <= self.look_after or self.unseen(view):
            return False
        if self.running is None and not (view.seen and view.seen.unseen):
            self._looking.found()
        running = _pick_of(self.running.stage) if self.running else None
        box = self._around.container
        cycle = self._choice.next(view, (box.x, box.y) if running else view.tool, [running] if running else [])
        if cycle is None and not running and self._choice.once_more():
            # Whether the last way down can be followed depends on how the arm arrived above it.
            self.row.append(Move("home", "HOMING", Cycle(), goal=m.JointGoal(named="home")))
            return True
        if cycle is None:
            return False
        if not running and view.gripper.width < self.gripper.max_width - 0.002:
            self.row.append(self._rows.open())
        self.row += self._rows.pick_and_place(cycle)
        self.patience.reset()
        self.status.message = self.status.overlooked = ""
        return True

    def _wait_for_the_end(self, view: PickPlaceView) -> None:
        """DONE after a moment with an empty table, or after the grace period when something cannot be taken."""
        if self.status.state == "DONE" or self._looks_for_more(view):
            return
        left = max(len(view.balls()), len(view.targets))  # one of the two may have just begun to look
        done = False
        if unseen := self.unseen(view):
            self.patience.reset()
            self.status.message = unseen
        else:
            # Time of pictures, not of the clock: that nobody looks any more is no sign of an empty table.
            seen = max(self.look_after, min(view.stamps))
            done = self.patience.lasts(bool(left), seen) >= (self.p.grace if left else self.p.empty)
            done = done and self._counted(view) <= self.status.done  # else it is about to be counted
            missing = self._due - self.status.done - left
            remarks = [view.seen.remark if view.seen else "",
                       f"{missing} that was seen before something fell out of the hand was not seen again"
                       if missing > 0 else ""]
            remark = "; ".join(filter(None, remarks))
            message = f"{left} objects are left that cannot be taken" if left else "the table looks empty"
            self.status.overlooked = f"{message}{':' if left else ', but'} {remark}"[:MOST] if remark else ""
            self.status.message = self.status.overlooked or message
        self.status.state, self.status.stage, self.status.subject = "DONE" if done else "IDLE", "", ""

    def unseen(self, view: PickPlaceView) -> str:
        """Why the newest picture cannot be decided by: it is old, or tells nothing."""
        return super().unseen(view) or view.blind

    def _looks_for_more(self, view: PickPlaceView) -> bool:
        """Whether part of the table is hidden, so that this is not the end: the arm goes out of the way to look."""
        why = view.blind or (view.seen.unseen if view.seen else "")
        if super().unseen(view):
            return False
        if not why:
            self._looking.found()
            self._hidden.reset()
            return False
        self.patience.reset()
        self.status.state, self.status.stage, self.status.subject = "IDLE", "", ""
        self.status.message = why if view.blind else f"{why}: it is not known to be empty"
        waited = self._hidden.lasts(bool(view.blind), view.now)
        looked = not view.blind and waited >= STANDING and min(view.stamps) > self.look_after
        if looked and (pose := self._looking.next()):
            self._hidden.reset()
            self.row += [Move("look", "HOMING", goal=m.JointGoal(positions=pose)), Look()]
        elif waited >= self.p.look_timeout:
            self.end("ERROR", f"{why}, for {waited:.0f} s: what lies there is not known")
        return True

    # --- what happened ---------------------------------------------------------------------------------------

    def note(self, view: PickPlaceView) -> None:
        """Count what lies in the container, and what is on the table while nothing is in the hand or in the air."""
        status = self.status
        if not self._waits(view):  # how long it could not see is counted while it does nothing but wait to
            self._hidden.reset()
        status.skipped = self._choice.rejections()
        # What lies in the container was put there before a restart of this task, or by somebody else. The scene may
        # tell of it only later, when it was started again as well. A ball that is let go counts when it is: until then
        # it may hang over others, and a picture of it shows one more.
        contained = self._counted(view)
        stages = {status.stage, *(stage.name for stage in self.under_way)}
        releases = "release" in stages or self.waits_for_the_arm == "release"
        if self._carried and not view.holding and not releases:
            self._due, self._places = max(self._due, status.total), []
        self._carried = view.holding and not releases
        if releases:
            self._contained.reset()
        elif self._contained.lasts(contained, view.scene_stamp) >= min(CONTAINED_FOR, self.p.empty):
            status.done = max(status.done, contained)
        looked = not self._around.on_hand or min(view.stamps) > self.look_after
        if looked and not view.holding and not stages & {"close", "lift", "across", "release"}:
            found = status.done + len(view.targets)
            if found >= self._due and self._lie_still(view):
                self._due = 0
            status.total = max(found, self._due)

    def _lie_still(self, view: PickPlaceView) -> bool:
        """Whether everything on the table is seen where it was some time ago."""
        spots = [place[:2] for place in view.targets]
        if any(all(math.dist(spot, before) > self.p.moved for before in self._places) for spot in spots):
            self._places = spots
            self._still.reset()
        return self._still.lasts(True, min(view.stamps)) >= AT_REST

    def _counted(self, view: PickPlaceView) -> int:
        """How many lie in the container. Once this task put some there itself, no more than are seen.

        Before that something must carry what is seen on top. What rolls about is seen in one slot and then in another,
        so that what carries it was counted already, or is none.
        """
        contained = view.objects("contained")
        return sum(not (self._released and thing.unseen) for thing in contained)

    def _waits(self, view: PickPlaceView) -> bool:
        """Whether nothing is under way, and nobody keeps the task from deciding what comes next."""
        assert view.motion is not None
        idle = self.running is None and not self.row and view.motion.state != "active"
        kept = self.status.paused or view.motion.held or view.motion.fault or view.motion.stopped
        return idle and self.status.started and not kept

    def began_anew(self) -> None:
        """What was in the way of looking before may be gone."""
        self._looking.found()
        self._hidden.reset()
        self._due = 0

    @property
    def memory(self) -> LetGo:
        """Where balls were let go: what leans on others in the container may look as if it lay on its floor."""
        return self._choice.let_go

    def remember(self, memory: BaseModel) -> None:
        """Go on from there."""
        assert isinstance(memory, LetGo)
        self._choice.let_go = memory

    def succeeded(self, stage: Stage, view: PickPlaceView) -> None:
        """A ball that was let go is done."""
        pick = _pick_of(stage)
        if stage.name == "release" and pick is not None:
            self.status.done += 1
            self._released = True
            if self._around.on_hand:
                self.look_after = view.now
            self._choice.released(pick, view)

    def missed(self, stage: Grip, view: PickPlaceView) -> None:
        """The fingers closed on nothing, or on what is not as wide as it was seen: open, go up and look again."""
        pick = _pick_of(stage)
        assert pick is not None
        self.status.retries += 1
        x, y, _ = pick.target.position
        self.status.message = f"{stage.problem} at ({x:.3f}, {y:.3f})"
        self._choice.missed(pick.target, view.let_go(), stage.problem)
        self._let_go(view)

    def _let_go(self, view: PickPlaceView) -> None:
        self.clear()
        self.row += [self._rows.open(), *self.back_off(view.let_go())]
        if view.seen is not None and view.seen.unseen and (pose := self._looking.best()):
            # The hand hides what it did not take, which may lie elsewhere now.
            self.row += [Move("look", "HOMING", goal=m.JointGoal(positions=pose)), Look()]
        self.look_after = view.now

    def plan_failed(self, move: Move, response: m.PlanResponse, view: PickPlaceView) -> None:
        """Try the next yaw for a ball that was not begun with, or leave it alone."""
        pick = _pick_of(move)
        if pick is None and move.cycle is not None:  # on the way home for another try, which begins here then
            self.clear()
            return
        if pick is None or pick.begun or self.stands_against(move, response):
            super().plan_failed(move, response, view)
            return
        pick.first_error = pick.first_error or response.message
        for stage in [stage for stage in self.row if stage.cycle is pick]:
            self.row.remove(stage)
        if pick.yaws:
            self.row += self._rows.pick_and_place(pick)
        else:
            self._choice.give_up(pick.target, pick.first_error, view, retry=not pick.again)

    # --- what its motions need -------------------------------------------------------------------------------

    def may_begin(self, stage: Stage, view: PickPlaceView) -> bool:
        """A hand goes only to where a ball still is."""
        if not super().may_begin(stage, view):
            return False
        pick = _pick_of(stage)
        if not (isinstance(stage, Move) and stage.fresh) or pick is None:
            return True
        if self._is_there(pick, view):
            return True
        self.clear()
        self.status.message = f"{stage.name}: {GONE}"
        return False

    def outdated(self, stage: Stage, view: PickPlaceView) -> str:
        """On the way to a ball and down to it in one motion it is looked at as long as the hand is above."""
        pick = _pick_of(stage)
        if pick is None or not (isinstance(stage, Move) and stage.fresh and isinstance(stage.goal, m.SequenceGoal)):
            return ""
        if self._around.on_hand:  # what it was shown from home is what is known
            return ""
        above = self.p.grasp.approach_clearance + self.p.grasp_pos_tol
        if math.dist(view.tool, pick.target.position) < above:
            return ""
        return self.unseen(view) or ("" if self._is_there(pick, view) else GONE)

    def _is_there(self, pick: Pick, view: PickPlaceView) -> bool:
        """Whether the newest picture shows a ball that may be taken where this one was."""
        return any(math.dist(t[:2], pick.target.position[:2]) <= self.p.moved for t in view.targets)

    def request(self, move: Move, start: list[float], view: PickPlaceView) -> m.PlanRequest:
        """The ball is an obstacle, then may be touched, then moves with the hand."""
        target, in_hand = self._object_of(move, view)
        pick = _pick_of(move)
        if move.name == "descend":
            move.touches = [(link, target) for link in self.gripper.links]
        if move.carries:
            move.attach = target
            move.attach_pose = self._rows.attach_pose(pick) if pick and not in_hand else None
        request = super().request(move, start, view)
        if pick is not None and pick.again:  # other samples of the goal than those from which there was no way on
            request.seed = self.p.run.seed + 1
        return request

    def _object_of(self, move: Move, view: PickPlaceView) -> tuple[str, bool]:
        """The track id of a move's object, and whether it is in the hand now.

        Ids are looked up by place, because the scene manager may have been restarted since the object was chosen.
        """
        pick = _pick_of(move)
        if view.holding and view.attached and (pick is None or pick.begun):
            return view.attached, True
        if pick is None:
            return "", False
        place = pick.target.position
        near = min(view.balls(), key=lambda b: math.dist(b.position, place), default=pick.target)
        is_it = same_place(near.position, place, self._around.ball_radius)
        return (near if is_it else pick.target).id, False

    def obstacles(self, move: Move, view: PickPlaceView) -> Spots:
        """(x, y) of the other balls."""
        pick = _pick_of(move)
        return view.spots(pick.target if pick else None, self._around.ball_radius)

    def back_off(self, view: PickPlaceView, contact: tuple[str, str] | None = None) -> list[Stage]:
        """Up from where the hand is: the camera sees enough from there."""
        return [self._rows.retreat(view, contact), Look()]

    def time_limit(self, stage: Stage) -> float:
        """A stage that takes longer is stopped [s]."""
        return self.p.goal_timeout

    @property
    def most_failures(self) -> int:
        """So many in a row, and it gives up."""
        return self.p.max_failures

    @property
    def moved(self) -> float:
        """What stands this far from where anything stood before is new there [m]."""
        return self.p.moved


def _pick_of(stage: Stage) -> Pick | None:
    return stage.cycle if isinstance(stage.cycle, Pick) else None
