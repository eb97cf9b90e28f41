"""The page in a real browser: it loads without other hosts, and pages do not disturb the task."""

import asyncio
from collections.abc import Iterator
from contextlib import AsyncExitStack
from pathlib import Path

import msgspec
import pytest
import viser
from websockets import Origin, Subprotocol
from websockets.asyncio.client import ClientConnection
from websockets.asyncio.client import connect as connect_socket

from applications.pick_place.topics import PICK_PLACE_STATUS
from common import topics
from common.messages import TaskCommand
from page.server import close_server, make_server
from tests.harness import until
from tests.page.browser.conftest import IN_BROWSER, PATIENCE, Opened, Viewed, Watched
from tests.page.fake_browser import CAMERA

pytestmark = IN_BROWSER

SECRET = "correct-horse-battery"


async def assert_loads(watched: Watched, address: str) -> None:
    """Load a page with its complete scene; check that it has no errors and needs no other hosts."""
    page = await watched.open(address)
    await page.wait_for_load_state("networkidle")
    assert watched.hosts == {"127.0.0.1"} and watched.errors == []


async def test_page_loads_without_errors_and_without_other_hosts(tmp_path: Path, watched: Watched) -> None:
    with Viewed(tmp_path, "up", "ur5", "--set", "autostart=false") as cell:
        await assert_loads(watched, (await cell.served()).address)


async def test_pages_that_connect_and_disconnect_do_not_disturb_the_task(opened: Opened, tmp_path: Path) -> None:
    """Ten WebSockets instead of ten browsers: some stay, some disappear, one never reads."""
    with Viewed(tmp_path, "up", "panda", "--speed", "4", "--set", "world.count=2", "--set", "autostart=false") as cell:
        await cell.served()
        async with cell.listen() as bus, AsyncExitStack() as stack:
            status = bus.reader(PICK_PLACE_STATUS)
            sockets = await asyncio.gather(*(stack.enter_async_context(socket_of(cell)) for _ in range(10)))
            for socket in sockets:
                await socket.send(msgspec.msgpack.encode(CAMERA))
            for socket in sockets[:9]:
                await receive(socket)
            await bus.client(topics.TASK_COMMAND).call(TaskCommand(command="start"), PATIENCE)
            await until(status, lambda status: status.started, PATIENCE)
            for socket in sockets[:4]:
                socket.transport.abort()
            async with opened() as watched:
                await assert_loads(watched, cell.address)
            done = await until(status, lambda status: status.state in ("DONE", "ERROR"), PATIENCE * 2)
            for socket in sockets[4:9]:
                await receive(socket)
        cell.interrupt()
        assert await cell.ended(PATIENCE) == 0, cell.tail()
        assert (done.state, done.placed) == ("DONE", 2)
        assert cell.summary["truth"]["in_box"] == 2
        assert not any(cell.summary["restarts"].values())


def socket_of(cell: Viewed) -> connect_socket:
    """Return the WebSocket of a page as a browser opens it."""
    return connect_socket(
        cell.address.replace("http", "ws"), origin=Origin(cell.address), max_size=None, proxy=None, close_timeout=1,
        subprotocols=[Subprotocol(f"viser-v{viser.__version__}")], open_timeout=PATIENCE,
    )


async def receive(socket: ClientConnection) -> None:
    """Receive three more messages."""
    for _ in range(3):
        assert isinstance(await socket.recv(), bytes)


@pytest.fixture
def remote() -> Iterator[viser.ViserServer]:
    """A page that other machines could reach."""
    server = make_server("0.0.0.0", 0, SECRET)
    server.gui.add_button("A button")
    yield server
    close_server(server)


async def test_token_opens_the_page_is_hidden_and_gives_other_web_pages_no_access(
    remote: viser.ViserServer, watched: Watched
) -> None:
    address = f"http://127.0.0.1:{remote.get_port()}/"
    page = await watched.open(f"{address}?token={SECRET}")
    await page.get_by_role("button", name="A button").wait_for()
    assert page.url == address, "the token is removed from the address"
    assert SECRET not in await page.evaluate("document.cookie")
    await watched.open(address)  # with the cookie
    assert watched.errors == []
    foreign = await page.context.new_page()
    # Of the same site, so that the browser sends the cookie.
    await foreign.route("http://127.0.0.1:9/", lambda route: route.fulfill(content_type="text/html", body="<p>evil"))
    await foreign.goto("http://127.0.0.1:9/")
    assert await foreign.evaluate(
        """([address, protocol]) => new Promise(resolve => {
            const socket = new WebSocket(address, protocol);
            socket.onopen = () => resolve("opened");
            socket.onerror = () => resolve("rejected");
        })""", [address.replace("http", "ws"), f"viser-v{viser.__version__}"]) == "rejected"
    assert await foreign.evaluate(
        """address => new Promise(resolve => {
            const frame = document.createElement("iframe");
            frame.onload = () => resolve(frame.contentDocument === null ? "not readable" : "read");
            frame.src = address;
            document.body.append(frame);
        })""", address) == "not readable"
    assert await foreign.frames[-1].locator("canvas").count() == 0 and "error" in foreign.frames[-1].url
