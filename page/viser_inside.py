"""Everything of the page that reaches inside viser, and what viser would have to offer in its place.

Five things have no public call in viser 1.1; whoever updates viser reads this file, and nothing else of the page.

- **Who may open the page, and at which socket.** viser has no authentication, takes a WebSocket from any web page, and
  tries the next port when one is taken. Its server is one call of `websockets`' `serve`, which can ask a function about
  each request before anything else reads it: `made_server` puts ours in front of viser's while the server is made.
  Upstream request: `ViserServer(..., sock=, process_request=, websocket_options=)`, handed on to `serve`.
- **No tunnel to a public server.** Whoever has the page open may ask for a share URL. The handlers are taken away.
  Upstream request: `ViserServer(..., allow_share_url=False)`.
- **A client that starts soon.** viser's client is one packed file that a browser unpacks and compiles at each opening,
  before anything else. Sent as a script, a style sheet and the decoder of messages, each under a name that has its
  contents in it, it compiles while it loads, and a browser keeps what it has compiled for the next opening.
  Upstream requests: a client build in separate files; `configure_environment_map(hdri=None)` and the antialiasing of
  edges as options that are known before the client begins.
- **A bar above everything, and buttons that are held down.** viser's panels can be collapsed, scrolled and covered by
  dialogs; its buttons tell a click, or at a rate that they are held, over the connection in which pictures wait too.
  overlay.js and overlay.css put a bar above the element that viser fills, which they make smaller, and speak over a
  WebSocket of their own at `LINE` (line.py), which `made_server` hands to us. `introduce` tells the script which of
  viser's connections is of the same page.
  Upstream requests: a panel that is always in view; a WebSocket path for the application; a button event for release.
- **Messages from any thread.** viser wakes its loop by an `asyncio.Event` that it sets from the thread that asks, which
  may fail or wake nobody; it sets it a second time on its loop, which is enough (`_Event`).
  Upstream request: leave the first one out.

The style sheets in markup.py and overlay.css name a class and a width of the client's; without them the page only looks
different. Upstream requests: a checkbox whose label stands behind it; a panel as wide as a phone.
"""

from __future__ import annotations

import asyncio
import gzip
import hashlib
import json
import re
import threading
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import numpy as np
import viser
import websockets.asyncio.server as websocket_server
import zstandard
from rich import get_console
from viser._messages import (
    GetRenderResponseMessage,
    GuiUpdateMessage,
    RunJavascriptMessage,
    ShareUrlDisconnect,
    ShareUrlRequest,
    ViewerCameraMessage,
)
from viser.infra._async_message_buffer import AsyncMessageBuffer
from websockets.http11 import Request, Response

if TYPE_CHECKING:
    import socket

LINE = "/line"  # the path of our own WebSocket
Beside = Callable[[websocket_server.ServerConnection], Awaitable[None]]
Process = Callable[[websocket_server.ServerConnection, Request], "Awaitable[Response | None] | Response | None"]

_replacing = threading.Lock()

# --- messages from any thread ---


class _Event(asyncio.Event):
    """An event that any thread may set: those who wait for it are woken where they wait, when it is set there."""

    def set(self) -> None:
        here, self._value = asyncio._get_running_loop(), False  # it may have been set elsewhere, which woke nobody
        if here is not None and here is self._loop:  # type: ignore[attr-defined]
            super().set()
        else:
            self._value = True


_begin = AsyncMessageBuffer.__init__


def _begin_safely(buffer: AsyncMessageBuffer, *args: Any, **more: Any) -> None:
    _begin(buffer, *args, **more)
    buffer.message_event = _Event()


AsyncMessageBuffer.__init__ = _begin_safely  # type: ignore[method-assign, assignment]

# --- the server ---


