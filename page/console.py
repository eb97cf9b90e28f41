"""Operations of the page: callbacks of viser's threads are moved to the service's loop, and become requests there."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Coroutine, Iterable
from contextvars import Context, copy_context
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeVar

import viser
from pydantic import JsonValue

from common import topics
from common.client.task import send_task_command, stop_arm_and_task
from common.config import Members
from common.errors import RemoteError, RequestFailed
from common.messages import (
    Header,
    JogCommand,
    Message,
    MotionOwner,
    OwnRequest,
    Parameter,
    ParameterRequest,
)
from common.topics import Request, Topic
from page.access import CURRENT_SESSION, PAGE, Permission, Permissions
from page.feeds import Feeds
from page.status_text import USER_ERRORS, error_text
from page.viser_inside import element_id

if TYPE_CHECKING:
    from common.transport.bus import Bus
    from common.transport.requests import Client

Action = Callable[[], Coroutine[Any, Any, None] | None]
M = TypeVar("M", bound=Message)
Q = TypeVar("Q", bound=Message)
A = TypeVar("A", bound=Message)
V = TypeVar("V")
V_co = TypeVar("V_co", covariant=True)

EXECUTOR = "trajectory_executor"
SPEED = f"services.{EXECUTOR}.speed_scaling"
STOPPED = "stopped on the page"  # reason of its stops
SLIDER_DEBOUNCE = 0.15  # [s] without a change, after which the value of a slider is sent
_FAST_TIMEOUT = 2.0  # [s] wall: for stopping, and for replies that need no work
_TIMEOUT = 5.0  # [s] wall: for all other requests


def stopped_by(client: str) -> str:
    """Return the result of a STOP of arm and task."""
    return f"Stopped by {client}"


class Field(Protocol[V_co]):
    """A field of the page, in a form that mypy understands."""

    @property
    def value(self) -> V_co:
        """Its current value."""


def assign(handle: Field[V], value: V) -> None:
    """Set the value of a field in every browser."""
    handle.value = value  # type: ignore[misc]  # it has a setter, behind a decorator


class Notify(Protocol):
    """Shows the operator the result of an operation."""

    def __call__(self, line: str, kind: str = "bad", /) -> None:
        """Show a line of kind good, busy or bad; an empty line clears it. Runs on the loop of the service."""


class ActionQueue:
    """Accepts actions from any thread and runs them on the loop: plain functions in order, coroutines concurrently.

    Errors that an operator can understand are shown; any other exception is a bug and ends `run`.

    Attributes:
        notify: shows a line to the operator; set by the panel that displays it.
        permissions: of the pages.
        before_operation: runs before each operation of a button of `markup`.
    """

    def __init__(self, permissions: Permissions | None = None) -> None:
        """Bind to the running loop."""
        self.notify: Notify = lambda _line, _kind="bad": None
        self.permissions = permissions or Permissions()
        self.permissions.on_denied = lambda line: self.put(lambda: self.notify(line))
        self.before_operation: Action = lambda: None
        self._loop = asyncio.get_running_loop()
        self._queue: asyncio.Queue[tuple[Action, Context]] = asyncio.Queue()
        self._buttons: dict[str, tuple[Action, Permission]] = {}

    def put(self, action: Action) -> None:
        """Queue an action for the current session; thread-safe, ignored once the loop is closed."""
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._queue.put_nowait, (action, copy_context()))

    async def run(self) -> None:
        """Run actions until cancelled."""
        async with asyncio.TaskGroup() as group:
            while True:
                action, context = await self._queue.get()
                try:
                    coroutine = context.run(action)
                except USER_ERRORS as error:
                    self.notify(error_text(error))
                    continue
                if coroutine is not None:
                    group.create_task(self._await(coroutine), context=context)

    async def _await(self, coroutine: Coroutine[Any, Any, None]) -> None:
        try:
            await coroutine
        except USER_ERRORS as error:
            self.notify(error_text(error))

    # --- buttons of `markup`, which report over the control socket ---

    def on_press(self, name: str, action: Action, label: str, permission: Permission = "operate") -> None:
        """Run an action when a permitted page clicks a button of `markup.press`; the log shows `label`."""
        self.permissions.require(f"press:{name}", permission, label)
        self._buttons[name] = action, permission

    def press(self, name: str) -> None:
        """Handle a click on a button; an unknown name is ignored. Thread-safe."""
        action, permission = self._buttons.get(name, (None, "look"))
        if action is not None and self.permissions.allow(CURRENT_SESSION.get(), f"press:{name}"):
            if permission == "operate":
                self.put(self.before_operation)
            self.put(action)

    # --- elements of viser; it runs coroutine callbacks on its loop at once, others wait for a thread ---

    def on_click(self, button: viser.GuiButtonHandle, action: Action, permission: Permission = "operate") -> None:
        """Run an action when a permitted page clicks a button."""
        self.permissions.require(element_id(button), permission, button.label)

        async def clicked(_event: object) -> None:
            self.put(action)

        button.on_click(clicked)

    def on_choice(
        self, buttons: viser.GuiButtonGroupHandle, action: Callable[[str], Coroutine[Any, Any, None] | None]
    ) -> None:
        """Run an action with the text of the clicked button of a group."""
        self.permissions.require(element_id(buttons), "operate", buttons.label)

        async def clicked(event: viser.GuiEvent[viser.GuiButtonGroupHandle]) -> None:
            chosen = event.target.value
            if chosen in event.target.options:
                self.put(lambda: action(chosen))

        buttons.on_click(clicked)

    def on_change(
        self, handle: viser.GuiInputHandle[V], action: Callable[[V], Coroutine[Any, Any, None] | None],
        permission: Permission = "operate",
    ) -> None:
        """Run an action with the value that a page entered; not for values that the service sets itself."""
        self.permissions.require(element_id(handle), permission, handle.label)

        async def changed(event: viser.GuiEvent[viser.GuiInputHandle[V]]) -> None:
            value = event.target.value
            if event.client_id is not None:
                self.put(lambda: action(value))

        handle.on_update(changed)


class Console(ActionQueue):
    """Sends the operator's requests to the cell. Each ends with an answer or raises a `RequestFailed`.

    Attributes:
        on_object_selected: called with the id of an object of the simulated world that was clicked in the scene.
        on_object_moved: called with the id and the new center x, y [m] of one that was dragged in the scene.
        stop_count: number of STOPs on this page, successful or not.
        has_task: whether the cell has a task, which may be down.
    """

    def __init__(
        self, bus: Bus, members: Members, feeds: Feeds, requests: Iterable[Request[Any, Any]] = (),
        permissions: Permissions | None = None,
    ) -> None:
        """Declare the clients.

        Args:
            bus: of the service.
            members: services of the cell.
            feeds: topics that the page reads.
            requests: further requests, of the application.
            permissions: of the pages.
        """
        super().__init__(permissions)
        self._feeds, self._bus, self._jog_writer = feeds, bus, bus.writer(topics.MOTION_JOG)
        self.on_object_selected: Callable[[str], None] = lambda _name: None
        self.on_object_moved: Callable[[str, float, float], Coroutine[Any, Any, None] | None] = lambda *_moved: None
        self.stop_count, self.has_task = 0, bool(members.task)
        self._own_stop = 0  # `since` of the newest stop of this page
        used: list[Request[Any, Any]] = [
            topics.TASK_COMMAND, topics.MOTION_STOP, topics.MOTION_OWN, topics.GRIPPER_COMMAND,
            topics.ROBOT_COMMAND, topics.WORLD_EDIT]
        self._clients: dict[str, Client[Any, Any]] = {
            request.key: bus.client(request) for request in [*used, *requests]}
        self._parameters = {name: bus.client(topics.parameters_of(name)) for name in members.services}

    # --- state of the cell ---

    def latest(self, topic: Topic[M]) -> M | None:
        """Return the newest message of a topic that the page reads, or None."""
        return self._feeds.latest(topic)

    @property
    def acknowledged(self) -> int | None:
        """`since` of the newest stop or hold known to the page; None without a motion status."""
        motion = self.latest(topics.MOTION_STATUS)
        return max(motion.newest, self._own_stop) if motion else None

    def header(self) -> Header:
        """Return a header for a request that is decided now: receivers reject it if it arrives too late."""
        return self._bus.header()

    def is_available(self, request: Request[Any, Any]) -> bool:
        """Return whether a service serves this request now."""
        return self._clients[request.key].available

    async def published_keys(self) -> frozenset[str]:
        """Return the keys that are published or served in the cell now."""
        return frozenset(owner.key for owner in await self._bus.owners())

    # --- requests ---

    async def call(self, request: Request[Q, A], message: Q, timeout: float = _TIMEOUT) -> A:
        """Return the answer to a request of the page, or to one that an application lists in its `REQUESTS`."""
        self._require("operate")
        client: Client[Q, A] = self._clients[request.key]
        return await client.call(message, timeout)

    def _require(self, role: str) -> None:
        """Check the role of the page that causes a request again where the request leaves this process.

        Raises:
            RemoteError: its token has not that role.
        """
        session = CURRENT_SESSION.get()  # None: the service itself causes it
        if self.permissions.enforced and session is not None and role not in session.roles:
            raise RemoteError(PAGE, "denied", f"{session} has no token for the role {role!r}")

    async def command(self, command: str, override: bool = False, acknowledged: int | None = None) -> None:
        """Send the task a command: start, pause, resume or stop.

        Args:
            command: name of the command.
            override: start or resume although another operator holds the arm.
            acknowledged: newest stop or hold known when this was decided; newer ones stay in force. Default: now.
        """
        if command != "stop":
            self._require("operate")
        acknowledged = self.acknowledged if acknowledged is None else acknowledged
        await send_task_command(self._clients[topics.TASK_COMMAND.key], command, self.permissions.client_name,
                                override=override, acknowledged=acknowledged, timeout=_TIMEOUT)

    async def stop(self) -> str:
        """Stop the arm and end the task, concurrently; return a line with what was stopped.

        Raises:
            RequestFailed: the arm did not confirm the stop; the task was stopped if it could be reached.
        """
        self.stop_count += 1
        client = self.permissions.client_name
        result = await stop_arm_and_task(self._clients[topics.MOTION_STOP.key], self._clients[topics.TASK_COMMAND.key],
                                         client, STOPPED, _FAST_TIMEOUT)
        if isinstance(result.arm, RequestFailed):
            raise result.arm
        self._own_stop = result.arm.newest
        if isinstance(result.task, RequestFailed) and self.has_task:
            return f"Arm stopped by {client}; task NOT stopped: {error_text(result.task)}"
        return stopped_by(client)

    async def own(self, act: Literal["take", "give"], over: bool = False) -> MotionOwner:
        """Take motion ownership for the current session until it is released, or release it."""
        request = OwnRequest(act=act, owner=self.permissions.client_name, over=over)
        return await self.call(topics.MOTION_OWN, request, _FAST_TIMEOUT)

    def jog(self, acknowledged: int, **velocities: Any) -> None:
        """Move with velocities, as fields of a `JogCommand`, for the next 0.1 s; without any come to a stop."""
        if velocities:
            self._require("operate")
        fields = {"header": self._bus.header(), "owner": self.permissions.client_name, "acknowledged": acknowledged}
        self._jog_writer.put(JogCommand.model_validate(fields | velocities))

    # --- parameters ---

    async def parameters(self) -> dict[str, list[Parameter]]:
        """Return the parameters of each service that answers."""
        names = [name for name, client in self._parameters.items() if client.available]
        replies = await asyncio.gather(*map(self._parameters_of, names))
        return {name: reply for name, reply in zip(names, replies, strict=True) if reply is not None}

    async def _parameters_of(self, service: str) -> list[Parameter] | None:
        try:
            return (await self._parameters[service].call(ParameterRequest(), _FAST_TIMEOUT)).parameters
        except RequestFailed:
            return None  # shown as lost elsewhere, or requested again soon

    async def set_parameter(self, services: list[str], path: str, value: JsonValue, role: str = "tune") -> None:
        """Set a parameter in every service that has it; the page must have the role."""
        self._require(role)
        request = ParameterRequest(set={path: value}, by=self.permissions.client_name)
        await asyncio.gather(*(self._parameters[name].call(request, _FAST_TIMEOUT) for name in services))

    async def set_speed(self, scaling: float) -> None:
        """Set the speed at which trajectories are executed, 0 to 1."""
        await self.set_parameter([EXECUTOR], SPEED, scaling, "operate")
