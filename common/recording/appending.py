"""A file that is only appended to, unbuffered, so that what was written is on its way to the disk."""

from __future__ import annotations

import errno
import os
from pathlib import Path

from common.recording.sample import RecordingError

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class WritingFailed(RecordingError):
    """The disk takes no more; what was written before is kept."""

    exit_code = 1

    def __init__(self, path: Path, error: OSError) -> None:
        why = "the disk is full" if error.errno in FULL else (error.strerror or str(error))
        super().__init__(f"{path}: recording stopped, {why}; what was written is kept: zencell recover {path}")
        self.path = path
        self.errno = error.errno


class AppendedFile:
    """What an MCAP writer needs of a stream."""

    def __init__(self, path: Path) -> None:
        """Create the file.

        Raises:
            RecordingError: it is there already, or can not be made.
        """
        self.path = path
        try:
            self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        except FileExistsError:
            raise RecordingError(f"{path}: is there already; choose another name") from None
        except OSError as error:
            raise RecordingError(f"{path}: can not be written: {error.strerror}") from None
        self._size = 0

    def write(self, data: bytes) -> int:
        """Append all of the data, which are whole records.

        Raises:
            WritingFailed: the disk takes no more; none of the data are in the file then.
        """
        view = memoryview(data)
        while view:
            try:
                written = os.write(self._file, view)
            except OSError as error:
                os.ftruncate(self._file, self._size)
                raise WritingFailed(self.path, error) from None
            view = view[written:]
        self._size += len(data)
        return len(data)

    def tell(self) -> int:
        """Bytes written so far."""
        return self._size

    def flush(self) -> None:
        """Nothing is held back."""

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)