def made_server(
    listening: socket.socket, before: Callable[[Process], Process], options: Mapping[str, Any], beside: Beside,
) -> viser.ViserServer:
    """A viser server that listens at a socket, and nowhere else.

    Args:
        listening: the socket; closed if that fails.
        before: makes of the function that viser asks about each request the one that is asked instead.
        options: of the WebSocket server, in place of viser's.
        beside: has the WebSocket connections at `LINE`, on the server's own loop; ends with them.

    Raises:
        RuntimeError: viser serves in another way than this file knows.
    """
    in_place = []

    def serve(handler: Any, host: Any, port: Any, *, process_request: Process | None = None, **theirs: Any) -> Any:
        del host, port  # viser would try the next port, and the next, when one is taken

        async def either(connection: websocket_server.ServerConnection) -> None:
            at = urlsplit(connection.request.path).path if connection.request is not None else ""
            await (beside if at == LINE else handler)(connection)

        if process_request is not None:
            in_place.append(process_request)
            theirs["process_request"] = before(process_request)
        return original(either, **theirs | {**options, "sock": listening})

    try:
        with _replacing, quiet():
            original = websocket_server.serve
            websocket_server.serve = serve  # type: ignore[assignment,misc]
            try:
                server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
            finally:
                websocket_server.serve = original  # type: ignore[misc]
    except BaseException:
        listening.close()
        raise
    if not in_place:
        server.stop()
        listening.close()
        raise RuntimeError(f"viser {viser.__version__} serves in another way than the guard of its page knows")
    for message in (ShareUrlRequest, ShareUrlDisconnect):
        server._websock_server.unregister_handler(message)
    return server


# From a browser: what nobody else sees. All else changes something for everybody.
_OWN = (ViewerCameraMessage, GetRenderResponseMessage)


def let_in(server: viser.ViserServer, may: Callable[[str, object], bool]) -> None:
    """Have each message of a browser that changes something for others dropped, unless it may be.

    Args:
        server: of the page.
        may: is asked with the id of the part of the page (empty: the scene) and the value that it is given, on the
            server's own loop and in the context of the connection.
    """
    inside = server._websock_server
    handle = inside._handle_incoming_message

    def show_again(client_id: Any, part: str) -> None:
        """What a field really says, for the browser that shows something else now."""
        field, client = server.gui._gui_input_handle_from_uuid.get(part), server.get_clients().get(client_id)
        if field is not None and client is not None and not isinstance(field, viser.GuiButtonHandle):
            client._websock_connection.queue_message(GuiUpdateMessage(part, {"value": field.value}))

    async def handle_what_may_be(client_id: Any, message: Any) -> None:
        if not isinstance(message, _OWN):
            if isinstance(message, GuiUpdateMessage) and set(message.updates) != {"value"}:
                return  # a browser gives values; viser would set any attribute of ours
            value = message.updates.get("value") if isinstance(message, GuiUpdateMessage) else None
            if not may(getattr(message, "uuid", ""), value):
                show_again(client_id, getattr(message, "uuid", ""))
                return
        await handle(client_id, message)

    inside._handle_incoming_message = handle_what_may_be  # type: ignore[method-assign]


def introduce(client: viser.ClientHandle, key: str) -> None:
    """Tell the script in a browser by which key its page is known."""
    client._websock_connection.queue_message(RunJavascriptMessage(f"window.zencellPage?.({json.dumps(key)})"))


@contextmanager
def quiet() -> Iterator[None]:
    """A block in which viser writes no frames around its address on stdout."""
    console = get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


# --- the client ---

PACKED = re.compile(r'<script data-p="([^"]*)" data-ss="(\d+)" data-cs="(\d+)">(.*?)</script>', re.DOTALL)
DECODER = re.compile(r'const gzWasm=("[^"]*")')
# Its alphabet: printable characters that need no escaping in an attribute. Five of them are four bytes.
ALPHABET = "".join(chr(code) for code in range(0x21, 0x7F) if chr(code) not in "\"&<>'`")
HTML = "text/html; charset=utf-8"

