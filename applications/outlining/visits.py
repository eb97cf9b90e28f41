"""Visits to an outlining cell: ask the operator at the terminal for an object, store what the camera sees."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from applications.outlining import stage_files
from applications.outlining.contour_choice import NoSuchContour, described, middle_of, parse_choice
from applications.outlining.topics import (
    CONTOUR_IMAGE,
    CONTOUR_PATH,
    CONTOUR_POINTS,
    CONTOURS,
    OUTLINE_SELECT,
    Contours,
    OutlinePoints,
    OutlineSelect,
    OutlineSelection,
)
from common import topics
from common.errors import ConfigError, NoResponder, RemoteError, RequestFailed, RequestLost, ZencellError
from common.perception.camera_input import decode_color_image
from common.perception.depth import depth_of
from common.perception.image import image_to_array
from common.terminal import printable

if TYPE_CHECKING:
    from common.messages import Image
    from common.transport.bus import Bus, Reader
    from common.transport.requests import Client

TRIES = 3  # of a selection request
AGAIN_WITHIN = 5.0  # [s] for the connection to recover
TIMEOUT = 30.0  # [s] for an image and its outline
CACHED = 100  # images whose contours and points are cached until their path arrives
ALL_WITHIN = 3.0  # [s, cell time] after the first image for a contour to be selected
CHOOSE_BY_HAND = ("services.contour_detector.select=none", "services.contour_tracer.selection_timeout=0")

M = TypeVar("M", Contours, OutlinePoints)


class NoOutline(ZencellError):
    """The images were stored, but they have no outline."""

    exit_code = 1


def require_terminal() -> None:
    """Return if an operator can be asked.

    Raises:
        ConfigError: standard input is no terminal.
    """
    if not sys.stdin.isatty():
        raise ConfigError("--ask", ..., "needs a terminal; without one choose with `zencell task select N`")


async def ask_operator(bus: Bus, folder: Path, read_line: Callable[[], Awaitable[str]] | None = None) -> None:
    """Store the image with its contours in a folder, and ask until one of them is selected."""
    contours, images = bus.reader(CONTOURS), bus.reader(CONTOUR_IMAGE)
    select = bus.client(OUTLINE_SELECT)
    found, image = await _drawn(contours, images)
    path = folder / f"{bus.cell}_contours.png"
    await _write_image(path, image)
    print_line(f"{path} shows them: {described(found.contours)}")
    while True:
        print_line("outline which one? ", end="")
        try:
            wanted = parse_choice(await (read_line or _line)())
            if wanted is not None:
                if wanted.index is not None and wanted.index < len(found.contours):
                    wanted.at = middle_of(found.contours[wanted.index])  # in the image that the operator sees
                answer = await _chosen(select, wanted)
                print_line(f"{answer.label} is chosen")
                return
        except NoSuchContour as error:
            print_line(str(error))
        except RemoteError as error:
            print_line(error.message)
        except RequestFailed as error:
            print_line(str(error))


async def _chosen(select: Client[OutlineSelect, OutlineSelection], wanted: OutlineSelect) -> OutlineSelection:
    """Request a selection; repeat it after a lost answer, since the result is the same."""
    for _ in range(TRIES - 1):
        with suppress(RequestLost):
            return await select.call(wanted)
        with suppress(NoResponder):  # the connection to the router may be lost
            await select.wait_available(AGAIN_WITHIN)
    return await select.call(wanted)


def print_line(text: str, end: str = "\n") -> None:
    """Print a text for the operator."""
    sys.stdout.write(printable(text) + end)
    sys.stdout.flush()


async def _drawn(contours: Reader[Contours], images: Reader[Image]) -> tuple[Contours, Image]:
    """Return the first contours and the image with these drawn in: another image may be numbered differently."""
    found, image = await contours.next(), await images.next()
    while not found.contours or found.header.stamp != image.header.stamp:
        if not found.contours:
            print_line("no contour in the picture yet")
        if not found.contours or found.header.stamp < image.header.stamp:
            found = await contours.next()
        else:
            image = await images.next()
    return found, image


async def _write_image(path: Path, image: Image) -> None:
    import cv2

    written, data = cv2.imencode(".png", image_to_array(image))
    assert written  # 8 bit images can be encoded
    try:
        await asyncio.to_thread(path.write_bytes, data.tobytes())
    except OSError as error:
        raise ConfigError("--ask", str(path), f"cannot be written: {error.strerror or error}") from None


async def _line() -> str:
    """Return the next line from the terminal. Reads without a thread, which Ctrl-C could not end.

    Raises:
        ConfigError: the input has ended.
    """
    loop, arrived = asyncio.get_running_loop(), asyncio.Event()
    loop.add_reader(sys.stdin.fileno(), arrived.set)
    try:
        await arrived.wait()
    finally:
        loop.remove_reader(sys.stdin.fileno())
    line = sys.stdin.readline()  # a terminal delivers complete lines
    if not line:
        raise ConfigError("--ask", ..., "nothing was chosen")
    return line.strip()


async def store_stages(bus: Bus, folder: Path, wanted: OutlineSelect | None) -> str:
    """Store an image, its depth and the stages of its outline in a folder; return a line that names them.

    Raises:
        NoOutline: the image has no outline.
        StageFileError: a file cannot be written.
    """
    pictures, depths = bus.reader(topics.DEPTH_CAMERA_IMAGE), bus.reader(topics.DEPTH_CAMERA_DEPTH)
    contours, points, paths = bus.reader(CONTOURS), bus.reader(CONTOUR_POINTS), bus.reader(CONTOUR_PATH)
    seen, found, cleared = dict[int, Contours](), dict[int, OutlinePoints](), dict[int, OutlinePoints]()
    more = asyncio.Event()
    noting: list[asyncio.Task[None]] = []
    try:
        async with asyncio.timeout(TIMEOUT):
            first = await pictures.next()
            chosen_at = -1  # stamp of the newest image that may have had another selection
            if wanted is not None and wanted.rule != "auto":
                await contours.next()
                await _chosen(bus.client(OUTLINE_SELECT), wanted)
                chosen_at = max(each.latest.header.stamp for each in (pictures, contours) if each.latest is not None)
            noting += [asyncio.create_task(_note(*each, more))  # also while files are written
                       for each in ((points, found), (paths, cleared))]
            noting.append(asyncio.create_task(_note(contours, seen, more)))
            picture, depth = await _pair(pictures, depths, chosen_at)
            # In a thread: a blocked loop would lose all but the newest messages.
            await asyncio.to_thread(stage_files.write_pictures, folder, decode_color_image(picture), depth_of(depth))
            while True:
                more.clear()
                since = [path for stamp, path in sorted(cleared.items()) if stamp >= picture.header.stamp]
                # All stages of the path's own image: in another image the object may have another label.
                whole = [path for path in since if path.poses and path.header.stamp in seen.keys() & found.keys()]
                if whole:
                    break
                late = [path for path in since if path.header.stamp - first.header.stamp > ALL_WITHIN * 1e9]
                if late and late[-1].message and not late[-1].poses:
                    raise NoOutline(f"{late[-1].message}; the picture is in {folder}")
                await more.wait()
    except TimeoutError:
        raise NoOutline(f"no outline received within {TIMEOUT:g} s: does the cell have a depth camera?") from None
    finally:
        for task in noting:
            task.cancel()
    path, stamp = whole[0], whole[0].header.stamp
    chosen = next((contour for contour in seen[stamp].contours if contour.label == path.object), None)
    if chosen is not None:
        stage_files.write_points(folder / stage_files.PIXELS, chosen.pixels)
    stage_files.write_points(folder / stage_files.COORDINATES, _points(found[stamp]))
    stage_files.write_points(folder / stage_files.CLEARED, _points(path))
    return f"{path.object}, {len(path.poses)} points: the picture and the stages are in {folder}"


async def _note(reader: Reader[M], cache: dict[int, M], more: asyncio.Event) -> None:
    """Cache the newest messages by the stamps of their images."""
    async for message in reader:
        cache[message.header.stamp] = message
        while len(cache) > CACHED:
            del cache[next(iter(cache))]
        more.set()


async def _pair(pictures: Reader[Image], depths: Reader[Image], after: int) -> tuple[Image, Image]:
    """Return an image later than a stamp, and the depth image taken with it."""
    while True:
        picture, depth = await pictures.next(), depths.latest
        if depth is not None and depth.header.stamp == picture.header.stamp > after:
            return picture, depth


def _points(outline: OutlinePoints) -> list[tuple[float, float, float]]:
    return [(p.position.x, p.position.y, p.position.z) for p in outline.poses]
