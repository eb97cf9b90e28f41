"""Edit a program that is not saved yet: pure functions of its data, and a draft with undo.

Data are those of the file: `{"steps": [{"step": "move", "to": "home", "id": "move1"}, ...]}`. A draft may have empty
lists of steps, which no file may have; every step in it is valid by itself.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from applications.programming.files import new_id
from applications.programming.model import MOST_STEPS, STEPS, BaseStep, Program, as_data
from common.config import check
from common.errors import ConfigError, UnknownName, ZencellError

Data = dict[str, Any]
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
        path: in the file, such as `steps[2].then[0]`.
        siblings: list that has the step.
        index: of the step there.
        depth: number of steps around it.
        body: key of that list, such as `then`; `steps` at the top.
        around: data of the step with that list; None at the top.
    """

    path: str
    siblings: list[Data]
    index: int
    depth: int
    body: str
    around: Data | None

    @cached_property
    def step(self) -> Data:
        """Its data."""
        return self.siblings[self.index]

    @property
    def id(self) -> str:
        """Its id."""
        return str(self.step["id"])

    @cached_property
    def words(self) -> str:
        """What it does in a few words."""
        return str(parsed(self.step))


def bodies(step: Mapping[str, Any]) -> list[str]:
    """Return the keys of a step's lists of further steps."""
    kind = STEPS[step["step"]]
    return [key for key, name in kind.keys().items() if name in kind.BODIES]


def rows(
    steps: list[Data], depth: int = 0, body: str = "steps", around: Data | None = None, above: str = ""
) -> Iterator[Row]:
    """Yield all steps, nested ones after the step around them."""
    for index, step in enumerate(steps):
        path = f"{above}{body}[{index}]"
        yield Row(path, steps, index, depth, body, around)
        for name in bodies(step):
            yield from rows(step.get(name, []), depth + 1, name, step, f"{path}.")


def find(data: Data, id_: str) -> Row:
    """Return a step. Raises UnknownName."""
    listed = {row.id: row for row in rows(data["steps"])}
    if id_ not in listed:
        raise UnknownName("step", id_, listed)
    return listed[id_]


def problems(data: Data) -> dict[str, str]:
    """Return what is missing before the draft can be saved, by the id of the step; "" for the program."""
    found = {} if data["steps"] else {"": "a program needs at least one step"}
    for row in rows(data["steps"]):
        for name in bodies(row.step):
            if name != "else" and not row.step.get(name):
                found[row.id] = f"{name}: needs at least one step"
    return found


def parsed(step: Mapping[str, Any]) -> BaseStep:
    """Return a step; nested ones are left out. Raises ConfigError."""
    nested = {key: [_VALID] for key in bodies(step)}
    for name, value in step.items():
        if name not in nested:
            _require_lines(name, value)
    return check(STEPS[step["step"]], {**step, **nested})


# --- edits: each changes the data in place, and returns the step to choose; `Draft` passes a copy ---


def insert(data: Data, after: str, step: Mapping[str, Any], inside: str = "") -> str:
    """Insert a step.

    Args:
        data: of the program.
        after: id of the step before it; empty: at the end.
        step: its data; ids of it and of nested steps are replaced.
        inside: list of the step `after` in which it becomes the last step; empty: behind that step.

    Raises:
        ConfigError: a field of the step is invalid.
    """
    new, used = copy.deepcopy(dict(step)), {row.id for row in rows(data["steps"])}
    for row in rows([new]):
        row.step["id"] = new_id(row.step["step"], used)
        parsed(row.step)
    before = find(data, after) if after else None
    if before is None:
        data["steps"].append(new)
    elif not inside:
        before.siblings.insert(before.index + 1, new)
    elif inside in bodies(before.step):
        before.step.setdefault(inside, []).append(new)
    else:
        raise UnknownName("list of steps", inside, bodies(before.step))
    _require_room(data)
    return str(new["id"])


