"""A file that is always whole, in which what persons decided outlives the service that keeps it, and the machine."""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Generic, TypeVar

from pydantic import BaseModel, ValidationError

from common.errors import ConfigError, ZencellError

R = TypeVar("R", bound=BaseModel)

STATE_VARIABLE = "ZENCELL_STATE"  # folder for what is kept: what persons decided, how the simulated world stands
RUNTIME_VARIABLE = "ZENCELL_STANDING"  # folder for what is kept until the cell's end alone, as how the world stands
LARGEST = 1_000_000  # [bytes]
ROOM = 128 * 1024  # [bytes] that each file takes: more than the largest record there can be


def state_folder(environ: Mapping[str, str] = os.environ) -> Path:
    """The folder for what is kept: ZENCELL_STATE, else one in the person's home.

    Raises:
        ConfigError: there is no home.
    """
    if told := environ.get(STATE_VARIABLE):
        return Path(told)
    try:
        return Path(environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "zencell"
    except RuntimeError:
        told = "must name a folder to keep what persons decide in: this user has no home"
        raise ConfigError(STATE_VARIABLE, ..., told) from None


def runtime_folder(environ: Mapping[str, str] = os.environ) -> Path | None:
    """The folder for what outlives a service, but not the cell; None where nobody has said one: then it is not kept."""
    folder = environ.get(RUNTIME_VARIABLE) or environ.get(STATE_VARIABLE)
    return Path(folder) if folder else None


class Unreadable(ZencellError):
    """A file that does not say what was kept."""

    def __init__(self, path: Path, why: str) -> None:
        super().__init__(f"{path} cannot be read: {why}")
        self.path, self.why = path, why


def open_regular(path: Path, flags: int) -> int:
    """A descriptor of a file; one that is made is for us alone.

    Raises:
        OSError: it cannot be opened, or is something else than a file.
    """
    descriptor = os.open(path, flags | os.O_NONBLOCK, 0o600)  # a pipe would have us wait for its other end
    if stat.S_ISREG(os.fstat(descriptor).st_mode):
        return descriptor
    os.close(descriptor)
    raise OSError(errno.EINVAL, "it is not a regular file")


class AtomicFile(Generic[R]):
    """A record that is always whole: a new file takes the place of the old one, which is the next new one.

    Both have room for any record from the start: a disk that becomes full later still takes what is decided.
    """

    def __init__(self, path: Path, model: type[R]) -> None:
        """Use this file for records of a kind; neither it nor its folder need be there yet."""
        self.path, self._model = path, model
        self._new = path.with_name(f"{path.name}.new")
        self._last = path.with_name(f"{path.name}.last")  # second name of the old file while it is replaced

    def read(self) -> R:
        """The record; an empty one when nothing was kept yet.

        Raises:
            Unreadable: there is something else.
        """
        kept = self.find()
        return self._model() if kept is None else kept

    def find(self) -> R | None:
        """The record; None when nothing was kept yet.

        Raises:
            Unreadable: there is something else.
        """
        try:
            return self._model.model_validate_json(self._text())
        except FileNotFoundError as error:
            if not self.path.is_symlink():
                return None
            why = f"it is a link to nothing ({error.strerror})"
        except OSError as error:
            why = error.strerror or str(error)
        except ValidationError:
            why = "it is damaged, or of another version"
        raise Unreadable(self.path, why)

    def _text(self) -> bytes:
        with open(open_regular(self.path, os.O_RDONLY), "rb") as file:
            return file.read(LARGEST)

    def save(self, record: R) -> None:
        """Write a record so that it is there, or the one before it, whatever happens to the machine.

        Raises:
            OSError: it could not be written.
        """
        self.make_room(record)
        self._last.unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # there is none yet, or no second names: then the next one needs new room
            os.link(self.path, self._last, follow_symlinks=False)
        self._new.replace(self.path)
        with contextlib.suppress(FileNotFoundError):
            self._last.replace(self._new)
        folder = os.open(self.path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)

    def make_room(self, record: R) -> None:
        """Write the new file, over what it holds: a file that is made shorter gives its room away.

        Raises:
            OSError: it could not be written.
        """
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileNotFoundError):
            if not os.path.lexists(self._new):
                self._last.replace(self._new)  # we were ended between the two
            found = self._new.lstat()
            if not stat.S_ISREG(found.st_mode) or found.st_nlink > 1:
                self._new.unlink()  # writing over it would change something else
        left = record.model_dump_json(indent=1).encode().ljust(ROOM - 1) + b"\n"
        descriptor = os.open(self._new, os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW, 0o600)
        try:
            while left:
                left = left[os.write(descriptor, left):]
            os.ftruncate(descriptor, os.lseek(descriptor, 0, os.SEEK_CUR))
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


