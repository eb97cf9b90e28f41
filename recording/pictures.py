"""Pictures of a recording as PNG files or a video."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from common.perception.image import displayable
from recording.decoding import Decoder
from recording.names import file_names
from recording.reading import Recording, Wanted
from recording.sample import RecordingError
from recording.writing import NotMade

COLOURS = ("bgr8", "rgb8", "mono8")
CODEC = "mp4v"
DEFAULT_RATE = 10.0  # [Hz] of a video of one picture


def image_topics(recording: Recording, wants: Wanted) -> list[str]:
    """The wanted topics that carry pictures."""
    return sorted(topic for topic, (name, _) in recording.topics().items() if name == "Image" and wants(topic))


def export_images(recording: Recording, folder: Path, wants: Wanted, decoder: Decoder) -> dict[str, int]:
    """Pictures that were written, by topic: FOLDER/<topic>/<number>_<stamp in ns>.png.

    Depth is written as 16 bit millimetres with 0 for none, as in ROS.

    Raises:
        RecordingError: the recording is damaged, or a file cannot be written.
    """
    topics = set(image_topics(recording, wants))
    names = file_names(sorted(topics))
    counts: Counter[str] = Counter()
    for sample in recording.samples(lambda topic: topic in topics):
        pixels = displayable(decoder.message(sample))
        if pixels is None:
            decoder.skipped[sample.topic] += 1
            continue
        place = folder / names[sample.topic]
        place.mkdir(parents=True, exist_ok=True)
        counts[sample.topic] += 1
        path = place / f"{counts[sample.topic]:06d}_{sample.publish_time}.png"
        if not cv2.imwrite(str(path), pixels):
            raise RecordingError(f"{path}: cannot be written")
    return dict(counts)


def export_video(recording: Recording, target: Path, topic: str, decoder: Decoder) -> tuple[int, float]:
    """Number of pictures in a new MP4 file of a topic, and their rate [Hz], which is the median of the recording.

    Raises:
        RecordingError: no codec is there, no picture can be shown, the recording is damaged, or the disk takes no more.
    """
    times = [sample.log_time for sample in recording.samples(lambda name: name == topic)]
    gaps = [(later - earlier) * 1e-9 for earlier, later in pairwise(times) if later > earlier]
    rate = round(1 / median(gaps), 2) if gaps else DEFAULT_RATE
    writer: cv2.VideoWriter | None = None
    size = (0, 0)
    count = 0
    try:
        for sample in recording.samples(lambda name: name == topic):
            pixels = _colour(decoder.message(sample))
            if pixels is None or (writer is not None and pixels.shape[1::-1] != size):
                decoder.skipped[topic] += 1
                continue
            if writer is None:
                size = (pixels.shape[1], pixels.shape[0])
                writer = cv2.VideoWriter(str(target), cv2.VideoWriter.fourcc(*CODEC), rate, size)
                if not writer.isOpened():
                    raise RecordingError(f"{target}: this OpenCV cannot write {CODEC} video there; try --images DIR")
            writer.write(pixels)
            count += 1
    finally:
        if writer is not None:
            writer.release()
    if not count:
        raise RecordingError(f"{recording.path}: {topic} has no colour picture; for depth use --images DIR")
    if _pictures_in(target) != count:  # OpenCV says nothing of what it could not write
        target.unlink(missing_ok=True)
        raise NotMade(target, "the disk takes no more")
    return count, rate


def _pictures_in(video: Path) -> int:
    """How many pictures a video file has, as it says itself; 0 for one that is not whole."""
    reader = cv2.VideoCapture(str(video))
    try:
        return round(reader.get(cv2.CAP_PROP_FRAME_COUNT)) if reader.isOpened() else 0
    finally:
        reader.release()


def _colour(message: Any) -> npt.NDArray[Any] | None:
    pixels = displayable(message)
    if pixels is None or message.encoding not in COLOURS:
        return None
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR)) if pixels.ndim == 2 else pixels
