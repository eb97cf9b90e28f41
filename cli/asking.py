"""Asks the person at the terminal which object is to be outlined."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from common.applications.outlining.messages import Contours
from common.applications.outlining.topics import CONTOUR_IMAGE, CONTOURS, OUTLINE_SELECT
from common.errors import ConfigError, RemoteError

if TYPE_CHECKING:
    from common.messages import Image
    from common.transport.bus import Bus

CHOOSE_BY_HAND = ("services.contour_detector.select=none", "services.contour_tracer.selection_timeout=0")


def require_terminal() -> None:
    """Return when somebody can be asked.

    Raises:
        ConfigError: nobody can.
    """
    if not sys.stdin.isatty():
        raise ConfigError("--ask", ..., "needs a terminal; without one choose with `zencell task select N`")


async def ask(bus: Bus, folder: Path) -> None:
    """Store the picture with its contours in a folder, and ask until one of them is chosen."""
    from common.applications.outlining.contours_choice import NoSuchContour, described, parse_choice

    contours, images = bus.reader(CONTOURS), bus.reader(CONTOUR_IMAGE)
    select = bus.client(OUTLINE_SELECT)
    while not (found := await contours.next()).contours:
        say("no contour in the picture yet")
    path = folder / f"{bus.cell}_contours.png"
    await _store(path, found, await images.next())
    say(f"{path} shows them: {described(found.contours)}")
    while True:
        say("outline which one? ", end="")
        try:
            wanted = parse_choice(await _line())
            if wanted is not None:
                answer = await select.call(wanted)
                say(f"{answer.label} is chosen")
                return
        except NoSuchContour as error:
            say(str(error))
        except RemoteError as error:
            say(error.message)


def say(text: str, end: str = "\n") -> None:
    """Show a text to the person."""
    sys.stdout.write(text + end)
    sys.stdout.flush()


async def _store(path: Path, contours: Contours, image: Image) -> None:
    import cv2

    from common.perception.image import image_to_array

    written, data = cv2.imencode(".png", image_to_array(image))
    assert written  # a picture of 8 bits can be
    try:
        await asyncio.to_thread(path.write_bytes, data.tobytes())
    except OSError as error:
        raise ConfigError("--ask", str(path), f"can not be written: {error.strerror or error}") from None


async def _line() -> str:
    """The next line from the terminal. Read without a thread, which could not be ended by Ctrl-C.

    Raises:
        ConfigError: there will be none.
    """
    loop, arrived = asyncio.get_running_loop(), asyncio.Event()
    loop.add_reader(sys.stdin.fileno(), arrived.set)
    try:
        await arrived.wait()
    finally:
        loop.remove_reader(sys.stdin.fileno())
    line = sys.stdin.readline()  # a terminal gives whole lines
    if not line:
        raise ConfigError("--ask", ..., "nothing was chosen")
    return line.strip()
