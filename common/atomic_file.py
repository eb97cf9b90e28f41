"""Files that are always complete, in which state outlives its service and a power failure."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import stat
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Generic, TypeVar

from pydantic import BaseModel, ValidationError

from common.errors import ConfigError, ZencellError

R = TypeVar("R", bound=BaseModel)

STATE_VARIABLE = "ZENCELL_STATE"  # folder of persistent state: interlocks, added solids, the simulated world
RUNTIME_VARIABLE = "ZENCELL_STANDING"  # folder of state that is deleted when the cell ends, such as the simulated world
MAX_BYTES = 1_000_000  # that are read of a file
ROOM = 128 * 1024  # [bytes] reserved for each file: more than the largest record


def state_folder(environ: Mapping[str, str] = os.environ) -> Path:
    """Return the folder of persistent state: ZENCELL_STATE, else one in the user's home.

    Raises:
        ConfigError: the user has no home.
    """
    if given := environ.get(STATE_VARIABLE):
        return Path(given)
    try:
        return Path(environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "zencell"
    except RuntimeError:
        expected = "must name a folder for persistent state, such as interlocks: this user has no home"
        raise ConfigError(STATE_VARIABLE, ..., expected) from None


def runtime_folder(environ: Mapping[str, str] = os.environ) -> Path | None:
    """Return the folder of state that outlives a service but not the cell; None: it is not saved."""
    folder = environ.get(RUNTIME_VARIABLE) or environ.get(STATE_VARIABLE)
    return Path(folder) if folder else None


def world_file(cell: str, environ: Mapping[str, str] = os.environ) -> Path | None:
    """Return the file of a cell's simulated world, or None if no folder is configured.

    The name includes the host: a restarted container has the same name, a new one has not.
    """
    folder = runtime_folder(environ)
    return folder / f"{cell}-{socket.gethostname()}.state" if folder else None


class Unreadable(ZencellError):
    """A file that holds no valid record."""

    def __init__(self, path: Path, why: str) -> None:
        super().__init__(f"{path} cannot be read: {why}")
        self.path, self.why = path, why


def open_regular(path: Path, flags: int) -> int:
    """Open a file and return its descriptor; a new file is private to this user.

    Raises:
        OSError: it cannot be opened, or is no regular file.
    """
    descriptor = os.open(path, flags | os.O_NONBLOCK, 0o600)  # opening a pipe would block without
    if stat.S_ISREG(os.fstat(descriptor).st_mode):
        return descriptor
    os.close(descriptor)
    raise OSError(errno.EINVAL, "it is not a regular file")


class AtomicFile(Generic[R]):
    """A record in a file that is always complete: a new file replaces the old one, which becomes the next new one.

    Both reserve room for any record from the start: a disk that gets full later still takes new records.
    """

    def __init__(self, path: Path, model: type[R]) -> None:
        """Use this file for records of a model; neither it nor its folder need exist yet."""
        self.path, self._model = path, model
        self._new = path.with_name(f"{path.name}.new")
        self._last = path.with_name(f"{path.name}.last")  # second name of the old file while it is replaced

    def read(self) -> R:
        """Return the record; a default one if none was saved yet.

        Raises:
            Unreadable: the file holds no valid record.
        """
        record = self.find()
        return self._model() if record is None else record

    def find(self) -> R | None:
        """Return the record; None if none was saved yet.

        Raises:
            Unreadable: the file holds no valid record.
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
            return file.read(MAX_BYTES)

    def save(self, record: R) -> None:
        """Save a record; a power failure at any time leaves this or the previous one.

        Raises:
            OSError: it could not be written.
        """
        self.make_room(record)
        self._last.unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # no file yet, or no hard links: then the next save needs new room
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
        """Write the new file over its previous contents: truncating a file would release its room.

        Raises:
            OSError: it could not be written.
        """
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileNotFoundError):
            if not os.path.lexists(self._new):
                self._last.replace(self._new)  # a process was killed between the two renames
            found = self._new.lstat()
            if not stat.S_ISREG(found.st_mode) or found.st_nlink > 1:
                self._new.unlink()  # writing to it would change another file
        left = record.model_dump_json(indent=1).encode().ljust(ROOM - 1) + b"\n"
        descriptor = os.open(self._new, os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW, 0o600)
        try:
            while left:
                left = left[os.write(descriptor, left):]
            os.ftruncate(descriptor, os.lseek(descriptor, 0, os.SEEK_CUR))
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def write_atomically(path: Path, content: str) -> None:
    """Write a complete file or nothing; create its folder.

    Raises:
        OSError: it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())  # otherwise the file may be empty after a power failure
        Path(name).chmod(path.stat().st_mode if path.exists() else 0o644)
        Path(name).replace(path)
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            Path(name).unlink()
        raise
