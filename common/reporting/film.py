"""Short films of what went wrong, from the pictures that a recording has: animated WebP, inside the page."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from common.messages import Image
from common.perception.intake import Unusable, colour_picture
from common.recording.decoding import Decoder
from common.recording.pictures import image_topics

if TYPE_CHECKING:
    from common.recording.reading import Recording
    from common.reporting.gathering import Gathering

Picture = npt.NDArray[np.uint8]

BEFORE, AFTER = 4.0, 2.0  # [s] that a film shows about the moment
MOST = 3  # films in a page, the first ones
PERIOD = 0.2  # [s] between two pictures, at the least
WIDTH = 360  # [px] at most
MOST_PIXELS = 4e6  # of a picture; a larger one takes too long to be made small
RAW = "image_raw"  # how the key of a camera's pictures ends, whatever the camera is called; depth has no colours
QUALITY = 60  # of WebP, 1 to 100


@dataclass
class Film:
    """Pictures about a moment.

    Attributes:
        at: the moment [s] since the recording began.
        what: happened then.
        topic: of the pictures.
        pictures: (time [s], bgr8), in their order.
    """

    at: float
    what: str
    topic: str
    pictures: list[tuple[float, Picture]] = field(default_factory=list)

    @property
    def address(self) -> str:
        """The film as an address of its own, for an `img`; it begins again when it ends."""
        animation = cv2.Animation(0)
        animation.frames = [picture for _, picture in self.pictures]
        steps = [later - earlier for (earlier, _), (later, _) in pairwise(self.pictures)]
        animation.durations = [round(1e3 * step) for step in [*steps, 1.0]]  # the last one stays for a while
        _, film = cv2.imencodeanimation(".webp", animation, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
        return f"data:image/webp;base64,{base64.b64encode(film.tobytes()).decode()}"


def moments(run: Gathering) -> list[tuple[float, str]]:
    """When [s] something went wrong for the first times, and what; what one film shows is told once."""
    wrong = [(event.time, " ".join(filter(None, (event.what, event.note)))) for event in run.failures]
    wrong += [(motion.until or motion.since, f"motion {motion.note}: {motion.message or motion.error}")
              for motion in run.motions if motion.note in ("aborted", "rejected")]
    wrong += [(span.since, f"ERROR {span.note}".strip()) for span in run.tasks if span.label == "ERROR"]
    kept: list[tuple[float, str]] = []
    for at, what in sorted(wrong):
        if not kept or at - kept[-1][0] > AFTER:
            kept.append((at, what))
    return kept[:MOST]


def films(recording: Recording, run: Gathering) -> list[Film]:
    """A film of each moment and camera of which there are pictures.

    Raises:
        RecordingError: a chunk is damaged.
    """
    wanted = moments(run)
    topics = image_topics(recording, lambda topic: topic.endswith(RAW))
    if not wanted or not topics:
        return []
    found = [Film(at, what, topic) for at, what in wanted for topic in topics]
    since = recording.start + round((wanted[0][0] - BEFORE) * 1e9)
    for at, topic, picture in _pictures(recording, topics, max(since, 0), wanted[-1][0] + AFTER):
        for film in found:
            last = film.pictures[-1][0] if film.pictures else -np.inf
            if film.topic == topic and film.at - BEFORE <= at <= film.at + AFTER and at - last >= PERIOD - 1e-3:
                film.pictures.append((at, picture))
    return [film for film in found if len(film.pictures) > 1]


def _pictures(
    recording: Recording, topics: list[str], since: int, until: float
) -> Iterator[tuple[float, str, Picture]]:
    """Time [s], topic and the small picture of what can be shown."""
    decoder, sizes = Decoder([Image]), dict[str, tuple[int, int]]()
    for sample in recording.samples(lambda topic: topic in topics, since):
        at = (sample.log_time - recording.start) * 1e-9
        if at > until:
            return
        message = decoder.message(sample)
        if not isinstance(message, Image) or message.width * message.height > MOST_PIXELS:
            continue
        size = sizes.setdefault(sample.topic, (message.width, message.height))
        if size != (message.width, message.height):
            continue  # one film has pictures of one size
        try:
            picture = colour_picture(message)
        except Unusable:
            continue
        scale = min(1.0, WIDTH / message.width)
        yield at, sample.topic, np.asarray(cv2.resize(
            picture, (max(1, round(scale * message.width)), max(1, round(scale * message.height))),
            interpolation=cv2.INTER_AREA), np.uint8)
