"""Control flow of a program: positions in it, and which step follows. Pure, and without side effects.

A position is a stack of frames, one for each list of steps that is entered, the last one at the current step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

from pydantic import BaseModel, ConfigDict

from applications.programming.files import ProgramFile
from applications.programming.handling import Palletize
from applications.programming.model import BaseStep, Condition
from applications.programming.steps import Call, If, Loop
from common.errors import UnknownName
from common.tasks.palletizing import Pattern

TOP = ""  # owner of the frame of a program itself
TRANSITIONS = 50  # of control flow at once: a loop may have nothing to do


class Undecided(Exception):
    """A condition that is not known yet."""


class Frame(BaseModel):
    """One list of steps that is entered: `owner` is the id of its loop, if or palletize, `turn` counts from 0."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    program: str
    owner: str = TOP
    body: str = "steps"
    index: int = 0
    turn: int = 0


Position = tuple[Frame, ...]  # empty: the end
Decide = Callable[[Condition, Position], bool]  # at a step


class Flow:
    """Steps of a program and of those that it calls, by position."""

    def __init__(self, files: Mapping[str, ProgramFile], main: str) -> None:
        """Follow the program `main` of the files, by name."""
        self.files, self.main = files, main
        self._steps = {name: file.steps for name, file in files.items()}

    @property
    def start(self) -> Position:
        """The first step."""
        return (Frame(program=self.main),)

    def contains(self, position: Position) -> bool:
        """Return whether the position exists: the program may have changed since."""
        try:
            return all(frame.index < len(self._body(frame)) for frame in position[:-1]) and bool(
                not position or self.step(position))
        except (KeyError, AttributeError, IndexError):
            return False

    def file(self, position: Position) -> ProgramFile:
        """Return the file that the step of a position is in."""
        return self.files[position[-1].program]

    def step(self, position: Position) -> BaseStep:
        """Return the step of a position; where a pallet is filled, the placing with the id of its step."""
        frame = position[-1]
        body = self._body(frame)
        owner = self._steps[frame.program].get(frame.owner)
        if isinstance(owner, Palletize) and frame.index == len(body):
            return owner.placing(frame.turn)
        return body[frame.index]

    def find(self, id_: str) -> Position:
        """Return the position of a step of the main program, in the first turn of the loops around it.

        Raises:
            UnknownName: lists the choices.
        """
        def search(above: Position, frame: Frame) -> Iterator[Position]:
            for index, step in enumerate(self._body(frame)):
                here = (*above, frame.model_copy(update={"index": index}))
                if step.id == id_:
                    yield here
                for name in type(step).BODIES:
                    yield from search(here, Frame(program=self.main, owner=step.id, body=name))

        found = next(search((), Frame(program=self.main)), None)
        if found is None:
            raise UnknownName("step", id_, self.files[self.main].steps)
        return found

    def is_leaf(self, position: Position) -> bool:
        """Return whether the step of a position does something, instead of leading to other steps."""
        return not isinstance(self.step(position), Loop | If | Call | Palletize)

    def enter(self, position: Position, decide: Decide) -> Position:
        """Return the first position inside a step that leads to others, or what follows it. Raises Undecided."""
        step, program = self.step(position), position[-1].program
        if isinstance(step, Call):
            return (*position, Frame(program=step.program))
        body, enters = "steps", True
        if isinstance(step, If):
            body = "then" if decide(step.condition, position) else "otherwise"
            enters = bool(getattr(step, body))
        elif isinstance(step, Loop):
            enters = step.count != 0 if step.condition is None else decide(step.condition, position)
        return (*position, Frame(program=program, owner=step.id, body=body)) if enters else self.after(position)

    def after(self, position: Position) -> Position:
        """Return the position after a step, which may be at a step that leads to others."""
        *above, frame = position
        frame = frame.model_copy(update={"index": frame.index + 1})
        owner = self._steps[frame.program].get(frame.owner)
        if frame.index < len(self._body(frame)) + isinstance(owner, Palletize):
            return (*above, frame)
        again = frame.model_copy(update={"index": 0, "turn": frame.turn + 1})
        if isinstance(owner, Palletize) and again.turn < owner.places:
            return (*above, again)
        if isinstance(owner, Loop):
            if owner.condition is not None:
                return tuple(above)  # is decided again
            if owner.count is None or again.turn < owner.count:
                return (*above, again)
        return self.after(tuple(above)) if above else ()

    def leaf(self, position: Position, decide: Decide) -> Position:
        """Return the next position whose step does something, from a position on; empty: the end. Raises Undecided."""
        for _ in range(TRANSITIONS):
            if not position or self.is_leaf(position):
                return position
            position = self.enter(position, decide)
        raise Undecided("nothing to do")

    def repetitions(self, position: Position) -> list[str]:
        """Return the turns of the loops around a position, in words."""
        found = []
        for frame, owner in self._owners(position):
            if isinstance(owner, Loop | Palletize):
                total = owner.places if isinstance(owner, Palletize) else owner.count
                found.append(f"{owner.id}: {frame.turn + 1}{f' of {total}' if total is not None else ''}")
        return found

    def patterns(self, position: Position) -> list[Pattern]:
        """Return the patterns that are filled around a position: what is placed there is not picked again."""
        return [owner.pattern for _, owner in self._owners(position) if isinstance(owner, Palletize)]

    def endless(self, position: Position) -> str:
        """Return the id of a loop without end around a position that has turned once; empty without one."""
        return next((owner.id for frame, owner in self._owners(position) if isinstance(owner, Loop) and frame.turn
                     and owner.count is None and owner.condition is None), "")

    def _owners(self, position: Position) -> list[tuple[Frame, BaseStep | None]]:
        return [(frame, self._steps[frame.program].get(frame.owner)) for frame in position]

    def _body(self, frame: Frame) -> Sequence[BaseStep]:
        if not frame.owner:
            return self.files[frame.program].program.steps
        body: Sequence[BaseStep] = getattr(self._steps[frame.program][frame.owner], frame.body)
        return body
