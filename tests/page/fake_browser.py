"""A fake browser: speaks viser's protocol, stores the displayed elements, and clicks."""

import asyncio
import html
import json
import re
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import msgspec
import viser
import zstandard
from websockets import Subprotocol
from websockets.asyncio.client import ClientConnection, connect

from page.access import cookie_value

PATIENCE = 20.0  # [s]
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1.0, 0.0, 0.0, 0.0], "position": [1.0, 2.0, 3.0], "fov": 1.0, "near": 0.1,
    "far": 100.0, "image_height": 600, "image_width": 800, "look_at": [0.0, 0.0, 0.5], "up_direction": [0.0, 0.0, 1.0],
}


class FakeBrowser:
    """A page: `parts` are the fields and texts of its panels by uuid, `kinds` the types of viser's messages in order.

    `status` and `results` come over the control socket.
    """

    def __init__(self, connection: ClientConnection, control: ClientConnection) -> None:
        self._connection, self._control = connection, control
        self._known, self._changed = asyncio.Event(), asyncio.Event()  # known: the key of this page was sent
        self.status: dict[str, Any] = {}
        self.results: list[tuple[int, str, str]] = []
        self.parts: dict[str, dict[str, Any]] = {}
        self.values: dict[str, Any] = {}
        self.kinds: list[str] = []

    @property
    def text(self) -> str:
        """The HTML of all panels, and the texts of the status bar."""
        bar = [self.status["situation"]["text"], self.status["situation"]["hint"], self.status["note"]["text"],
               *(text for text, _ in self.status["summary"])] if self.status else []
        return "\n".join([*(str(part.get("content", "")) for part in self.parts.values()), *bar])

    def label(self, label: str) -> str:
        """Return the uuid of the only field with this label."""
        found = [uuid for uuid, part in self.parts.items()
                 if label == part.get("label") or label in (part.get("options") or ())]
        if len(found) != 1:
            raise LookupError(f"{label!r}: {len(found)} fields have this label")
        return found[0]

    async def listen(self) -> None:
        """Receive viser's messages."""
        async for data in self._connection:
            assert isinstance(data, bytes)
            size = int.from_bytes(data[8:16], "little")
            batch = msgspec.msgpack.decode(zstandard.decompress(data[16 : 16 + size]))
            for message in batch["messages"]:
                self._take(message)
            self._changed.set()

    async def listen_to_control(self) -> None:
        """Receive messages of the control socket."""
        async for data in self._control:
            message = json.loads(data)
            self.status = message.get("status", self.status)
            if "result" in message:
                self.results.append((message["n"], message["result"], message["kind"]))
            self._changed.set()

    async def send(self, **message: Any) -> None:
        """Send a message over the control socket, as overlay.js does."""
        await asyncio.wait_for(self._known.wait(), PATIENCE)
        await self._control.send(json.dumps(message))

    async def hold(self, what: str, press: int = 1) -> None:
        """Send one message of a button that this press holds down."""
        await self.until(lambda: self.status)
        await self.send(do="hold", what=what, n=press, at=1e3 * time.monotonic(), seen=self.status["time"])

    def button(self, label: str) -> tuple[str, str]:
        """Return the name of the button with this label, and why it is disabled."""
        found = re.findall(rf'<button [^>]*data-(?:press|hold)="([^"]+)"([^>]*)>{re.escape(label)}</button>', self.text)
        if len(found) != 1:
            raise LookupError(f"{label!r}: {len(found)} buttons have this label")
        why = re.search(r'title="([^"]*)"', found[0][1])
        return found[0][0], html.unescape(why[1]) if why else ""

    def _take(self, message: dict[str, Any]) -> None:
        uuid = str(message.get("uuid"))
        self.kinds.append(message["type"])
        if message["type"] == "RunJavascriptMessage" and "zencellPage" in message["source"]:
            key = message["source"].partition("(")[2].strip("()")
            asyncio.get_running_loop().create_task(self._introduce(json.loads(key)))
        if "props" in message and str(message["type"]).startswith("Gui"):
            self.parts[uuid] = message["props"]
            self.values[uuid] = message.get("value")
        elif message["type"] == "GuiUpdateMessage" and uuid in self.parts:
            self.parts[uuid].update(message["updates"])
            self.values[uuid] = message["updates"].get("value", self.values[uuid])
        elif message["type"] == "GuiRemoveMessage":
            self.parts.pop(uuid, None)

    async def until(self, condition: Callable[[], object]) -> None:
        """Wait for a condition on what is shown."""
        async with asyncio.timeout(PATIENCE):
            while True:
                self._changed.clear()
                try:
                    if condition():
                        return
                except LookupError:
                    pass
                await self._changed.wait()

    async def set(self, label: str, value: Any) -> None:
        """Set a field, or click a button of viser."""
        await self.until(lambda: self.label(label))
        uuid = self.label(label)
        await self.send_viser({"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}})

    async def _introduce(self, key: str) -> None:
        await self._control.send(json.dumps({"do": "page", "what": key}))
        self._known.set()

    async def press(self, label: str) -> None:
        """Click a button of `markup` as soon as it is enabled."""
        await self.until(lambda: not self.button(label)[1])
        await self.send(do="press", what=self.button(label)[0])

    async def click(self, label: str) -> None:
        """Click a button of viser, also one of a group."""
        await self.until(lambda: self.label(label))
        group_labels = "options" in self.parts[self.label(label)]
        await self.set(label, label if group_labels else True)

    async def send_viser(self, message: dict[str, Any]) -> None:
        """Send a message to viser, and wait until it arrived: the next press uses the other connection."""
        await self._connection.send(msgspec.msgpack.encode(message))
        await asyncio.wait_for(await self._connection.ping(), PATIENCE)


@asynccontextmanager
async def opened(port: int, token: str = "") -> AsyncIterator[FakeBrowser]:
    """A page that is open inside the block."""
    cookie = {"Cookie": f"zencell-{port}={cookie_value(token, port)}"} if token else None
    async with (
        connect(f"ws://127.0.0.1:{port}/", proxy=None, max_size=None, open_timeout=PATIENCE,
                subprotocols=[Subprotocol(f"viser-v{viser.__version__}")], additional_headers=cookie) as connection,
        connect(f"ws://127.0.0.1:{port}/control", proxy=None, open_timeout=PATIENCE,
                additional_headers=cookie) as control,
    ):
        browser = FakeBrowser(connection, control)
        listening = {asyncio.create_task(browser.listen()), asyncio.create_task(browser.listen_to_control())}
        await browser.send_viser(CAMERA)
        try:
            yield browser
        finally:
            for task in listening:
                task.cancel()
            await asyncio.wait(listening)
