"""Edit a program that is not saved yet: pure functions of its data, and a draft with undo.

Data are those of the file: `{"steps": [{"step": "move", "to": "home", "id": "move1"}, ...]}`. A draft may have empty
lists of steps, which no file may have; every step in it is valid by itself.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from applications.programming.model import MOST_STEPS, STEPS, Program, as_data
from common.config import check
from common.errors import ConfigError, UnknownName, ZencellError

Data = dict[str, Any]
Steps = list[Data]
MAX_UNDO = 100
MAX_LINE = 500  # characters of a text
MAX_DEPTH = 10  # levels of nested steps
_VALID = {"step": "wait", "seconds": 0}  # in place of nested steps, which are checked by themselves


class EditRefused(ZencellError):
    """An edit that cannot be made; the draft is unchanged."""


@dataclass(frozen=True)
class Row:
    """A step in the order of the file.

    Attributes:
        step: its data.
        depth: number of steps around it.
        body: field of the step around it that has it, such as `then`; `steps` at the top.
    """

    step: Data
    depth: int
    body: str

    @property
    def id(self) -> str:
        """Its id."""
        return str(self.step["id"])


def bodies(step: Mapping[str, Any]) -> list[str]:
    """Return the fields of a step that have further steps, as in the file."""
    kind = STEPS[step["step"]]
    return [kind.model_fields[name].alias or name for name in kind.BODIES]


def rows(steps: Sequence[Data], depth: int = 0, body: str = "steps") -> Iterator[Row]:
    """Yield all steps, nested ones after the step around them."""
    for step in steps:
        yield Row(step, depth, body)
        for name in bodies(step):
            yield from rows(step.get(name, []), depth + 1, name)


@dataclass(frozen=True)
class Place:
    """Where a step is: its list, its index in it, and the step around it with the field that has the list."""

    steps: Steps
    index: int
    around: Data | None = None
    body: str = "steps"


def find(data: Data, id_: str) -> Place:
    """Return the place of a step.

    Raises:
        UnknownName: with the choices.
    """
    def search(steps: Steps, around: Data | None, body: str) -> Place | None:
        for index, step in enumerate(steps):
            if step["id"] == id_:
                return Place(steps, index, around, body)
            for name in bodies(step):
                if found := search(step.get(name, []), step, name):
                    return found
        return None

    place = search(data["steps"], None, "steps")
    if place is None:
        raise UnknownName("step", id_, [row.id for row in rows(data["steps"])])
    return place


def problems(data: Data) -> dict[str, str]:
    """Return what is missing before the draft can be saved, by the id of the step; "" for the program."""
    found = {} if data["steps"] else {"": "a program needs at least one step"}
    for row in rows(data["steps"]):
        for name in bodies(row.step):
            if name != "else" and not row.step.get(name):
                found[row.id] = f"{name}: needs at least one step"
    return found


# --- edits: each changes the data in place; `Draft` passes a copy ---


def insert(data: Data, step: Mapping[str, Any], after: str = "", inside: str = "") -> str:
    """Insert a step; return its id.

    Args:
        data: of the program.
        step: its data; ids of it and of nested steps are replaced.
        after: id of the step before it; empty: at the end.
        inside: field of the step `after` in which it becomes the last step; empty: behind that step.

    Raises:
        ConfigError: a field of the step is invalid.
    """
    new = _with_new_ids(data, copy.deepcopy(dict(step)))
    for row in rows([new]):
        check_step(row.step)
    if not after:
        data["steps"].append(new)
    else:
        place = find(data, after)
        before = place.steps[place.index]
        if not inside:
            place.steps.insert(place.index + 1, new)
        elif inside in bodies(before):
            before.setdefault(inside, []).append(new)
        else:
            raise UnknownName("list of steps", inside, bodies(before))
    _require_room(data)
    return str(new["id"])


def delete(data: Data, id_: str) -> None:
    """Delete a step and the steps in it."""
    place = find(data, id_)
    del place.steps[place.index]


def duplicate(data: Data, id_: str) -> str:
    """Insert a copy behind a step; return the id of the copy."""
    place = find(data, id_)
    return insert(data, place.steps[place.index], id_)


def move(data: Data, id_: str, by: int) -> None:
    """Move a step up (-1) or down (1) in the list as it is shown: also into and out of the steps around it.

    Raises:
        EditRefused: it is the first or the last one.
    """
    place = find(data, id_)
    step, beyond = place.steps[place.index], place.index + by
    if 0 <= beyond < len(place.steps):
        del place.steps[place.index]
        neighbor = place.steps[beyond - (by > 0)]
        names = bodies(neighbor)
        if names:
            body = neighbor.setdefault(names[0 if by > 0 else -1], [])
            body.insert(0 if by > 0 else len(body), step)
        else:
            place.steps.insert(beyond, step)
        _require_room(data)
        return
    if place.around is None:
        raise EditRefused(f"{id_} is the {'first' if by < 0 else 'last'} step")
    names = bodies(place.around)
    number = names.index(place.body) + by
    del place.steps[place.index]
    if 0 <= number < len(names):  # into the other list of the same step
        body = place.around.setdefault(names[number], [])
        body.insert(0 if by > 0 else len(body), step)
    else:
        above = find(data, place.around["id"])
        above.steps.insert(above.index + (by > 0), step)


def set_fields(data: Data, id_: str, values: Mapping[str, Any]) -> None:
    """Set fields of a step as in the file; None removes a field, which then has its default.

    Raises:
        ConfigError: names the field, the value and what is expected.
    """
    place = find(data, id_)
    step = {name: value for name, value in {**place.steps[place.index], **values}.items() if value is not None}
    if step["id"] != id_ and any(row.id == step["id"] for row in rows(data["steps"])):
        raise ConfigError("id", step["id"], "is the id of another step")
    check_step(step)
    place.steps[place.index] = step


def set_target(data: Data, id_: str, target: Mapping[str, Any]) -> None:
    """Set the target of a step, in the field of its kind, or add it to the points of a `through`.

    Raises:
        EditRefused: the step has no target.
    """
    place = find(data, id_)
    step = place.steps[place.index]
    name = next((name for name in ("to", "at", "points") if name in STEPS[step["step"]].model_fields), None)
    if name is None:
        raise EditRefused(f"{id_} is a {step['step']}, which has no target: choose a move, approach, through or place")
    set_fields(data, id_, {name: [*step.get(name, []), dict(target)] if name == "points" else dict(target)})


def check_step(step: Mapping[str, Any]) -> None:
    """Raise ConfigError if a field of a step is invalid; nested steps do not count."""
    for name, value in step.items():
        if name not in bodies(step):
            _require_lines(name, value)
    shell = {name: [_VALID] if name in bodies(step) else value for name, value in step.items()}
    check(STEPS[step["step"]], {**{name: [_VALID] for name in bodies(step)}, **shell})


def _require_lines(name: str, value: Any) -> None:
    """Raise ConfigError for a text that a list of steps cannot show on one line."""
    if isinstance(value, str) and (len(value) > MAX_LINE or not value.isprintable()):
        raise ConfigError(name, value[:40], f"must be one line of at most {MAX_LINE} characters")
    for each in value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ():
        _require_lines(name, list(each) if isinstance(value, dict) else each[1])


def _with_new_ids(data: Data, step: Data) -> Data:
    used = {row.id for row in rows(data["steps"])}
    for row in rows([step]):
        number = 1
        while (id_ := f"{row.step['step']}{number}") in used:
            number += 1
        row.step["id"] = id_
        used.add(id_)
    return step


def _require_room(data: Data) -> None:
    listed = list(rows(data["steps"]))
    if len(listed) > MOST_STEPS:
        raise EditRefused(f"a program has at most {MOST_STEPS} steps")
    if max((row.depth for row in listed), default=0) > MAX_DEPTH:
        raise EditRefused(f"steps are nested at most {MAX_DEPTH} levels deep")


# --- the draft ---


@dataclass
class Draft:
    """A program while it is edited.

    Attributes:
        name: of the program.
        data: its content; replaced by each edit, never changed.
        revision: of the file from which it was read, or as which it was saved; empty: there is no file yet.
    """

    name: str
    data: Data
    revision: str = ""
    _saved: Data | None = None
    _past: list[tuple[str, Data]] = field(default_factory=list)

    @classmethod
    def of(cls, name: str, program: Program, revision: str) -> Draft:
        """Return the draft of a file."""
        data = as_data(program)
        return cls(name, data, revision, data)

    @property
    def unsaved(self) -> bool:
        """Whether it differs from the file."""
        return self.data != self._saved

    @property
    def undoes(self) -> str:
        """Text of the edit that `undo` takes back; empty without one."""
        return self._past[-1][0] if self._past else ""

    @property
    def rows(self) -> list[Row]:
        """All steps in the order of the file."""
        return list(rows(self.data["steps"]))

    def step(self, id_: str) -> Data | None:
        """Return the data of a step; None without one of this id."""
        return next((row.step for row in self.rows if row.id == id_), None)

    def edit(self, text: str, change: Callable[[Data], Any]) -> Any:
        """Make an edit, all of it or nothing; return what `change` returns.

        Args:
            text: for `undoes`.
            change: changes the data that it gets, or raises.
        """
        data = copy.deepcopy(self.data)
        result = change(data)
        if data != self.data:
            self._push(text, data)
        return result

    def undo(self) -> None:
        """Take back the newest edit, if there is one."""
        if self._past:
            self.data = self._past.pop()[1]

    def saved(self, program: Program, revision: str, sent: Data) -> None:
        """Note that `sent` was saved; ids and values are now those of the file unless edited meanwhile."""
        self.revision, self._saved = revision, as_data(program)
        if self.data == sent:
            self.data = self._saved

    def reloaded(self, program: Program, revision: str) -> None:
        """Take the content of the file. `undo` returns to the own edits."""
        unsaved, self.revision, self._saved = self.unsaved, revision, as_data(program)
        if unsaved and self._saved != self.data:
            self._push("reload", self._saved)
        self.data = self._saved

    def _push(self, text: str, data: Data) -> None:
        self._past.append((text, self.data))
        del self._past[:-MAX_UNDO]
        self.data = data
