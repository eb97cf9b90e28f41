"""A real page server: admission of requests, limits, and permissions of raw WebSockets."""

import asyncio
import http.client
import logging
import re
import socket
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from email.message import Message
from functools import partial
from typing import Any
from unittest.mock import Mock

import msgspec
import pytest
import viser
import websockets
from viser._messages import CommandTriggerMessage, ShareUrlRequest
from websockets.asyncio.client import ClientConnection
from websockets.asyncio.client import connect as connect_socket

from common.config import load_cell, service_config
from common.config.tunables import describe
from common.errors import ConfigError
from page import server as page_server
from page.access import Permission, Permissions, cookie_value
from page.console import ActionQueue
from page.server import close_server, make_server
from page.viser_client import client_files
from page.viser_inside import element_id
from security.page_tokens import ROLES, TOKEN_VARIABLE
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

    def make_one(host: str = "127.0.0.1", port: int = 0, token: str = "", **options: Any) -> viser.ViserServer:
        made.append(make_server(host, port, token, **options))
        return made[-1]

    yield make_one
    for server in made:
        close_server(server)


@dataclass(frozen=True)
class Answer:
    status: int
    text: str
    headers: Message


def get(server: viser.ViserServer, path: str = "/", **headers: str) -> Answer:
    """Return the answer to a plain request."""
    with closing(http.client.HTTPConnection("127.0.0.1", server.get_port(), timeout=PATIENCE)) as connection:
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return Answer(answer.status, answer.read().decode(), answer.headers)


def open_page(
    server: viser.ViserServer, name: str = "127.0.0.1", origin: str = "", path: str = "/", cookie: str = "",
) -> connect_socket:
    """The WebSocket of a page in a browser that resolves `name` to this server."""
    port = server.get_port()
    return connect_socket(
        f"ws://{name}:{port}{path}", host="127.0.0.1", port=port, proxy=None, max_size=None, open_timeout=PATIENCE,
        origin=websockets.Origin(origin) if origin else None, additional_headers={"Cookie": cookie} if cookie else None,
        subprotocols=[websockets.Subprotocol(f"viser-v{viser.__version__}")],
    )


async def status_of(*arguments: Any, **options: Any) -> int:
    """Return the status of opening the WebSocket of a page, 101 if it opens."""
    try:
        async with open_page(*arguments, **options):
            return 101
    except websockets.InvalidStatus as error:
        return error.response.status_code


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(PATIENCE):
        while not condition():  # noqa: ASYNC110
            await asyncio.sleep(0.005)


async def test_page_is_served_to_this_machine_but_not_to_foreign_hosts_and_origins(make: Make) -> None:
    server = make()
    own, foreign = f"http://127.0.0.1:{server.get_port()}", f"evil.example:{server.get_port()}"
    assert "<html" in get(server).text
    async with open_page(server, origin=own) as connection:
        assert isinstance(await connection.recv(), bytes)
    for origin in ("http://evil.example", own.replace("127.0.0.1", "localhost"), "null"):
        assert await status_of(server, origin=origin) == 403
    assert await status_of(server, name="evil.example") == 403
    answers = get(server, Origin="http://evil.example"), get(server, Host=foreign)
    assert [answer.status for answer in answers] == [403, 403]
    assert "other web pages must not access this page" in answers[0].text and own in answers[1].text


async def test_remote_page_opens_with_its_token_only(make: Make) -> None:
    server = make("0.0.0.0", token=SECRET)
    rejected = get(server, "/index.html")
    assert rejected.status == 401 and rejected.text.count("\n") == 1 and len(rejected.text) < 300
    assert rejected.headers["Cache-Control"] == "no-store"
    assert await status_of(server) == await status_of(server, path="/?token=nonsense") == 401
    assert {get(server, path).status for path in (*client_files(), "/?token=correct-horse-batterx")} == {401}
    welcome = get(server, f"/?token={SECRET}")
    assert welcome.status == 200 and SECRET not in welcome.text and len(welcome.text) < 500
    cookie = welcome.headers["Set-Cookie"].partition(";")[0]
    assert "<html" in get(server, Cookie=cookie).text
    assert await status_of(server, cookie=cookie, origin=f"http://127.0.0.1:{server.get_port()}") == 101
    assert await status_of(server, cookie=cookie, origin="http://evil.example") == 403


