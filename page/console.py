"""From a person to the cell: what is done on the page is brought from viser's threads to the loop, and asked there."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Callable, Coroutine, Iterable
from contextvars import Context, copy_context
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeVar

import viser
from pydantic import JsonValue

from common import topics
from common.client.task import send_task_command, stop_arm_and_task
from common.config import Members
from common.errors import RequestFailed
from common.messages import (
    Header,
    JogCommand,
    Message,
    MotionOwner,
    OwnRequest,
    Parameter,
    ParameterRequest,
    Vector3,
    WorldEdit,
)
from common.topics import Request, Topic
from page.doors import VISITOR, Doors, Need
from page.feeds import Feeds
from page.words import UNDERSTOOD, problem
from page.world_edits import WorldEdits

if TYPE_CHECKING:
    from common.transport.bus import Bus
    from common.transport.requests import Client

Act = Callable[[], Coroutine[Any, Any, None] | None]
M = TypeVar("M", bound=Message)
Q = TypeVar("Q", bound=Message)
A = TypeVar("A", bound=Message)
V = TypeVar("V")
V_co = TypeVar("V_co", covariant=True)

EXECUTOR = "trajectory_executor"
SPEED = f"services.{EXECUTOR}.speed_scaling"
SLIDING = 0.15  # [s] after a slider came to rest, what it says is sent
_SOON = 2.0  # [s] wall: for what every service has at hand, and for stopping
_PATIENCE = 5.0  # [s] wall: for anything else


class Field(Protocol[V_co]):
    """Something on the page that has a value, as mypy sees it."""

    @property
    def value(self) -> V_co:
        """What it shows."""


def assign(handle: Field[V], value: V) -> None:
    """Show a value in a field of the page, in every browser."""
    handle.value = value  # type: ignore[misc]  # it has a setter, behind a decorator


def can_be_given(handle: object, value: object) -> bool:
    """Whether a browser can give that value: whoever has the page open may send what no field of it takes."""
    if isinstance(value, float) and not math.isfinite(value):
        return False
    if isinstance(value, list | tuple) and not all(can_be_given(None, each) for each in value):
        return False
    return not isinstance(handle, viser.GuiDropdownHandle) or value in handle.options


class Tell(Protocol):
    """Shows a person a line about what they asked for."""

    def __call__(self, line: str, kind: str = "bad", /) -> None:
        """Show a line that is good, busy or bad; an empty one takes it away. On the loop of the service."""


class Desk:
    """Takes orders on any thread and carries them out on the loop: plain calls in order, coroutines side by side.

    What goes wrong in a way that a person can understand is told; anything else is a bug and ends `run`.
    """

    def __init__(self, doors: Doors | None = None) -> None:
        """Make a desk, on the running loop. `tell` is to be replaced by whoever can show a line to the person."""
        self.tell: Tell = lambda _line, _kind="bad": None
        self.doors = doors or Doors()
        self.doors.refused = lambda line: self.put(lambda: self.tell(line))
        self._loop = asyncio.get_running_loop()
        self._orders: asyncio.Queue[tuple[Act, Context]] = asyncio.Queue()
        self._pressed: dict[str, tuple[Act, Need]] = {}
        self.operated: Act = lambda: None  # is done first when somebody operates by a button of our own

    def put(self, act: Act) -> None:
        """Have something done for who asks now; from any thread. A loop that has ended does nothing more."""
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._orders.put_nowait, (act, copy_context()))

    async def run(self) -> None:
        """Carry out orders until cancelled."""
        async with asyncio.TaskGroup() as group:
            while True:
                act, context = await self._orders.get()
                try:
                    doing = context.run(act)
                except UNDERSTOOD as error:
                    self.tell(problem(error))
                    continue
                if doing is not None:
                    group.create_task(self._see_through(doing), context=context)

    async def _see_through(self, doing: Coroutine[Any, Any, None]) -> None:
        try:
            await doing
        except UNDERSTOOD as error:
            self.tell(problem(error))

    def on_press(self, name: str, act: Act, what: str, need: Need = "operate") -> None:
        """Do something whenever a button of `markup.press` is clicked by somebody who may; `what` is for the log."""
        self.doors.need(f"press:{name}", need, what)
        self._pressed[name] = act, need

    def press(self, name: str) -> None:
        """A button was clicked by who asks now; one that there is not does nothing. From any thread."""
        act, need = self._pressed.get(name, (None, "look"))
        if act is not None and self.doors.admit(VISITOR.get(), f"press:{name}"):
            if need == "operate":
                self.put(self.operated)
            self.put(act)

    # Callbacks of viser that are coroutines run on its loop at once; others would wait for a thread.

    def on_click(self, button: viser.GuiButtonHandle, act: Act, need: Need = "operate") -> None:
        """Do something whenever a button is clicked by somebody who may."""
        self.doors.need(button._impl.uuid, need, button.label)

        async def clicked(_event: object) -> None:
            self.put(act)

        button.on_click(clicked)

    def on_choice(
        self, buttons: viser.GuiButtonGroupHandle, act: Callable[[str], Coroutine[Any, Any, None] | None]
    ) -> None:
        """Do something with the text of the button that was clicked in a group."""
        self.doors.need(buttons._impl.uuid, "operate", buttons.label)

        async def clicked(event: viser.GuiEvent[viser.GuiButtonGroupHandle]) -> None:
            chosen = event.target.value
            if chosen in event.target.options:
                self.put(lambda: act(chosen))

        buttons.on_click(clicked)

    def on_change(
        self, handle: viser.GuiInputHandle[V], act: Callable[[V], Coroutine[Any, Any, None] | None],
        need: Need = "operate",
    ) -> None:
        """Do something with the value that a person gave; not with one that the service sets itself."""
        self.doors.need(handle._impl.uuid, need, handle.label)

        async def changed(event: viser.GuiEvent[viser.GuiInputHandle[V]]) -> None:
            value = event.target.value
            if event.client_id is not None and can_be_given(event.target, value):
                self.put(lambda: act(value))

        handle.on_update(changed)


class Console(Desk):
    """A desk that knows whom to ask. Each request ends in an answer or raises a `RequestFailed`."""

    def __init__(
        self, bus: Bus, members: Members, feeds: Feeds, more: Iterable[Request[Any, Any]] = (),
        doors: Doors | None = None,
    ) -> None:
        """Declare the clients.

        Args:
            bus: of the service.
            members: who is in the cell.
            feeds: what the cell says.
            more: what else may be asked.
            doors: know who may do what on the page.
        """
        super().__init__(doors)
        self._feeds, self._bus, self._jog = feeds, bus, bus.writer(topics.MOTION_JOG)
        self.world = WorldEdits(
            lambda edit: self.ask(topics.WORLD_EDIT, edit), lambda: self.latest(topics.SCENE_OBJECTS))
        self.picked: Callable[[str], None] = lambda _name: None  # an object of the simulated world, in the scene
        self._newest = 0  # `since` of the stop that was said here
        self.stops = 0  # how often STOP was said here, heard or not
        asked: list[Request[Any, Any]] = [
            topics.TASK_COMMAND, topics.MOTION_STOP, topics.MOTION_OWN, topics.GRIPPER_COMMAND,
            topics.ROBOT_COMMAND, topics.WORLD_EDIT]
        self._clients: dict[str, Client[Any, Any]] = {request.key: bus.client(request) for request in [*asked, *more]}
        self._parameters = {name: bus.client(topics.parameters_of(name)) for name in members.services}

    def latest(self, topic: Topic[M]) -> M | None:
        """The newest message of a topic that the page reads, or None."""
        return self._feeds.latest(topic)

    async def ask(self, request: Request[Q, A], message: Q, timeout: float = _PATIENCE) -> A:
        """The answer to a request of the page, or of those that an application named as its `REQUESTS`."""
        client: Client[Q, A] = self._clients[request.key]
        return await client.call(message, timeout)

    @property
    def acknowledged(self) -> int | None:
        """`since` of the newest stop or hold that the page knows of; None where nobody tells of them."""
        motion = self.latest(topics.MOTION_STATUS)
        return max(motion.newest, self._newest) if motion else None

    async def command(self, command: str, override: bool = False, acknowledged: int | None = None) -> None:
        """Tell the task to start, pause, resume or stop; to start or resume although another person holds the arm.

        Nothing is let go of that is newer than what was `heard` of as this was decided; left out: that is now.
        """
        acknowledged = self.acknowledged if acknowledged is None else acknowledged
        await send_task_command(self._clients[topics.TASK_COMMAND.key], command, self.doors.person, override=override,
                                acknowledged=acknowledged, timeout=_PATIENCE)

    async def stop(self) -> str:
        """Bring the arm to rest and end the task, at the same time; returns in a line what was stopped, and by whom.

        Raises:
            RequestFailed: the arm could not be told; the task was, if it could.
        """
        self.stops += 1
        operator = self.doors.person
        result = await stop_arm_and_task(self._clients[topics.MOTION_STOP.key], self._clients[topics.TASK_COMMAND.key],
                                         operator, "stopped on the page", _SOON)
        if isinstance(result.arm, RequestFailed):
            raise result.arm
        self._newest = result.arm.newest
        if isinstance(result.task, RequestFailed):
            return f"Arm stopped by {operator}; not the task: {problem(result.task)}"
        return f"Stopped by {operator}"

    async def own(self, act: Literal["take", "give"], over: bool = False) -> MotionOwner:
        """Have the motion of the robot for who asks now until it is given back, or give it back."""
        return await self.ask(topics.MOTION_OWN, OwnRequest(act=act, owner=self.doors.person, over=over), _SOON)

    def jog(self, acknowledged: int, **velocities: Any) -> None:
        """Move with velocities for the next 0.1 s, as a `JogCommand` has them; without any come to rest."""
        fields = {"header": self._bus.header(), "owner": self.doors.person, "acknowledged": acknowledged, **velocities}
        self._jog.put(JogCommand.model_validate(fields))

    def header(self) -> Header:
        """Of what is decided now: what comes late, or again after a restart, is refused by it."""
        return self._bus.header()

    def answers(self, request: Request[Any, Any]) -> bool:
        """Whether somebody serves a request now."""
        return self._clients[request.key].available

    async def written(self) -> frozenset[str]:
        """The keys that are written or served in the cell now."""
        return frozenset(owner.key for owner in await self._bus.owners())

    async def move(self, object_id: str, x: float, y: float) -> None:
        """Put an object of the simulated world somewhere [m]."""
        await self.world.do(WorldEdit(op="move", id=object_id, position=Vector3(x=x, y=y)))

    async def parameters(self) -> dict[str, list[Parameter]]:
        """The parameters of each service that answers."""
        names = [name for name, client in self._parameters.items() if client.available]
        replies = await asyncio.gather(*map(self._parameters_of, names))
        return {name: reply for name, reply in zip(names, replies, strict=True) if reply is not None}

    async def _parameters_of(self, service: str) -> list[Parameter] | None:
        try:
            return (await self._parameters[service].call(ParameterRequest(), _SOON)).parameters
        except RequestFailed:
            return None  # it is shown as gone, or asked again soon

    async def set_parameter(self, services: list[str], path: str, value: JsonValue) -> None:
        """Change a parameter in every service that has it."""
        request = ParameterRequest(set={path: value}, by=self.doors.person)
        await asyncio.gather(*(self._parameters[name].call(request, _SOON) for name in services))

    async def set_speed(self, scaling: float) -> None:
        """Have trajectories followed at a share of their speed."""
        await self.set_parameter([EXECUTOR], SPEED, scaling)
