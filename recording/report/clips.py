"""Short clips of what went wrong from recorded images: animated WebP inside the report."""

from __future__ import annotations

import base64
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from common.messages import Image, Message
from common.perception.camera_input import FrameError, decode_color_image
from recording.export import image_topics
from recording.sample import Decoder

if TYPE_CHECKING:
    from recording.reader import Recording
    from recording.report.history import RunHistory


Pixels = npt.NDArray[np.uint8]

BEFORE, AFTER = 4.0, 2.0  # [s] around the moment
MOST = 3  # moments in a report: losses of objects first, then others, each in order of time
MOST_CAMERAS = 4  # clips of a moment, in order of camera names
PERIOD = 0.2  # [s] least time between two images
WIDTH, HEIGHT = 360, 480  # [px] largest size
MOST_PIXELS = 4e6  # of an image; a larger one takes too long to scale
RAW = "image_raw"  # end of the key of color images of any camera
QUALITY = 60  # of WebP, 1 to 100


@dataclass
class Clip:
    """Images around a moment.

    Attributes:
        at: time since the start of the recording [s].
        what: happened then.
        topic: of the images.
        images: (time [s], bgr8) in order.
    """

    at: float
    what: str
    topic: str
    images: list[tuple[float, Pixels]] = field(default_factory=list)

    @property
    def address(self) -> str:
        """Data URL of the looping animation, for an `img` element."""
        animation = cv2.Animation(0)
        animation.frames = [image for _, image in self.images]
        steps = [later - earlier for (earlier, _), (later, _) in pairwise(self.images)]
        animation.durations = [round(1e3 * step) for step in [*steps, 1.0]]  # the last one stays longer
        _, encoded = cv2.imencodeanimation(".webp", animation, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
        return f"data:image/webp;base64,{base64.b64encode(encoded.tobytes()).decode()}"


def moments(run: RunHistory) -> list[tuple[float, str]]:
    """Return times [s] and descriptions of the first failures; a clip shows several close ones once.

    Lost objects come before retries, since a run may end DONE after either. An unfinished run gets its end as the last
    moment.
    """
    lost = [(event.time, f"{event.what} {event.note}") for event in run.losses]
    wrong = [(event.time, " ".join(filter(None, (event.what, event.note)))) for event in run.failures]
    wrong += [(motion.until or motion.since, f"motion {motion.note}: {motion.message or motion.error}")
              for motion in run.motions if motion.note in ("aborted", "rejected")]
    wrong += [(span.since, f"ERROR {span.note}".strip()) for span in run.tasks[1:]  # the first was before the recording
              if span.label == "ERROR"]
    chosen: list[tuple[float, str]] = []
    for at, what in [*sorted(lost), *sorted(wrong)]:
        if all(abs(at - other) > AFTER for other, _ in chosen):
            chosen.append((at, what))
    unfinished = (len(lost) < MOST and any(span.label != "IDLE" for span in run.tasks)
                  and run.tasks[-1].label not in ("DONE", "ERROR"))
    if unfinished and all(run.end - at > AFTER for at, _ in chosen[:MOST]):
        chosen[MOST - 1:] = [(run.end, f"it ends {run.tasks[-1].label} {run.tasks[-1].note}".strip())]
    return sorted(chosen[:MOST])


def clips(recording: Recording, run: RunHistory) -> list[Clip]:
    """Return a clip of each moment and camera with images.

    Raises:
        RecordingError: a chunk is damaged.
    """
    wanted = moments(run)
    if not wanted:
        return []
    topics = image_topics(recording, lambda topic: topic.endswith(RAW))[:MOST_CAMERAS]
    found = [Clip(at, what, topic) for at, what in wanted for topic in topics]
    for at, _ in wanted if topics else ():
        _fill({clip.topic: clip for clip in found if clip.at == at}, recording, at)
    return [clip for clip in found if len(clip.images) > 1]


def _fill(clips_of: dict[str, Clip], recording: Recording, moment: float) -> None:
    """Add the images around a moment [s] to the clip of each topic; only the images it shows are decoded."""
    decoder = Decoder([Image])
    since, until = (max(0, recording.start + round(1e9 * at)) for at in (moment - BEFORE, moment + AFTER))
    for sample in recording.samples(lambda topic: topic in clips_of, since, until):
        clip, at = clips_of[sample.topic], (sample.log_time - recording.start) * 1e-9
        if clip.images and at - clip.images[-1][0] < PERIOD - 1e-3:
            continue
        pixels = _scaled(decoder.message(sample))
        if pixels is not None and (not clip.images or pixels.shape == clip.images[0][1].shape):
            clip.images.append((at, pixels))  # a clip has images of one size


def _scaled(message: Message | None) -> Pixels | None:
    """Return the image of a message scaled down; None if it cannot be shown."""
    if not isinstance(message, Image) or message.width * message.height > MOST_PIXELS:
        return None
    try:
        pixels = decode_color_image(message)
    except FrameError:
        return None
    scale = min(1.0, WIDTH / message.width, HEIGHT / message.height)
    size = max(1, round(scale * message.width)), max(1, round(scale * message.height))
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)
