"""H.264 video with exactly the given frames, by PyAV: frame k is at k / fps, and each second frame is a key frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from recording.datasets import optional

CODEC, PIXELS = "libx264", "yuv420p"
# Of LeRobot: a key frame at each second frame, for random access. Frames are in the order in which they are shown.
OPTIONS = {"crf": "18", "g": "2", "bf": "0", "preset": "veryfast", "threads": "2"}


class VideoFile:
    """One MP4 file that is written; frames of several episodes follow each other."""

    def __init__(self, path: Path, fps: int, width: int, height: int, option: str) -> None:
        """Create the file and its folders; width and height are even.

        Raises:
            ConfigError: PyAV is not installed.
        """
        self._av = optional("av", option)
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path, self.frames, self.fps = path, 0, fps
        self._container: Any = self._av.open(str(path), "w")
        self._stream: Any = self._container.add_stream(CODEC, rate=fps, options=OPTIONS)
        self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, PIXELS

    def add(self, pixels: npt.NDArray[np.uint8]) -> None:
        """Append an RGB image (height, width, 3)."""
        frame = self._av.VideoFrame.from_ndarray(pixels, format="rgb24")
        self._container.mux(self._stream.encode(frame))
        self.frames += 1

    def close(self) -> None:
        """Write the rest and the index."""
        self._container.mux(self._stream.encode(None))
        self._container.close()
