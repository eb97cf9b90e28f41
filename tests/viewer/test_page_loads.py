"""The page in a real browser: it opens, asks nobody else for anything, and its comings and goings change nothing."""

import asyncio
from collections.abc import Iterator
from pathlib import Path

import pytest
import viser

from common.viewer.guard import close_server, make_server
from tests.viewer.conftest import IN_BROWSER, PATIENCE, SMALL, Bring, Opened, Viewed, Watched

pytestmark = IN_BROWSER

SECRET = "correct-horse-battery"
WAITING = ("--set", "autostart=false")


@pytest.mark.parametrize("cell", ["panda", "ur5"])
async def test_page_opens_without_an_error_and_asks_no_other_host(bring: Bring, watched: Watched, cell: str) -> None:
    up = await bring("up", cell, *WAITING)
    page = await watched.open(up.address)
    await page.wait_for_load_state("networkidle")
    assert watched.hosts == {"127.0.0.1"}
    assert watched.errors == [] and watched.failed == []


async def test_ten_pages_come_and_go_while_the_task_is_done(opened: Opened, tmp_path: Path) -> None:
    with Viewed(tmp_path, "run", "panda", "--speed", "2", "--set", "world.count=3") as cell:
        await cell.served()
        ended = asyncio.create_task(cell.ended(PATIENCE * 2))

        async def come_and_go() -> list[str]:
            async with opened(SMALL) as watched:
                await watched.open(cell.address)
                return watched.errors

        errors = await asyncio.gather(*(come_and_go() for _ in range(10)))
        assert await ended == 0, cell.tail()
        assert errors == [[]] * 10
        done = cell.summary
        assert (done["state"], done["placed"], done["truth"]["in_box"]) == ("DONE", 3, 3)
        assert not any(done["restarts"].values())


@pytest.fixture
def wide() -> Iterator[viser.ViserServer]:
    """A page that other machines could reach, for as long as a test takes."""
    server = make_server("0.0.0.0", 0, SECRET)
    server.gui.add_button("A button")
    yield server
    close_server(server)


async def test_token_opens_the_page_once_and_is_not_in_the_address_then(
    wide: viser.ViserServer, watched: Watched
) -> None:
    address = f"http://127.0.0.1:{wide.get_port()}/"
    refused = await watched.page.goto(address)
    assert refused is not None and refused.status == 401
    watched.errors.clear()  # the browser notes the refusal
    page = await watched.open(f"{address}?token={SECRET}")
    await page.get_by_role("button", name="A button").wait_for()
    assert page.url == address
    assert SECRET not in await page.evaluate("document.cookie")
    await watched.open(address)  # with the cookie
    assert watched.errors == [] and watched.failed == []


async def test_another_web_page_in_the_same_browser_reaches_nothing(wide: viser.ViserServer, watched: Watched) -> None:
    address = f"127.0.0.1:{wide.get_port()}"
    page = await watched.open(f"http://{address}/?token={SECRET}")
    await page.get_by_role("button", name="A button").wait_for()
    foreign = await page.context.new_page()
    # Of the same site, which is all that its cookie asks for.
    await foreign.route("http://127.0.0.1:9/", lambda route: route.fulfill(content_type="text/html", body="<p>evil"))
    await foreign.goto("http://127.0.0.1:9/")
    protocol = f"viser-v{viser.__version__}"
    ended = await foreign.evaluate(
        """([address, protocol]) => new Promise(resolve => {
            const socket = new WebSocket(`ws://${address}/`, protocol);
            socket.onopen = () => resolve("opened");
            socket.onerror = () => resolve("refused");
        })""", [address, protocol],
    )
    assert ended == "refused"
    framed = await foreign.evaluate(
        """address => new Promise(resolve => {
            const frame = document.createElement("iframe");
            frame.onload = () => resolve(frame.contentDocument === null ? "not ours to read" : "read");
            frame.src = `http://${address}/`;
            document.body.append(frame);
        })""", address,
    )
    assert framed == "not ours to read"
    frame = foreign.frames[-1]
    assert await frame.locator("canvas").count() == 0 and "error" in frame.url
