"""Short films of what went wrong, from the pictures that a recording has: animated WebP, inside the page."""

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


Picture = npt.NDArray[np.uint8]

BEFORE, AFTER = 4.0, 2.0  # [s] that a film shows about the moment
MOST = 3  # moments in a page: those in which something was lost, then others, the first ones of each
MOST_CAMERAS = 4  # that have a film of a moment, by their names
PERIOD = 0.2  # [s] between two pictures, at the least
WIDTH, HEIGHT = 360, 480  # [px] at most
MOST_PIXELS = 4e6  # of a picture; a larger one takes too long to be made small
RAW = "image_raw"  # how the key of a camera's pictures ends, whatever the camera is called; depth has no colours
QUALITY = 60  # of WebP, 1 to 100


@dataclass
class Clip:
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


def moments(run: RunHistory) -> list[tuple[float, str]]:
    """When [s] something went wrong for the first times, and what; what one film shows is told once.

    What is lost goes before what was only tried again: a run may well end DONE after either. The last one is how it
    stood in the end, where that was none.
    """
    lost = [(event.time, f"{event.what} {event.note}") for event in run.losses]
    wrong = [(event.time, " ".join(filter(None, (event.what, event.note)))) for event in run.failures]
    wrong += [(motion.until or motion.since, f"motion {motion.note}: {motion.message or motion.error}")
              for motion in run.motions if motion.note in ("aborted", "rejected")]
    wrong += [(span.since, f"ERROR {span.note}".strip()) for span in run.tasks[1:]  # the first was before
              if span.label == "ERROR"]
    kept: list[tuple[float, str]] = []
    for at, what in [*sorted(lost), *sorted(wrong)]:
        if all(abs(at - other) > AFTER for other, _ in kept):
            kept.append((at, what))
    begun = len(lost) < MOST and any(span.label != "IDLE" for span in run.tasks)
    if begun and run.tasks[-1].label not in ("DONE", "ERROR") and all(run.end - at > AFTER for at, _ in kept[:MOST]):
        kept[MOST - 1:] = [(run.end, f"it ends {run.tasks[-1].label} {run.tasks[-1].note}".strip())]
    return sorted(kept[:MOST])


def films(recording: Recording, run: RunHistory) -> list[Clip]:
    """A film of each moment and camera of which there are pictures.

    Raises:
        RecordingError: a chunk is damaged.
    """
    wanted = moments(run)
    if not wanted:
        return []
    topics = image_topics(recording, lambda topic: topic.endswith(RAW))[:MOST_CAMERAS]
    found = [Clip(at, what, topic) for at, what in wanted for topic in topics]
    for at, _ in wanted if topics else ():
        _fill({film.topic: film for film in found if film.at == at}, recording, at)
    return [film for film in found if len(film.pictures) > 1]


def _fill(films_of: dict[str, Clip], recording: Recording, moment: float) -> None:
    """Put the pictures about a moment [s] into the film of each topic; only those that it shows are looked at."""
    decoder = Decoder([Image])
    since, until = (max(0, recording.start + round(1e9 * at)) for at in (moment - BEFORE, moment + AFTER))
    for sample in recording.samples(lambda topic: topic in films_of, since, until):
        film, at = films_of[sample.topic], (sample.log_time - recording.start) * 1e-9
        if film.pictures and at - film.pictures[-1][0] < PERIOD - 1e-3:
            continue
        picture = _small(decoder.message(sample))
        if picture is not None and (not film.pictures or picture.shape == film.pictures[0][1].shape):
            film.pictures.append((at, picture))  # one film has pictures of one size


def _small(message: Message | None) -> Picture | None:
    """The picture of a message, small; None for what cannot be shown."""
    if not isinstance(message, Image) or message.width * message.height > MOST_PIXELS:
        return None
    try:
        picture = decode_color_image(message)
    except FrameError:
        return None
    scale = min(1.0, WIDTH / message.width, HEIGHT / message.height)
    size = max(1, round(scale * message.width)), max(1, round(scale * message.height))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
