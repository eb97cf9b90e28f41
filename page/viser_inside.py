"""All code that depends on the internals of viser's server, with the API that viser would have to offer instead.

When viser is updated, only this file and viser_client.py need checking.

- **Access checks and the listening socket.** viser has no authentication, accepts a WebSocket from any web page, and
  tries the next port if one is in use. It makes one call of `websockets.serve`; `create_server` replaces that function
  during the call. Upstream request: `ViserServer(..., sock=, process_request=, websocket_options=)`.
- **No tunnel to a public server.** Any page may request a share URL; `create_server` removes these handlers.
  Upstream request: `ViserServer(..., allow_share_url=False)`.
- **Messages of a browser.** viser stores and broadcasts any value of any size, and keeps uploads for fields without
  one. `_ACCEPTED` names the messages that the page uses, `_is_bounded` checks their values, and `filter_messages` drops
  what the page may not do. Upstream request: a hook that accepts or rejects a client's message.
- **Values that cannot be sent.** A value that msgpack rejects ends the connection of every page. All values pass
  `_prepare`. Upstream request: check values when they are assigned.
- **A bar above everything, and buttons that are held down.** viser's panels can be collapsed, scrolled and covered, and
  its button events share a connection with images. overlay.js and overlay.css add a bar above the client, and use the
  WebSocket at `CONTROL_PATH` (control_socket.py). `send_key` links the script to the viser connection of
  its page. Upstream requests: a panel that is always visible; an application's WebSocket path; a button release event.
- **Messages from any thread.** viser sets an `asyncio.Event` from foreign threads, which may fail or wake no task. It
  sets it again on its loop, which is sufficient (`_ThreadSafeEvent`). Upstream request: remove the first call.

markup.py and overlay.css select a class and a width of the client; without a match the page only looks different.
Upstream requests: a checkbox with its label behind it; a panel as wide as a phone.
"""

from __future__ import annotations

import asyncio
import json
import math
import threading
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import viser
import websockets.asyncio.server as websocket_server
from rich import get_console
from viser._messages import (
    CommandTriggerMessage,
    GuiUpdateMessage,
    RunJavascriptMessage,
    SceneNodeClickMessage,
    SceneNodeDragMessage,
    ShareUrlDisconnect,
    ShareUrlRequest,
    TransformControlsDragEndMessage,
    TransformControlsDragStartMessage,
    TransformControlsUpdateMessage,
    ViewerCameraMessage,
)
from viser.infra import _messages as infra_messages
from viser.infra._async_message_buffer import AsyncMessageBuffer
from viser.infra._infra import WebsockMessageHandler
from websockets.http11 import Request, Response

from page.browser_values import is_acceptable, sendable

if TYPE_CHECKING:
    import socket

CONTROL_PATH = "/control"  # path of our WebSocket
SocketHandler = Callable[[websocket_server.ServerConnection], Awaitable[None]]
RequestCheck = Callable[[websocket_server.ServerConnection, Request], "Awaitable[Response | None] | Response | None"]

_patching = threading.Lock()

# --- messages from any thread ---


class _ThreadSafeEvent(asyncio.Event):
    """An event that any thread may set; waiting tasks wake up when it is set on their own loop."""

    def set(self) -> None:
        here, self._value = asyncio._get_running_loop(), False  # a call on another thread has set it and woken no task
        if here is not None and here is self._loop:  # type: ignore[attr-defined]
            super().set()
        else:
            self._value = True


_init = AsyncMessageBuffer.__init__


def _init_with_safe_event(buffer: AsyncMessageBuffer, *args: Any, **options: Any) -> None:
    _init(buffer, *args, **options)
    buffer.message_event = _ThreadSafeEvent()


AsyncMessageBuffer.__init__ = _init_with_safe_event  # type: ignore[method-assign, assignment]

# --- values that cannot be sent ---

_prepare_value = infra_messages._prepare_for_serialization


def _prepare(value: Any, annotation: object, binary_buffers: list[memoryview] | None = None) -> Any:
    """Return a value of a message for the encoder; viser calls this for each part of it.

    An invalid number becomes NaN: the client computes with it. viser's own infinite numbers stay, msgpack carries them.
    """
    if isinstance(value, int | str) and not isinstance(value, bool):
        value = sendable(value, math.nan)
    elif isinstance(value, dict):
        value = {str(sendable(name)): each for name, each in value.items()}
    if isinstance(value, float) and not math.isfinite(value):
        return float(value)  # also where the client expects an integer
    return _prepare_value(value, annotation, binary_buffers)


infra_messages._prepare_for_serialization = _prepare

# --- the server ---


def create_server(
    listening: socket.socket, wrap_check: Callable[[RequestCheck], RequestCheck], options: Mapping[str, Any],
    control: SocketHandler,
) -> viser.ViserServer:
    """Return a viser server that listens at one socket only.

    Args:
        listening: the socket; closed if this fails.
        wrap_check: returns the request check to use instead of viser's.
        options: of the WebSocket server; they replace viser's.
        control: handles the WebSocket connections at `CONTROL_PATH`, on the loop of the server.

    Raises:
        RuntimeError: the installed viser starts its server in an unknown way.
    """
    checks = []

    def serve(handler: Any, host: Any, port: Any, *, process_request: RequestCheck | None = None, **more: Any) -> Any:
        del host, port  # viser would try the next ports if one is in use

        async def dispatch(connection: websocket_server.ServerConnection) -> None:
            path = urlsplit(connection.request.path).path if connection.request is not None else ""
            await (control if path == CONTROL_PATH else handler)(connection)

        if process_request is not None:
            checks.append(process_request)
            more["process_request"] = wrap_check(process_request)
        return original(dispatch, **more | {**options, "sock": listening})

    try:
        with _patching, silence_console():
            original = websocket_server.serve
            websocket_server.serve = serve  # type: ignore[assignment,misc]
            try:
                server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
            finally:
                websocket_server.serve = original  # type: ignore[misc]
    except BaseException:
        listening.close()
        raise
    if not checks:
        server.stop()
        listening.close()
        raise RuntimeError(f"viser {viser.__version__} starts its server in an unknown way: see page/viser_inside.py")
    for message in (ShareUrlRequest, ShareUrlDisconnect):
        server._websock_server.unregister_handler(message)
    return server


