"""What a cell and its parts have in common: an attribute that there is not is never taken without a word."""

from __future__ import annotations

from difflib import get_close_matches

from common.errors import ZencellError


class NotSet(ZencellError, AttributeError):
    """Something was assigned to an attribute, which changes nothing in a cell."""

    def __init__(self, part: str, name: str, there: list[str]) -> None:
        near = get_close_matches(name, there, n=1)
        hint = f": did you mean {near[0]!r}?" if near and near[0] != name else ""
        what = "cannot be set" if name in there else "is not there"
        super().__init__(f"{part}.{name} {what}{hint or ', nothing is set by assigning to it'}")
        self.attribute = name


class Part:
    """A cell, or a part of one. Nothing public of it can be set: what is to change is asked for by calling."""

    def _has(self, **parts: object) -> None:
        """Take up what everybody may look at."""
        vars(self).update(parts)

    def __setattr__(self, name: str, value: object) -> None:
        if not name.startswith("_"):
            there = [each for each in {*dir(self), *getattr(type(self), "__annotations__", ())} if each[0] != "_"]
            raise NotSet(type(self).__name__, name, there)
        super().__setattr__(name, value)
