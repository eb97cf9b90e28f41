"""A real server of pages: whom it lets in, whom it refuses, and what it cannot be made to do."""

import asyncio
import http.client
import logging
import re
import socket
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from dataclasses import dataclass
from email.message import Message
from functools import partial
from typing import Any

import msgspec
import pytest
import viser
import websockets
from viser._messages import GuiUpdateMessage, ShareUrlRequest
from websockets.asyncio.client import ClientConnection
from websockets.asyncio.client import connect as connect_socket

from common.config import load_cell, service_config
from common.config.tunables import describe
from common.errors import ConfigError
from page import server as guard
from page.access import ROLES, TOKEN_VARIABLE
from page.console import ActionQueue
from page.permissions import Need, Permissions
from page.server import close_server, make_server
from page.viser_inside import client_files
from services.viewer import Config
from tests.page.fake_browser import CAMERA

SECRET = "correct-horse-battery"
PATIENCE = 20.0  # [s]
Make = Callable[..., viser.ViserServer]


@pytest.fixture
def make(monkeypatch: pytest.MonkeyPatch) -> Iterator[Make]:
    """Makes servers that are closed at the end."""
    monkeypatch.delenv(TOKEN_VARIABLE, raising=False)
    made: list[viser.ViserServer] = []

    def one(
        host: str = "127.0.0.1", port: int = 0, token: str = "", **options: Any
    ) -> viser.ViserServer:
        made.append(make_server(host, port, token, **options))
        return made[-1]

    yield one
    for server in made:
        close_server(server)


@dataclass(frozen=True)
class Got:
    status: int
    text: str
    headers: Message


def get(server: viser.ViserServer, path: str = "/", **headers: str) -> Got:
    """The answer to a plain request."""
    connection = http.client.HTTPConnection("127.0.0.1", server.get_port(), timeout=PATIENCE)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    got = Got(answer.status, answer.read().decode(), answer.headers)
    connection.close()
    return got


def open_page(
    server: viser.ViserServer, name: str = "127.0.0.1", origin: str | None = None, path: str = "/",
    cookie: str | None = None,
) -> AbstractAsyncContextManager[ClientConnection]:
    """The WebSocket of a page, as a browser opens it that believes the server's name to be `name`."""
    port = server.get_port()

    @asynccontextmanager
    async def opened() -> AsyncIterator[ClientConnection]:
        async with connect_socket(
            f"ws://{name}:{port}{path}", host="127.0.0.1", port=port, proxy=None,
            origin=websockets.Origin(origin) if origin else None,
            subprotocols=[websockets.Subprotocol(f"viser-v{viser.__version__}")], max_size=None,
            additional_headers={"Cookie": cookie} if cookie else None, open_timeout=PATIENCE,
        ) as connection:
            yield connection

    return opened()


async def refused(*arguments: Any, **options: Any) -> int:
    """Status with which the WebSocket of a page was refused."""
    with pytest.raises(websockets.InvalidStatus) as error:
        async with open_page(*arguments, **options):
            pass
    return error.value.response.status_code


async def test_page_and_its_socket_are_served_to_this_machine(make: Make) -> None:
    server = make()
    answer = get(server)
    assert answer.status == 200 and "<html" in answer.text
    async with open_page(server, origin=f"http://127.0.0.1:{server.get_port()}") as connection:
        assert isinstance(await connection.recv(), bytes)


async def test_page_of_another_site_can_not_open_the_socket(make: Make) -> None:
    server = make()
    assert await refused(server, origin="http://evil.example") == 403
    assert await refused(server, origin=f"http://localhost:{server.get_port()}") == 403
    assert await refused(server, origin="null") == 403
    answer = get(server, Origin="http://evil.example")
    assert answer.status == 403 and "not open to other web pages" in answer.text


async def test_name_that_was_pointed_at_this_machine_is_refused(make: Make) -> None:
    server = make()
    name = f"evil.example:{server.get_port()}"
    assert await refused(server, name="evil.example", origin=f"http://{name}") == 403
    assert await refused(server, name="evil.example") == 403
    answer = get(server, Host=name)
    assert answer.status == 403 and f"http://127.0.0.1:{server.get_port()}" in answer.text


def test_page_can_not_be_framed_and_loads_nothing_from_elsewhere(make: Make) -> None:
    policy = get(make()).headers["Content-Security-Policy"]
    assert "frame-ancestors 'none'" in policy and "default-src 'none'" in policy
    assert not re.search(r"https?://|\*", policy)


def test_refused_request_gets_one_line_and_no_page(make: Make) -> None:
    answer = get(make(token=SECRET), "/index.html")
    assert answer.status == 401 and answer.text.count("\n") == 1 and len(answer.text) < 300
    assert answer.headers["Cache-Control"] == "no-store"