def test_cookie_neither_reveals_the_token_nor_opens_the_page_at_another_port(make: Make) -> None:
    first, second = make(token=SECRET, secured=True), make(token=SECRET, secured=True)
    name, _, rest = get(first, f"/?token={SECRET}").headers["Set-Cookie"].partition("=")
    value, *attributes = rest.split("; ")
    assert name == f"zencell-{first.get_port()}" and SECRET not in rest
    assert attributes == ["Path=/", "HttpOnly", "SameSite=Strict"]
    assert get(first, Cookie=f"{name}={value}").status == 200
    for page, cookie in ((first, f"{name}={SECRET}"), (second, f"{name}={value}"),
                         (second, f"zencell-{second.get_port()}={value}")):
        assert get(page, Cookie=cookie).status == 401
    assert get(first, f"/?token={value}").status == 401


def test_remote_and_secured_pages_need_a_token_of_configuration_or_environment(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ConfigError, match=f"services.viewer.token: is needed for a page at .*{TOKEN_VARIABLE}"):
        make("0.0.0.0")
    with pytest.raises(ConfigError, match=f"services.viewer.token: is needed in a secured cell.*{TOKEN_VARIABLE}"):
        make(secured=True)
    secured = make(secured=True, tokens={"look": SECRET})
    monkeypatch.setenv(TOKEN_VARIABLE, SECRET)
    for server in (secured, make()):
        assert (get(server).status, get(server, f"/?token={SECRET}").status) == (401, 200)


@pytest.mark.parametrize("token", ["short", "x" * 15, "spaces are not for cookies", "semi;colons;are;not;either"])
def test_invalid_token_is_rejected_without_showing_it(make: Make, token: str) -> None:
    with pytest.raises(ConfigError, match=r"services\.viewer\.token: must have 16 or more") as error:
        make(token=token)
    assert token not in str(error.value)


def test_token_is_no_public_parameter_and_is_not_logged(make: Make, caplog: pytest.LogCaptureFixture) -> None:
    config = service_config(load_cell("panda", [f"services.viewer.token={SECRET}"]), "viewer", Config)
    assert config.token == SECRET
    assert SECRET not in repr(describe(config, "viewer")) and SECRET not in repr(config)
    with caplog.at_level(logging.DEBUG):
        make(token=SECRET)
        assert "ssh" not in caplog.text
        get(make("0.0.0.0", token=SECRET), "/?token=wrong")
    assert "without encryption" in caplog.text and "ssh -L" in caplog.text, "a remote page causes a warning"
    assert SECRET not in caplog.text


