"""Whose the motion is: one task, operator or script at a time, and nobody else's begins. No clock of its own.

Who begins a motion that is nobody's has it until that ends; who asks for it has it until it is given back. Stops and
holds are everybody's: they are none of this, and a person's stop ends whatever was asked for.
"""

from __future__ import annotations

from common.errors import Refused
from common.messages import MotionOwner, OwnRequest
from common.sources import wall_ns

NOT_OWNER = "not_owner"


class Ownership:
    """Says who may begin a motion. A name that is empty is that of a task which does not say its own."""

    def __init__(self) -> None:
        self.now = MotionOwner()
        self._lease = 0.0
        self._used = 0.0  # [s] wall: when it was last taken, or moved something

    def objection(self, owner: str) -> Refused | None:
        """What speaks against a motion that somebody asks for, or None."""
        if self.now.kind == "none" or self._has(owner):
            return None
        return Refused(NOT_OWNER, f"the motion is {self.now.description}: who wants it has to take it over")

    def use(self, owner: str, now: float) -> None:
        """Take note that somebody without an objection begins a motion; wall time [s]."""
        self._used = now
        if self.now.kind == "none":
            self._put(owner, "operator" if owner else "task", asked=False)

    def take(self, request: OwnRequest, now: float) -> str:
        """Whose it was, if it was taken over from somebody, in words; wall time [s].

        Raises:
            Refused: somebody else has it, and it is not to be taken over.
        """
        before = ""
        if self.now.kind != "none" and not self._is(request):
            if not request.over:
                raise Refused(NOT_OWNER, f"the motion is {self.now.description}: take it over, if it must be")
            before = self.now.description
        if before or not self.now.asked:
            self._put(request.owner, request.kind, asked=True)
        self._lease, self._used = request.lease, now
        return before

    def give(self, owner: str, moving: bool) -> None:
        """Take note that somebody gives back what is theirs: what moves the arm yet is, until that has ended."""
        if self.now.kind == "none" or self.now.owner != owner:
            return
        if moving:
            self.let_end()
        else:
            self.end()

    def end(self) -> bool:
        """Have it be nobody's from now on; whether it was somebody's."""
        had, self.now = self.now.kind != "none", MotionOwner()
        return had

    def let_end(self) -> None:
        """Have it be nobody's as soon as nothing moves."""
        self.now = self.now.model_copy(update={"asked": False})

    def look(self, moving: bool, now: float) -> None:
        """End what was taken for one motion when nothing moves, and what nobody uses for longer than was asked for."""
        if moving:
            self._used = now
        elif self.now.kind != "none" and (
            not self.now.asked or (self._lease and now - self._used > self._lease)
        ):
            self.end()

    def _has(self, owner: str) -> bool:
        return self.now.owner == owner or (self.now.kind == "task" and not owner)

    def _is(self, request: OwnRequest) -> bool:
        """Whether who asks has it: a task that begins to say its name is the one that did not."""
        return (self.now.kind == "task") == (request.kind == "task") and self.now.owner in (
            request.owner, *(("",) if request.kind == "task" else ()))

    def _put(self, owner: str, kind: str, *, asked: bool) -> None:
        self.now = MotionOwner.model_validate({"owner": owner, "kind": kind, "since": wall_ns(), "asked": asked})
        self._lease = 0.0