def test_parts_of_the_page_are_kept_by_browsers_and_the_page_is_not(make: Make) -> None:
    server = make()
    page = get(server)
    parts = re.findall(r'"(/[0-9a-f]+\.(?:css|js))"', page.text)
    assert page.headers["Cache-Control"] == "no-store" and len(set(parts)) == 2
    for part in parts:
        answer = get(server, part)
        assert answer.status == 200 and "immutable" in answer.headers["Cache-Control"]
        assert answer.headers["X-Content-Type-Options"] == "nosniff" and len(answer.text) > 50_000
    assert get(server, "/0.js").status == 404


def test_parts_of_the_page_need_the_token_too(make: Make) -> None:
    server = make("0.0.0.0", token=SECRET)
    for path in client_files():
        assert get(server, path).status == 401


async def test_beyond_this_machine_the_token_opens_the_page_and_nothing_else_does(make: Make) -> None:
    server = make("0.0.0.0", token=SECRET)
    assert get(server).status == get(server, "/?token=correct-horse-batterx").status == 401
    assert await refused(server) == 401
    assert await refused(server, path="/?token=nonsense") == 401
    welcome = get(server, f"/?token={SECRET}")
    assert welcome.status == 200 and SECRET not in welcome.text and len(welcome.text) < 500
    cookie = welcome.headers["Set-Cookie"].partition(";")[0]
    assert "<html" in get(server, Cookie=cookie).text
    async with open_page(server, cookie=cookie, origin=f"http://127.0.0.1:{server.get_port()}") as connection:
        assert isinstance(await connection.recv(), bytes)
    assert await refused(server, cookie=cookie, origin="http://evil.example") == 403


