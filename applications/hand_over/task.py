"""The tasks of both arms: the giver picks what the camera sees, the receiver puts it into its container."""

from __future__ import annotations

import numpy as np

from common import messages as m
from common.errors import ConfigError
from common.tasks.handover import WAITS, Giving, HandoverConfig, HandoverView, Receiving, backward
from common.tasks.stages import DwellTimer, View
from tools.check.arm import Arm


class Config(HandoverConfig):
    """Parameters of the task of one arm: of the giver or of the receiver."""

    def require_reachable_meeting(self) -> None:
        """Check that the arm reaches the meeting place, and where it comes from, with the tool towards the other arm.

        Raises:
            ConfigError: it does not, or there is no other arm; names the field.
        """
        self.require_usable()
        arm, ends = Arm(self.robot, self.world), list(self.tools_at_meeting(np.eye(4)))
        if why := arm.why_not(ends) or arm.why_not([backward(T, self.back_off) for T in ends]):
            raise ConfigError("meeting", list(self.meeting), f"is out of reach of {self.arms.own} with the tool "
                              f"towards {self.partner}, or {self.back_off:g} m before it: {why}")


class Giver(Giving):
    """Gives one object after the other."""

    def choose(self, view: View) -> None:
        """Pick the next object, or end when none is left and the other arm holds none."""
        assert isinstance(view, HandoverView)
        partner, things = view.partner, view.objects("target")
        if self.ends_with(partner, view):
            return
        if things:
            self.bring(things, view)
        elif partner is not None and not partner.gripper.holding:
            self.finish(view)

    def note(self, view: View) -> None:
        """Count what was ever seen: what lies on the table, is held, or is in the box of the other arm."""
        assert isinstance(view, HandoverView)
        if self.shown(view) and view.partner is not None and view.partner.status is not None:
            there = len(view.objects("target")) + view.partner.gripper.holding + view.partner.status.done
            self.status.total = max(self.status.total, there)


class Receiver(Receiving):
    """Puts what it takes into the container next to it."""

    def __init__(self, config: Config, status: m.TaskStatus, prefix: str, speed: float = 1.0) -> None:
        """Start without an object; the arguments are those of `Task`."""
        super().__init__(config, status, prefix, speed)
        self._counting = DwellTimer()

    def choose(self, view: View) -> None:
        """Wait for an offer; end with the task of the giver."""
        assert isinstance(view, HandoverView)
        partner = view.partner
        if partner is not None and partner.status is not None and partner.status.state == "DONE":
            missing = partner.status.total - self.status.done
            if missing <= 0:
                self.finish(view)
            elif self._counting.elapsed("the giver is done", view.now) >= self.p.give_up:
                self.end("DONE", f"{missing} of {partner.status.total} objects are not seen in the container")
        elif not self.ends_with(partner, view):
            self.status.message = f"{WAITS} {self.p.partner} offers an object"

    def destination(self, thing: m.CollisionObject, view: View) -> m.Pose | None:
        """Return the pose above the freest corner of the container."""
        return self.room_in(next(iter(self.p.world.containers)), thing, view)

    def note(self, view: View) -> None:
        """Count what the camera shows in the container."""
        if self.shown(view):
            self.status.done = len(self.inside(next(iter(self.p.world.containers)), view))