# Runs before the client. It begins with an environment map of its own and decodes it, before the first message says
# that the scene has none; and it smooths edges by drawing them four times over, which without a graphics card takes a
# quarter of the time of each picture.
PRELUDE = """<script>
(() => {
  const load = window.fetch, context = HTMLCanvasElement.prototype.getContext;
  window.fetch = (what, ...more) => String(what?.url ?? what).startsWith("data:image/jpeg")
    ? new Promise(() => {}) : load(what, ...more);
  let software;
  const drawnByProcessor = () => {
    const gl = context.call(document.createElement("canvas"), "webgl2");
    const info = gl?.getExtension("WEBGL_debug_renderer_info");
    const name = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
    gl?.getExtension("WEBGL_lose_context")?.loseContext();
    return /swiftshader|llvmpipe|softpipe|software/i.test(name);
  };
  HTMLCanvasElement.prototype.getContext = function (kind, options) {
    if (kind === "webgl2" && options?.antialias && (software ??= drawnByProcessor()))
      options = {...options, antialias: false};
    return context.call(this, kind, options);
  };
})();
</script>"""
START = """<link rel="stylesheet" href="{style}"><link rel="modulepreload" href="{script}">
<script type="module">
globalThis.__viserZstdWasm = await WebAssembly.compileStreaming(fetch("{decoder}"));
await import("{script}");
</script>"""


@dataclass(frozen=True)
class File:
    """What is sent for a path.

    Attributes:
        kind: its media type.
        body: as it is sent, compressed by gzip.
        lasts: the path tells its contents, so that a browser may keep it.
    """

    kind: str
    body: bytes
    lasts: bool


@cache
def client_files() -> Mapping[str, File]:
    """The files of the installed viser's client by path; takes a third of a second, once."""
    page = Path(viser.__file__).parent / "client" / "build" / "index.html"
    return files_of(page.read_text(encoding="utf-8"), overlay())


def overlay() -> str:
    """The bar above the page, as HTML for its head."""
    style, script = (Path(__file__).with_name(f"overlay.{end}").read_text(encoding="utf-8") for end in ("css", "js"))
    return f"<style>{style}</style><script>{script}</script>"


def files_of(page: str, more: str = "") -> Mapping[str, File]:
    """The files that a packed page becomes; of one that is packed in another way, itself with the prelude and more."""
    packed = PACKED.search(page)
    decoder = DECODER.search(packed[4]) if packed else None
    files: dict[str, File] = {}
    start = ""
    if packed is not None and decoder is not None:
        style_size, script_size = int(packed[2]), int(packed[3])
        both = zstandard.decompress(decoded(packed[1]), max_output_size=style_size + script_size)
        names = {}
        for name, ending, kind, contents in (
            ("style", "css", "text/css; charset=utf-8", both[:style_size]),
            ("script", "js", "text/javascript; charset=utf-8", both[style_size:]),
            ("decoder", "wasm", "application/wasm", gzip.decompress(decoded(json.loads(decoder[1])))),
        ):
            names[name] = f"/{hashlib.sha256(contents).hexdigest()[:20]}.{ending}"
            files[names[name]] = _file(kind, contents, lasts=True)
        start = START.format(**names)
        page = page.replace(packed[0], "")
    page = page.replace("<head>", f"<head>{PRELUDE}{more}", 1).replace("</head>", f"{start}</head>", 1)
    files["/"] = files["/index.html"] = _file(HTML, page.encode(), lasts=False)
    return files


def decoded(text: str) -> bytes:
    """The bytes that were written in `ALPHABET`: each five characters are four bytes, the last k characters k - 1."""
    digits = np.zeros(128, np.int64)
    digits[[ord(c) for c in ALPHABET]] = np.arange(len(ALPHABET))
    missing = -len(text) % 5
    values = digits[np.frombuffer(text.encode("ascii"), np.uint8)]
    whole = len(text) // 5
    weights = len(ALPHABET) ** np.arange(4, -1, -1)
    found = (values[: 5 * whole].reshape(-1, 5) @ weights).astype(">u4").tobytes()
    if missing:
        rest = 0
        for digit in values[5 * whole :]:
            rest = len(ALPHABET) * rest + int(digit)
        found += rest.to_bytes(4 - missing, "big")
    return found


def _file(kind: str, contents: bytes, *, lasts: bool) -> File:
    return File(kind, gzip.compress(contents, 6), lasts)