@contextmanager
def silence_console() -> Iterator[None]:
    """Suppress the table that viser prints to stdout."""
    console = get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


# The messages of browsers that the page uses. viser stores the parts of an upload to any field, and broadcasts others.
_ACCEPTED = (
    CommandTriggerMessage, GuiUpdateMessage, SceneNodeClickMessage, SceneNodeDragMessage,
    TransformControlsDragEndMessage, TransformControlsDragStartMessage, TransformControlsUpdateMessage,
    ViewerCameraMessage,
)
_NORM_TOLERANCE = 0.01  # of quaternions
_VECTOR_SIZES = {"wxyz": 4, "position": 3, "look_at": 3, "up_direction": 3, "start_position": 3, "end_position": 3}


def _is_bounded(message: object) -> bool:
    """Return whether a message is one that the page uses, with bounded values of the right sizes."""
    if not isinstance(message, _ACCEPTED):
        return False
    fields = dict(vars(message))
    updates = fields.pop("updates", {"value": None})
    if set(updates) != {"value"}:
        return False  # viser would set any attribute of our handle
    if not all(map(is_acceptable, [*fields.values(), updates["value"]])):
        return False
    if any(isinstance(each, list) for each in fields.values()):
        return False  # viser leaves a list of a wrong size, or in place of a name, as it is
    for name, size in _VECTOR_SIZES.items():
        vector = fields.get(name, (0.0,) * size)
        if len(vector) != size or not all(type(each) is float for each in vector):
            return False
    return (abs(math.hypot(*fields.get("wxyz", (1.0,))) - 1) < _NORM_TOLERANCE
            and 0 < fields.get("fov", 1.0) < math.pi)


_handle_message = WebsockMessageHandler._handle_incoming_message


async def _handle_bounded(handler: WebsockMessageHandler, client_id: Any, message: Any) -> None:
    if _is_bounded(message):
        await _handle_message(handler, client_id, message)


WebsockMessageHandler._handle_incoming_message = _handle_bounded  # type: ignore[method-assign, assignment]


def _fit(field: Any, value: Any) -> Any:
    """Return the value of a field that a browser entered, within its limits; None if it has another type."""
    before = field.value
    if isinstance(before, tuple):
        if not isinstance(value, list | tuple) or len(value) != len(before):
            return None
        parts = [_fit_one(each, one, None, None) for each, one in zip(before, value, strict=True)]
        return None if None in parts else parts
    if isinstance(field, viser.GuiDropdownHandle | viser.GuiButtonGroupHandle):
        return value if value in field.options else None
    return _fit_one(before, value, getattr(field, "min", None), getattr(field, "max", None))


def _fit_one(before: Any, value: Any, low: float | None, high: float | None) -> Any:
    if isinstance(before, bool | str):
        return value if type(value) is type(before) else None
    if not isinstance(before, int | float) or isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return min(max(value, value if low is None else low), value if high is None else high)


def filter_messages(server: viser.ViserServer, allowed: Callable[[str, object], bool]) -> None:
    """Drop messages with invalid values, and those that would change the page for others unless they are allowed.

    Args:
        server: of the page.
        allowed: called with the element id (empty: the 3D scene) and the new value, on the server's loop and in the
            context of the connection.
    """
    inside = server._websock_server

    def find_field(element: object) -> Any:
        return server.gui._gui_input_handle_from_uuid.get(element) if isinstance(element, str) else None

    def restore_value(client_id: Any, element: object) -> None:
        """Send the value of a field to the browser that shows another value now."""
        field, client = find_field(element), server.get_clients().get(client_id)
        if field is not None and client is not None and not isinstance(field, viser.GuiButtonHandle):
            client._websock_connection.queue_message(GuiUpdateMessage(element_id(field), {"value": field.value}))

    async def handle_if_allowed(client_id: Any, message: Any) -> None:
        if not _is_bounded(message):
            restore_value(client_id, getattr(message, "uuid", ""))
            return
        if not isinstance(message, ViewerCameraMessage):  # which affects its own browser only
            element, value = getattr(message, "uuid", ""), None
            if isinstance(message, GuiUpdateMessage):
                field = find_field(element)
                value = _fit(field, message.updates["value"]) if field is not None else None
                if value is None:
                    restore_value(client_id, element)
                    return
                message.updates["value"] = value
            if not allowed(element, value):
                restore_value(client_id, element)
                return
        await _handle_message(inside, client_id, message)

    inside._handle_incoming_message = handle_if_allowed  # type: ignore[method-assign]


def send_key(client: viser.ClientHandle, key: str) -> None:
    """Send the script in a browser the key of its page."""
    client._websock_connection.queue_message(RunJavascriptMessage(f"window.zencellPage?.({json.dumps(key)})"))


def element_id(element: Any) -> str:
    """Return the id by which browsers refer to a GUI element."""
    return str(element._impl.uuid)
