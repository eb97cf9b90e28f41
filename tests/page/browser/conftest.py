"""Real cells with their page, and a real browser.

Tests that use the browser share its event loop: `pytestmark = IN_BROWSER`.
"""

from __future__ import annotations

import asyncio
import os
import re
import shutil
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import pytest
import pytest_asyncio

from tests.domains import free_port
from tests.harness import RunningCell

if TYPE_CHECKING:
    from playwright.async_api import Browser, BrowserContext, Page, ViewportSize

IN_BROWSER = [
    pytest.mark.browser, pytest.mark.cell, pytest.mark.slow, pytest.mark.timeout(240),
    pytest.mark.asyncio(loop_scope="session"),
]
PATIENCE = 60.0  # [s] for each event; a busy machine without a GPU is slow
NAMES = ("chromium", "chromium-browser", "google-chrome-stable", "google-chrome")
ARGUMENTS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
SIZE: ViewportSize = {"width": 1280, "height": 800}  # [CSS pixels]
PIXELS = 0.5  # device pixels per CSS pixel: the CPU draws the scene
# A frame takes the CPU 0.1 s and more; ten a second leave CPU time for the cell.
FEW_FRAMES = """
const draw = window.requestAnimationFrame.bind(window);
window.requestAnimationFrame = step => setTimeout(() => draw(step), 100);
window.cancelAnimationFrame = clearTimeout;
"""
# Slow motions, so that the task is still running when a busy browser has drawn the page; an empty scene.
PANDA = ("up", "panda", "--set", "autostart=false", "--set", "services.trajectory_executor.speed_scaling=0.2",
         "--set", f"services.viewer.layout={Path(__file__).with_name('nothing_to_draw.yaml')}")


@dataclass
class Watched:
    """A page with its errors and requests."""

    page: Page
    hosts: set[str] = field(default_factory=set)  # of its requests
    errors: list[str] = field(default_factory=list)  # of its console, its scripts, and requests

    def __post_init__(self) -> None:
        self.page.set_default_timeout(PATIENCE * 1e3)
        self.page.on("request", lambda request: self._requested(request.url))
        self.page.on("websocket", lambda opened: self._requested(opened.url))
        self.page.on("console", lambda line: self.errors.append(line.text) if line.type == "error" else None)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("requestfailed", lambda request: self.errors.append(f"{request.url}: {request.failure}"))

    def _requested(self, url: str) -> None:
        host = urlsplit(url.removeprefix("blob:")).hostname
        if host is not None:  # data: and about: are no requests
            self.hosts.add(host)

    async def open(self, address: str) -> Page:
        """Return the page once it is connected and shows its scene."""
        async with self.page.expect_event("websocket"):
            await self.page.goto(address)
        await self.page.locator("canvas").first.wait_for()
        return self.page


class Viewed(RunningCell):
    """A `zencell run` or `up` with a page; `address` is known after `served`."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        self.port = free_port()
        super().__init__(folder, *arguments, "--viewer-port", str(self.port))
        self.address = ""

    async def served(self) -> Viewed:
        """Return itself once it has printed the address of its page."""
        async with asyncio.timeout(PATIENCE):
            while not (found := re.search(r"^Open (http\S+)$", self.text, re.MULTILINE)):
                if self.process.poll() is not None:
                    pytest.fail(f"the cell ended before its page was served:\n{self.tail()}")
                await asyncio.sleep(0.05)
        self.address = found[1]
        return self


Opened = Callable[[], AbstractAsyncContextManager[Watched]]


@pytest_asyncio.fixture(scope="session", loop_scope="session")
async def cell(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Viewed]:
    """A panda cell that all tests share: each leaves the arm and the task stopped."""
    with Viewed(tmp_path_factory.mktemp("viewed"), *PANDA) as cell:
        yield await cell.served()


@pytest_asyncio.fixture(scope="session", loop_scope="session")
async def browser() -> AsyncIterator[Browser]:
    """One Chromium for all tests."""
    program = next((path for name in NAMES if (path := shutil.which(name))), None)
    if program is None:
        missing("Chromium is not installed: apt install chromium")
    try:
        from playwright.async_api import async_playwright
    except ImportError:
        missing("playwright is not installed: pip install -c constraints.txt -e '.[dev]'")
    async with async_playwright() as playwright:
        started = await playwright.chromium.launch(executable_path=program, args=list(ARGUMENTS))
        yield started
        await started.close()


def missing(what: str) -> None:
    """Skip a test for a missing program; in CI that is a failure."""
    if os.environ.get("CI", "").lower() in ("true", "1"):
        pytest.fail(what, pytrace=False)
    pytest.skip(what)


@pytest_asyncio.fixture(scope="session", loop_scope="session")
async def opened(browser: Browser) -> Opened:
    """A separate browser without cookies, closed after the block: `async with opened() as watched`."""

    @asynccontextmanager
    async def block() -> AsyncIterator[Watched]:
        context: BrowserContext = await browser.new_context(viewport=SIZE, device_scale_factor=PIXELS)
        await context.add_init_script(FEW_FRAMES)
        try:
            yield Watched(await context.new_page())
        finally:
            await context.close()

    return block


@pytest_asyncio.fixture(loop_scope="session")
async def watched(opened: Opened) -> AsyncIterator[Watched]:
    """A page that is not open yet: `await watched.open(cell.address)`."""
    async with opened() as one:
        yield one


@pytest_asyncio.fixture(scope="module", loop_scope="session")
async def page(cell: Viewed, opened: Opened) -> AsyncIterator[Page]:
    """A page of the shared cell for the tests of a file; it must have no errors at the end."""
    async with opened() as watched:
        page = await watched.open(cell.address)
        await page.get_by_role("button", name="Start").wait_for()
        await page.locator("#zc-state:not(:empty)").wait_for()  # over the control socket
        yield page
        assert not watched.errors
