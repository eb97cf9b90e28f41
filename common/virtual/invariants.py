"""What must hold at every step of a cell, whatever happens to it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from common import topics
from common.application import find_application
from common.config import Cell
from common.hardware.interface import Limits, Vector
from common.messages import (
    CameraInfo,
    GripperState,
    Image,
    LogLine,
    Message,
    MotionStatus,
    PointCloud2,
    PoseArray,
    ServiceCounters,
    WorldObjects,
)
from common.topics import AnyTopic
from common.transport.codec import decode
from common.transport.session import RawSample
from common.virtual.process import Requests

OVER = ("succeeded", "aborted", "cancelled")
SEEN_BY_CAMERAS = (Image, CameraInfo, PointCloud2, ServiceCounters, LogLine)  # what one who sees the truth may say
MOST_BROKEN = 5  # are told of
LATE = 0.5  # [s] that the end of a request may come after its time-out
MOVED = 2e-3  # [m] farther from where it lay, a thing was moved
JUMP = 0.02  # [rad] from where the arm was to the first set-point of another process
BLEND = 0.08  # [rad/s] by which the difference to the start of a trajectory, while it fades, adds to its speed
SHARP = 1.0  # [rad/s^2] the same for acceleration
AT_REST = 2.0  # [s] of cell time after which an arm that is held is at rest
STILL = 1e-9  # [rad]


@dataclass
class _Goals:
    """What one controller said of its goals."""

    active: str = ""
    writer: str = ""


class Invariants:
    """Looks at every message, set-point and request; `broken` says what did not hold, `checked` how often was looked."""

    def __init__(self, cell: Cell, requests: Requests, now: Callable[[], float]) -> None:
        """Begin without having seen anything; `now` is the virtual time [s]."""
        self.broken: list[str] = []
        self.checked: Counter[str] = Counter()
        self.truth_readers: set[str] = set()  # processes that hear what only cameras may see
        self._requests, self._now = requests, now
        known: dict[str, AnyTopic] = {**topics.platform_topics(), **find_application(cell.application).topics}
        self._truth = {f"{cell.name}/{t.key}": t for t in known.values() if t.doc.startswith("the truth")}
        self._messages = {name: model for t in known.values() for name, model in [(t.message.__name__, t.message)]}
        self._motion, self._gripper = f"{cell.name}/{topics.MOTION_STATUS.key}", f"{cell.name}/{topics.GRIPPER_STATE.key}"
        self._goals: dict[str, _Goals] = {}
        self._over: dict[tuple[str, str], str] = {}  # by key and goal
        self._ids: dict[str, list[str]] = {}  # by key: what there is
        self._lying: dict[str, tuple[str, Vector]] = {}  # by object: state and place
        self._held_since: float | None = None  # cell time
        self._last: tuple[Vector, Vector, float] | None = None  # newest set-points and when
        self._strange = 0

    def _require(self, holds: object, what: str, told: Callable[[], str]) -> None:
        self.checked[what] += 1
        if not holds and len(self.broken) < MOST_BROKEN:
            self.broken.append(f"{self._now():.3f} s: {what}: {told()}")

    # --- messages -----------------------------------------------------------------------------------------------------

    def on_put(self, service: str, writer: str, sample: RawSample) -> None:
        """Look at what a process puts.

        Args:
            service: name of the process.
            writer: id of this life of it.
            sample: as it travels.
        """
        if service in self.truth_readers:
            model = self._messages.get(sample.encoding.rpartition(";")[2], Message)
            self._require(issubclass(model, SEEN_BY_CAMERAS), "nothing that decides saw the truth",
                          lambda: f"{service} hears it and says {sample.key}")
        if sample.key == self._motion:
            motion = decode(MotionStatus, sample.payload)
            self._on_goal(sample.key, writer, motion.id, motion.state)
            held = motion.held and motion.state == "active"
            self._held_since = None if not held else self._held_since or motion.header.stamp * 1e-9
        elif sample.key == self._gripper:
            gripper = decode(GripperState, sample.payload)
            self._on_goal(sample.key, writer, gripper.id, gripper.state)
        elif sample.key in self._truth:
            self._on_truth(sample.key, decode(self._truth[sample.key].message, sample.payload))

    def _on_goal(self, key: str, writer: str, goal: str, state: str) -> None:
        known = self._goals.setdefault(key, _Goals())
        if writer != known.writer:  # another process, which knows nothing of goals before it
            known.writer, known.active = writer, ""
        before = self._over.get((key, goal), "")
        self._require(not before or state == before, "a goal id acts once",
                      lambda: f"{key}: {goal} is {state} after it was {before}")
        if state in OVER:
            self._over[key, goal] = state
            if goal == known.active:
                known.active = ""
        elif state == "active":
            one = not known.active or goal == known.active or key == self._gripper  # whose newer goal ends the older
            other = known.active
            self._require(one, "never two goals", lambda: f"{key}: {goal} is active while {other} is")
            known.active = goal

    def _on_truth(self, key: str, message: Message) -> None:
        if isinstance(message, PoseArray):
            things = [(i, label, np.array([p.position.x, p.position.y, p.position.z]))
                      for i, label, p in zip(message.ids, message.labels, message.poses, strict=True)]
        elif isinstance(message, WorldObjects):
            things = [(o.id, "", np.array([*np.mean(o.outline, axis=0), o.base])) for o in message.objects]
        else:
            return
        what, ids = "no object lost or doubled", sorted(name for name, _, _ in things)
        known = self._ids.setdefault(key, ids)
        self._require(ids == known and len(set(ids)) == len(ids), what, lambda: f"{key}: {ids} instead of {known}")
        held = [name for name, state, _ in things if state == "held"]
        self._require(len(held) <= 1, what, lambda: f"{key}: {held} are held at once")
        for name, state, place in things:
            before = self._lying.get(name)
            self._lying[name] = state, place
            self._require(state != "elsewhere", what, lambda name=name: f"{name} lies where nobody sees it")  # type: ignore[misc]
            if before is not None and state not in ("held", "falling") and before[0] == state:
                gone = float(np.linalg.norm(place - before[1]))
                self._require(gone < MOVED, what, lambda name=name, gone=gone: f"{name} went {gone:.3f} m by itself")  # type: ignore[misc]
            elif before is not None and before[0] != state:
                legal = state in ("held", "falling") or before[0] in ("held", "falling")
                self._require(legal, what, lambda name=name, was=before[0], state=state: f"{name} went from {was} to {state}")  # type: ignore[misc]

    # --- the arm ------------------------------------------------------------------------------------------------------

    def on_set_point(self, limits: Limits, measured: Vector, q: Vector, dq: Vector, now: float) -> None:
        """Look at set-points q (dof,) [rad] and dq [rad/s], given where the arm is, at cell time [s]."""
        what = "every set-point within limits"
        fits = bool(np.isfinite(q).all() and np.isfinite(dq).all())
        fits = fits and bool(((q >= limits.lower - 2e-3) & (q <= limits.upper + 2e-3)).all())
        fastest = 1.03 * limits.velocity + BLEND
        fits = fits and bool((np.abs(dq) <= fastest).all())
        self._require(fits, what, lambda: f"q {np.round(q, 4).tolist()}, dq {np.round(dq, 3).tolist()}")
        last, self._last = self._last, (q.copy(), dq.copy(), now)
        if last is None:
            return
        passed = now - last[2]
        way = np.abs(q - last[0])
        if passed <= 0 or passed > 0.3:  # another process of another clock; or one after a stall
            self._require((way <= JUMP).all(), what, lambda: f"a jump of {way.max():.3f} rad after {passed:.3f} s")
            return
        self._require((way <= fastest * passed + 1e-3).all(), what,
                      lambda: f"a step of {way.max():.4f} rad in {passed * 1e3:.1f} ms")
        change = np.abs(dq - last[1])
        self._require((change <= (1.1 * limits.braking + SHARP) * max(passed, 0.01) + 1e-3).all(), what,
                      lambda: f"velocity changes by {change.max():.3f} rad/s in {passed * 1e3:.1f} ms")
        moving = bool((way > STILL).any())
        goals = self._goals.get(self._motion)
        self._require(not moving or (goals is not None and bool(goals.active)) or passed > 0.05,
                      "the arm moves for a goal only", lambda: f"{way.max():.4f} rad without one")
        at_rest = self._held_since is None or now - self._held_since < AT_REST
        self._require(not moving or at_rest, "an arm that is held rests", lambda: f"it moves {way.max():.4f} rad")

    # --- requests -----------------------------------------------------------------------------------------------------

    def look(self) -> None:
        """Look at the requests that are under way."""
        what, now = "every request ends in one of five ways", self._now()
        for service, key, end in self._requests.open.values():
            self._require(now <= end + LATE, what,
                          lambda service=service, key=key, end=end: f"{key} of {service} should have by {end:.1f} s")  # type: ignore[misc]
        for strange in self._requests.strange[self._strange:]:
            self._require(False, what, lambda strange=strange: strange)  # type: ignore[misc]
        self._strange = len(self._requests.strange)

    def on_end(self, done: int, state: str) -> None:
        """Compare what the task believes in the end with what there is."""
        if state == "DONE":
            within = sum(label == "box" for label, _ in self._lying.values())
            held = [name for name, (label, _) in self._lying.items() if label == "held"]
            self._require(not held, "nothing is held in the end", lambda: f"{held} is")
            self._require(done == within, "as many placed as are said to be", lambda: f"{done} are, {within} really")