def delete(data: Data, id_: str) -> str:
    """Delete a step and the steps in it."""
    ids, row = [row.id for row in rows(data["steps"])], find(data, id_)
    del row.siblings[row.index]
    return ids[ids.index(id_) - 1] if ids.index(id_) else ""


def duplicate(data: Data, id_: str) -> str:
    """Insert a copy behind a step."""
    return insert(data, id_, find(data, id_).step)


def move(data: Data, id_: str, by: int) -> None:
    """Move a step up (-1) or down (1) in the list as it is shown: also into and out of the steps around it.

    Raises:
        EditRefused: it is the first or the last one.
    """
    row = find(data, id_)
    step, beyond, siblings = row.step, row.index + by, row.siblings
    into: list[Data] | None = None  # list whose next end it enters
    if 0 <= beyond < len(siblings):
        neighbor = siblings[beyond]
        if names := bodies(neighbor):
            into = neighbor.setdefault(names[0 if by > 0 else -1], [])
    elif row.around is None:
        raise EditRefused(f"{id_} is the {'first' if by < 0 else 'last'} step")
    else:
        names = bodies(row.around)
        number = names.index(row.body) + by
        if 0 <= number < len(names):  # the other list of the same step
            into = row.around.setdefault(names[number], [])
        else:
            above = find(data, row.around["id"])
            siblings, beyond = above.siblings, above.index + (by > 0)
    del row.siblings[row.index]
    if into is None:
        siblings.insert(beyond, step)
    else:
        into.insert(0 if by > 0 else len(into), step)
    _require_room(data)


def set_fields(data: Data, id_: str, values: Mapping[str, Any]) -> None:
    """Set fields of a step as in the file; None removes a field, which then has its default. Raises ConfigError."""
    row = find(data, id_)
    step = {name: value for name, value in {**row.step, **values}.items() if value is not None}
    if step["id"] != id_ and any(each.id == step["id"] for each in rows(data["steps"])):
        raise ConfigError("id", step["id"], "is the id of another step")
    parsed(step)
    row.siblings[row.index] = step


def set_target(data: Data, id_: str, target: Mapping[str, Any], point: int | None = None) -> None:
    """Set the target of a step; of several the one with a number, or add it to them. Raises EditRefused."""
    step = find(data, id_).step
    name = next((key for key, _ in parsed(step).targets()), "").partition("[")[0]
    if not name:
        raise EditRefused(f"{id_} is a {step['step']}, which has no target: choose a move, approach, through or place")
    value: Any = dict(target)
    if isinstance(points := step[name], list):
        number = len(points) if point is None else min(point, len(points) - 1)
        value = [*points[:number], value, *points[number + 1:]]
    set_fields(data, id_, {name: value})


def remove_point(data: Data, id_: str, number: int) -> None:
    """Remove one of several targets."""
    points = find(data, id_).step["points"]
    set_fields(data, id_, {"points": [*points[:number], *points[number + 1:]]})


def _require_lines(name: str, value: Any) -> None:
    """Raise ConfigError for a text that a list of steps cannot show on one line."""
    if isinstance(value, str) and (len(value) > MAX_LINE or not value.isprintable()):
        raise ConfigError(name, value[:40], f"must be one line of at most {MAX_LINE} characters")
    for each in [*value, *value.values()] if isinstance(value, dict) else value if isinstance(value, list) else ():
        _require_lines(name, each)


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
    _listed: tuple[Data | None, list[Row]] = (None, [])

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
        if self._listed[0] is not self.data:
            self._listed = self.data, list(rows(self.data["steps"]))
        return self._listed[1]

    def step(self, id_: str) -> Data | None:
        """Return the data of a step; None without one of this id."""
        return next((row.step for row in self.rows if row.id == id_), None)

    def edit(self, text: str, change: Callable[..., Any], *values: Any) -> Any:
        """Make an edit, all of it or nothing; return what `change(data, *values)` returns; `text` is for `undoes`."""
        data = copy.deepcopy(self.data)
        result = change(data, *values)
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