async def test_published_page_needs_a_token_for_other_containers_only(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = make("0.0.0.0", published=True)
    assert get(server).status == get(server, Host="localhost:8080").status == 200
    assert get(server, Host="panda-viewer:8080").status == get(server, Host="172.17.0.2:8080").status == 403
    monkeypatch.setattr(page_server.BoundedConnection, "remote_address", ("172.18.0.7", 5555))
    assert get(server).status == await status_of(server) == 401


def test_page_loads_nothing_from_other_hosts_and_browsers_cache_its_files_but_not_the_page(make: Make) -> None:
    server = make()
    page = get(server)
    policy = page.headers["Content-Security-Policy"]
    assert "frame-ancestors 'none'" in policy and "default-src 'none'" in policy
    assert not re.search(r"https?://|\*", policy)
    files = re.findall(r'"(/[0-9a-f]+\.(?:css|js))"', page.text)
    assert page.headers["Cache-Control"] == "no-store" and len(set(files)) == 2
    for file in files:
        answer = get(server, file)
        assert answer.status == 200 and "immutable" in answer.headers["Cache-Control"]
        assert answer.headers["X-Content-Type-Options"] == "nosniff" and len(answer.text) > 50_000
    assert get(server, "/0.js").status == 404


def test_port_in_use_is_rejected_with_its_process_and_free_after_closing(
    make: Make, capfd: pytest.CaptureFixture[str]
) -> None:
    server = make()
    with pytest.raises(ConfigError, match=f"services.viewer.port: {server.get_port()} is in use by process .*python"):
        make(port=server.get_port())
    close_server(server)
    assert get(make(port=server.get_port())).status == 200
    assert capfd.readouterr() == ("", ""), "viser prints nothing"


def test_viser_that_starts_in_an_unknown_way_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    unknown = Mock()
    monkeypatch.setattr(viser, "ViserServer", lambda **_: unknown)
    with pytest.raises(RuntimeError, match="starts its server in an unknown way"):
        make_server("127.0.0.1", 0)
    unknown.stop.assert_called_once_with()


async def test_share_url_cannot_be_requested(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    server = make()
    requests: list[str] = []
    monkeypatch.setattr(server, "request_share_url", lambda: requests.append("share"))
    processed, loop = asyncio.Event(), asyncio.get_running_loop()
    server._websock_server.register_handler(
        CommandTriggerMessage, lambda *_: loop.call_soon_threadsafe(processed.set))
    async with open_page(server) as connection, asyncio.timeout(PATIENCE):
        await connection.send(msgspec.msgpack.encode({"type": ShareUrlRequest.__name__}))
        await connection.send(msgspec.msgpack.encode({"type": "CommandTriggerMessage", "uuid": "none"}))
        await processed.wait()
    server._thread_executor.shutdown()
    assert requests == []


# --- limits ---


async def test_number_of_open_pages_is_limited(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_server, "MAX_PAGES", 2)
    server = make()
    async with open_page(server) as first, open_page(server) as second:
        await asyncio.gather(first.recv(), second.recv())
        assert await status_of(server) == 503
        await second.close()
        async with open_page(server) as third:
            await third.recv()


@pytest.mark.parametrize("sent", [
    "", "GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nX", "GET / HTTP/1.1\r\nHost: evil\r\n\r\n"])
async def test_connections_without_a_token_keep_no_operator_out(
    sent: str, make: Make, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(page_server, "MAX_WAITING", 10)
    monkeypatch.setitem(page_server.WEBSOCKET_OPTIONS, "open_timeout", 600.0)  # only the limit ends them
    server = make(token=SECRET)
    port = server.get_port()
    cookie = f"zencell-{port}={cookie_value(SECRET, port)}"
    async with open_page(server, cookie=cookie) as before:
        await before.recv()
        opened = [await asyncio.open_connection("127.0.0.1", port) for _ in range(40)]
        for _, writer in opened:
            writer.write(sent.format(port=port).encode())
        assert (await asyncio.to_thread(get, server, Cookie=cookie)).status == 200
        async with open_page(server, cookie=cookie) as page:
            await page.recv()
        for reader, writer in opened[:29]:  # the oldest ones
            with suppress(OSError):
                await asyncio.wait_for(reader.read(), PATIENCE)
            writer.close()
        assert before.state is websockets.State.OPEN
    for _, writer in opened[29:]:
        writer.close()
    assert not caplog.records


def test_noise_does_not_stop_the_server(make: Make) -> None:
    server = make()
    for noise in (b"\0" * 100, b"GET /" + b"a" * 100_000, b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n", b""):
        with (socket.create_connection(("127.0.0.1", server.get_port()), timeout=PATIENCE) as connection,
              suppress(OSError)):  # the server may close first
            connection.sendall(noise)
            connection.shutdown(socket.SHUT_WR)
            while connection.recv(65536):
                pass
    assert get(server).status == 200


# --- permissions ---


@dataclass
class Operated:
    """A page with buttons of different permissions; `done` are the clicked buttons and the lines of the log."""

    server: viser.ViserServer
    actions: ActionQueue
    ids: dict[str, str]
    done: list[str]

    def cookie(self, role: str) -> str:
        port = self.server.get_port()
        return f"zencell-{port}={cookie_value(f'{role}-token-of-the-page', port)}"

    def open(self, role: str) -> connect_socket:
        return open_page(self.server, cookie=self.cookie(role))

    async def click(self, connection: ClientConnection, name: str) -> None:
        await connection.send(msgspec.msgpack.encode(CAMERA))  # viser ignores clients without a camera
        update = {"type": "GuiUpdateMessage", "uuid": self.ids[name], "updates": {"value": True}}
        await connection.send(msgspec.msgpack.encode(update))


@pytest.fixture
async def page(make: Make) -> AsyncIterator[Operated]:
    done: list[str] = []
    permissions = Permissions(done.append)
    server = make(tokens={role: f"{role}-token-of-the-page" for role in ROLES}, permissions=permissions)
    actions = ActionQueue(permissions)
    running = asyncio.create_task(actions.run())
    required: dict[str, Permission] = {"Start": "operate", "Stop": "stop", "Faster": "tune"}
    ids = {}
    for name, permission in required.items():
        button = server.gui.add_button(name)
        actions.on_click(button, partial(done.append, name), permission)
        ids[name] = element_id(button)
    yield Operated(server, actions, ids, done)
    running.cancel()


async def test_role_limits_a_raw_socket_and_every_role_may_stop(page: Operated) -> None:
    denied: asyncio.Queue[str] = asyncio.Queue()
    page.actions.notify = lambda line, kind="bad": denied.put_nowait(line)
    for role, allowed in (("look", ["Stop"]), ("operate", ["Start", "Stop"]), ("tune", ["Faster", "Stop"])):
        page.done.clear()
        async with page.open(role) as connection, asyncio.timeout(PATIENCE):
            for name in ("Start", "Faster", "Stop"):
                await page.click(connection, name)
            await until(lambda: "Stop" in page.done)
            assert [each for each in page.done if each in page.ids] == allowed
            for _ in range(3 - len(allowed)):
                assert f"({role}, 127.0.0.1) has no token for the role " in await denied.get()


async def test_view_only_pages_leave_room_for_operators(page: Operated, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_server, "MAX_VIEWERS", 2)
    look = page.cookie("look")
    async with page.open("look"), page.open("look") as second, asyncio.timeout(PATIENCE):
        assert await status_of(page.server, cookie=look) == 503
        async with page.open("operate"):
            await second.close()
        while (status := await status_of(page.server, cookie=look)) == 503:  # noqa: ASYNC110
            await asyncio.sleep(0.005)
        assert status == 101


async def test_flood_of_messages_is_slowed_and_stop_of_another_page_is_not(page: Operated) -> None:
    denied: list[str] = []
    page.actions.notify = lambda line, kind="bad": denied.append(line)
    began = time.monotonic()
    async with page.open("look") as flood, page.open("operate") as operator:
        for _ in range(4 * page_server.MAX_MESSAGE_RATE):
            await page.click(flood, "Start")
        await page.click(operator, "Stop")
        await until(lambda: "Stop" in page.done)
        read = len(denied)
        assert read <= page_server.MAX_MESSAGE_RATE * (1 + time.monotonic() - began)
        flood.transport.abort()  # the server would read the rest of the flood before it closes


async def test_requests_carry_the_name_of_their_client(page: Operated) -> None:
    names: asyncio.Queue[str] = asyncio.Queue()
    permissions = page.actions.permissions

    async def act() -> None:
        await asyncio.sleep(0)
        names.put_nowait(permissions.client_name)

    button = page.server.gui.add_button("Later")
    page.actions.on_click(button, act, "stop")
    page.ids["Later"] = element_id(button)
    async with page.open("look") as connection, asyncio.timeout(PATIENCE):
        await page.click(connection, "Later")
        assert await names.get() == "page 127.0.0.1"
        page.actions.put(act)
        assert await names.get() == permissions.client_name == "page"
