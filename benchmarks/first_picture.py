"""How soon a browser without a graphics card shows the whole page: its panels, and robot, objects and plan as drawn.

Everything is drawn as soon as a frame has as many triangles as those of a page that has long been open, and the last of
its pixels is there. Used by benchmarks.page.
"""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import psutil

from tests.page.browser.conftest import ARGUMENTS, NAMES

if TYPE_CHECKING:
    from playwright.async_api import Browser

PATIENCE = 120.0  # [s]
SETTLED = 3.0  # [s] a page draws the same for so long when all is there
SIZE = (1280, 800)  # [px]

TRIANGLES = "window.__viserTestpoints?.rendererInfo.render.triangles ?? 0"
WATCH = """
(() => {
  const panels = () =>
    document.body?.innerText.includes("STOP") ? tellPanels(performance.now()) : setTimeout(panels, 50);
  const picture = () => {
    const canvas = window.__viserMutable?.canvas;
    if (!canvas || (TRIANGLES) < WANTED || canvas.style.opacity === "0.05") return requestAnimationFrame(picture);
    const gl = canvas.getContext("webgl2");
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));  // waits for what is being drawn
    tellPicture(performance.now());
  };
  panels();
  picture();
})();
"""


@dataclass(frozen=True)
class Opening:
    """When a page showed its panels and its whole picture [s], and the processor time of the browser until then [s]."""

    panels: float
    picture: float
    processor: float


def chromium() -> str | None:
    """Where Chromium is; None when it is not installed."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


@asynccontextmanager
async def browser_at(program: str) -> AsyncIterator[tuple[Browser, psutil.Process]]:
    """A Chromium that draws without a graphics card, and its process."""
    from playwright.async_api import async_playwright

    async with async_playwright() as playwright:
        known = {process.pid for process in psutil.Process().children(recursive=True)}
        browser = await playwright.chromium.launch(executable_path=program, args=list(ARGUMENTS))
        started = [p for p in psutil.Process().children(recursive=True) if p.pid not in known]
        try:
            yield browser, started[0]
        finally:
            await browser.close()


async def settled_triangles(browser: Browser, address: str) -> int:
    """How many triangles the page draws once everything is there."""
    page = await browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
    await page.goto(address)
    async with asyncio.timeout(PATIENCE):
        count, since, now = 0, 0.0, asyncio.get_running_loop().time
        while not count or now() - since < SETTLED:
            found = int(await page.evaluate(TRIANGLES))
            if found != count:
                count, since = found, now()
            await asyncio.sleep(0.2)
    await page.close()
    return count


async def openings(program: str, address: str, count: int) -> list[Opening]:
    """The page opened so many times in a browser that has just started."""
    async with browser_at(program) as (browser, _):
        wanted = await settled_triangles(browser, address)
    watch = WATCH.replace("TRIANGLES", TRIANGLES).replace("WANTED", str(wanted))
    found = []
    async with browser_at(program) as (browser, process):
        context = await browser.new_context(viewport={"width": SIZE[0], "height": SIZE[1]})
        for _ in range(count):
            page = await context.new_page()
            panels, picture = asyncio.Future[float](), asyncio.Future[tuple[float, float]]()
            await page.expose_function("tellPanels", lambda at, future=panels: future.set_result(at))
            await page.expose_function(
                "tellPicture", lambda at, future=picture: future.set_result((at, processor_seconds(process))))
            await page.add_init_script(watch)
            before = processor_seconds(process)
            async with asyncio.timeout(PATIENCE):
                await page.goto(address, wait_until="commit")
                at, taken = await picture
                found.append(Opening(1e-3 * await panels, 1e-3 * at, taken - before))
            await page.close()
    return found


def processor_seconds(process: psutil.Process) -> float:
    """What a process and those that it started have taken, those that have ended left out [s]."""
    total = 0.0
    for each in (process, *process.children(recursive=True)):
        try:
            times = each.cpu_times()
        except psutil.NoSuchProcess:
            continue
        total += times.user + times.system
    return total