def test_token_may_come_from_the_environment(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(TOKEN_VARIABLE, SECRET)
    server = make()
    assert (get(server).status, get(server, f"/?token={SECRET}").status) == (401, 200)


def test_page_beyond_this_machine_without_a_token_is_not_made(make: Make) -> None:
    with pytest.raises(ConfigError, match=f"services.viewer.token: is needed for a page at .*{TOKEN_VARIABLE}"):
        make("0.0.0.0")


@pytest.mark.parametrize("token", ["short", "x" * 15, "spaces are not for cookies", "semi;colons;are;not;either"])
def test_token_that_can_not_be_used_is_refused_without_showing_it(make: Make, token: str) -> None:
    with pytest.raises(ConfigError, match=r"services\.viewer\.token: must have 16 or more") as error:
        make(token=token)
    assert token not in str(error.value)


def test_token_of_a_cell_is_not_among_the_parameters_that_anybody_may_read() -> None:
    cell = load_cell("panda", [f"services.viewer.token={SECRET}"])
    config = service_config(cell, "viewer", Config)
    assert config.token == SECRET
    assert SECRET not in repr(describe(config, "viewer")) and SECRET not in repr(config)


def test_wider_than_this_machine_is_warned_of_and_the_token_is_not_logged(
    make: Make, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.DEBUG):
        make(token=SECRET)
        assert "ssh" not in caplog.text
        get(make("0.0.0.0", token=SECRET), "/?token=wrong")
    assert "without encryption" in caplog.text and "ssh -L" in caplog.text
    assert SECRET not in caplog.text


def test_port_that_is_taken_is_refused_with_its_holder(make: Make) -> None:
    taken = make().get_port()
    with pytest.raises(ConfigError, match=f"services.viewer.port: {taken} is in use by process .*python"):
        make(port=taken)


def test_closed_server_leaves_its_port_to_the_next(make: Make) -> None:
    server = make()
    assert get(server).status == 200
    close_server(server)
    assert get(make(port=server.get_port())).status == 200


def test_making_and_closing_writes_nothing_on_stdout(make: Make, capfd: pytest.CaptureFixture[str]) -> None:
    close_server(make())
    assert capfd.readouterr() == ("", "")


async def test_pages_are_bounded_and_room_comes_back(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard, "MAX_PAGES", 2)
    server = make()
    async with open_page(server) as first:
        await first.recv()
        async with open_page(server) as second:
            await second.recv()
            assert await refused(server) == 503
        async with open_page(server) as third:
            await third.recv()


async def test_flood_of_connections_is_dropped_and_the_page_comes_back(
    make: Make, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(guard, "MAX_CONNECTIONS", 10)
    monkeypatch.setitem(guard.OPTIONS, "open_timeout", 600.0)  # so that only the bound ends them
    server = make()
    async with asyncio.timeout(PATIENCE):
        opened = [await asyncio.open_connection("127.0.0.1", server.get_port()) for _ in range(40)]
        ended = [asyncio.create_task(_end_of(reader)) for reader, _ in opened]
        while sum(task.done() for task in ended) < 30:
            await asyncio.wait([task for task in ended if not task.done()], return_when=asyncio.FIRST_COMPLETED)
        assert sum(task.done() for task in ended) == 30
        for _, writer in opened:
            writer.close()
        await asyncio.gather(*ended, *(writer.wait_closed() for _, writer in opened), return_exceptions=True)
        while await asyncio.to_thread(_dropped, server):  # until the server has seen them go
            pass
    assert not caplog.records


def _dropped(server: viser.ViserServer) -> bool:
    try:
        return get(server).status != 200
    except OSError:
        return True


async def _end_of(reader: asyncio.StreamReader) -> None:
    try:
        await reader.read()
    except OSError:
        return


def test_line_without_end_and_noise_do_not_stop_the_server(make: Make) -> None:
    server = make()
    for noise in (b"\0" * 100, b"GET /" + b"a" * 100_000, b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n", b""):
        with socket.create_connection(("127.0.0.1", server.get_port()), timeout=PATIENCE) as connection:
            try:
                connection.sendall(noise)
                connection.shutdown(socket.SHUT_WR)
                while connection.recv(65536):
                    pass
            except OSError:  # it may hang up first
                pass
    assert get(server).status == 200


async def test_nobody_can_have_the_page_tunnelled_to_a_public_server(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = make()
    asked: list[str] = []
    monkeypatch.setattr(server, "request_share_url", lambda: asked.append("share"))
    after = asyncio.Event()
    loop = asyncio.get_running_loop()

    def noted(*_: object) -> None:
        loop.call_soon_threadsafe(after.set)

    server._websock_server.register_handler(GuiUpdateMessage, noted)
    async with open_page(server) as connection, asyncio.timeout(PATIENCE):
        await connection.send(msgspec.msgpack.encode({"type": ShareUrlRequest.__name__}))
        await connection.send(msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": "none", "updates": {}}))
        await after.wait()
    server._thread_executor.shutdown()  # whatever was started is done
    assert asked == []


def test_viser_that_serves_in_another_way_is_not_left_unguarded(monkeypatch: pytest.MonkeyPatch) -> None:
    stopped: list[bool] = []

    class OtherServer:
        def __init__(self, **_: object) -> None:
            pass

        def stop(self) -> None:
            stopped.append(True)

    monkeypatch.setattr(viser, "ViserServer", OtherServer)
    with pytest.raises(RuntimeError, match="serves in another way"):
        make_server("127.0.0.1", 0)
    assert stopped == [True]


def test_page_of_a_secured_cell_needs_a_token_on_its_own_machine_too(make: Make) -> None:
    with pytest.raises(ConfigError, match=f"services.viewer.token: is needed in a secured cell.*{TOKEN_VARIABLE}"):
        make(secured=True)
    server = make(secured=True, tokens={"look": SECRET})
    assert (get(server).status, get(server, f"/?token={SECRET}").status) == (401, 200)


async def test_another_container_does_not_open_a_published_page_by_saying_that_it_is_near(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = make("0.0.0.0", published=True)
    # As from another container: what comes in has another address than the loopback's.
    monkeypatch.setattr(guard.Bounded, "remote_address", ("172.18.0.7", 5555))
    assert get(server).status == await refused(server) == 401


def test_published_page_needs_no_token_and_is_served_under_loopback_names_only(make: Make) -> None:
    server = make("0.0.0.0", published=True)
    assert get(server).status == get(server, Host="localhost:8080").status == 200
    assert get(server, Host="panda-viewer:8080").status == get(server, Host="172.17.0.2:8080").status == 403


@asynccontextmanager
async def operated(make: Make) -> AsyncIterator[tuple[viser.ViserServer, ActionQueue, dict[str, str], list[str]]]:
    """A page with a button to start, one to stop and an arrow to drag: ids of these by name, and what was done."""
    done: list[str] = []
    doors = Permissions(done.append)
    server = make(tokens={role: f"{role}-token-of-the-page" for role in ROLES}, doors=doors)
    desk = ActionQueue(doors)
    running = asyncio.create_task(desk.run())
    needs: dict[str, Need] = {"Start": "operate", "Stop": "stop", "Faster": "tune"}
    ids = {}
    for name, need in needs.items():
        button = server.gui.add_button(name)
        desk.on_click(button, partial(done.append, name), need)
        ids[name] = button._impl.uuid
    yield server, desk, ids, done
    running.cancel()


def cookie_of(server: viser.ViserServer, role: str) -> str:
    return f"zencell-{server.get_port()}={role}-token-of-the-page"


async def click(connection: ClientConnection, part: str) -> None:
    await connection.send(msgspec.msgpack.encode(CAMERA))  # before which viser lets nobody act
    update = {"type": "GuiUpdateMessage", "uuid": part, "updates": {"value": True}}
    await connection.send(msgspec.msgpack.encode(update))


async def drag(connection: ClientConnection) -> None:
    """Move something in the scene, without a word before."""
    where = {"name": "/goal", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.0, 0.0, 0.0)}
    await connection.send(msgspec.msgpack.encode({"type": "TransformControlsUpdateMessage", **where}))


async def test_token_says_what_a_raw_socket_may_do_and_stop_is_for_all(make: Make) -> None:
    async with operated(make) as (server, desk, ids, done):
        refused_: asyncio.Queue[str] = asyncio.Queue()
        desk.tell = lambda line, kind="bad": refused_.put_nowait(line)
        for role, may in (("look", ["Stop"]), ("operate", ["Start", "Stop"]), ("tune", ["Faster", "Stop"])):
            done.clear()
            async with open_page(server, cookie=cookie_of(server, role)) as connection, asyncio.timeout(PATIENCE):
                for name in ("Start", "Faster", "Stop"):
                    await click(connection, ids[name])
                while "Stop" not in done:  # noqa: ASYNC110
                    await asyncio.sleep(0.005)
                assert [each for each in done if each in ids] == may
                for _ in range(3 - len(may)):
                    assert f"({role}, 127.0.0.1) has no token to " in await refused_.get()


async def test_second_operator_waits_until_the_first_has_gone(make: Make) -> None:
    async with operated(make) as (server, desk, ids, done), asyncio.timeout(PATIENCE):
        cookie = cookie_of(server, "operate")
        async with open_page(server, cookie=cookie) as second:
            async with open_page(server, cookie=cookie) as first:
                await drag(first)
                while not desk.doors.operator:  # noqa: ASYNC110
                    await asyncio.sleep(0.005)
                holder = desk.doors.operator
                await click(second, ids["Start"])
                await click(second, ids["Stop"])
                while "Stop" not in done:  # noqa: ASYNC110
                    await asyncio.sleep(0.005)
                assert "Start" not in done and desk.doors.operator == holder
            while desk.doors.operator:  # noqa: ASYNC110
                await asyncio.sleep(0.005)
            await click(second, ids["Start"])
            while "Start" not in done:  # noqa: ASYNC110
                await asyncio.sleep(0.005)
            assert desk.doors.operator not in ("", holder)


async def test_who_may_only_look_leaves_places_for_who_may_operate(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guard, "MAX_LOOKING", 2)
    async with operated(make) as (server, _desk, _ids, _), asyncio.timeout(PATIENCE):
        look, operate = cookie_of(server, "look"), cookie_of(server, "operate")
        async with open_page(server, cookie=look), open_page(server, cookie=look) as second:
            assert await refused(server, cookie=look) == 503
            async with open_page(server, cookie=operate):
                await second.close()
            while (status := await opened_or_status(server, look)) == 503:  # noqa: ASYNC110
                await asyncio.sleep(0.005)
            assert status == 101, "the place is free again"


async def opened_or_status(server: viser.ViserServer, cookie: str) -> int:
    try:
        async with open_page(server, cookie=cookie):
            return 101
    except websockets.InvalidStatus as error:
        return error.response.status_code


async def test_who_floods_the_page_waits_and_stop_does_not(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard, "WORDS", 4)
    async with operated(make) as (server, desk, ids, done), asyncio.timeout(PATIENCE):
        refusals: list[str] = []
        desk.tell = lambda line, kind="bad": refusals.append(line)
        async with (
            open_page(server, cookie=cookie_of(server, "look")) as flood,
            open_page(server, cookie=cookie_of(server, "operate")) as page,
        ):
            for _ in range(40):
                await click(flood, ids["Start"])
            await click(page, ids["Stop"])
            while "Stop" not in done:  # noqa: ASYNC110
                await asyncio.sleep(0.005)
            assert len(refusals) < 40


async def test_what_somebody_asks_for_is_asked_in_their_name(make: Make) -> None:
    async with operated(make) as (server, desk, _ids, _), asyncio.timeout(PATIENCE):
        persons: asyncio.Queue[str] = asyncio.Queue()

        async def act() -> None:
            await asyncio.sleep(0)
            persons.put_nowait(desk.doors.person)

        button = server.gui.add_button("Later")
        desk.on_click(button, act, "stop")
        async with open_page(server, cookie=cookie_of(server, "look")) as connection:
            await click(connection, button._impl.uuid)
            assert await persons.get() == "page 127.0.0.1"
        desk.put(act)
        assert await persons.get() == desk.doors.person == "page"
