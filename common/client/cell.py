"""A work cell for a program: `async with Cell() as cell: await cell.arm.move("home")`."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, AsyncIterator, Mapping, Sequence
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from common import topics
from common.application import all_topics, find_topic
from common.client.arguments import require_seconds, require_text
from common.client.arm import Arm, Gripper
from common.client.frames import Frames
from common.client.goals import number
from common.client.io import Signals
from common.client.joining import StartedCell, cell_clock, domain_of_only, joined, operator_name, supervisor_status
from common.client.keys import published_keys, require_key
from common.client.parameters import Parameters
from common.client.scene import Scene, World
from common.client.several_arms import Arms
from common.client.subscriptions import (
    AnyTopic,
    Camera,
    NothingReceived,
    Part,
    Subscriptions,
    cameras,
    find_live_topic,
    messages,
)
from common.client.task import TaskControl
from common.config import check
from common.errors import ConfigError, DecodeError, UnknownName, ZencellError
from common.messages import CollisionObject, Header, Message, PlanningScene, StopRequest, SupervisorStatus
from common.topics import Request, Topic
from common.transport.bus import Bus
from common.transport.credentials import OPERATOR

TIMEOUT = 5.0  # [s] wall for an answer
NOT_JOINED = "is not joined: use it inside `async with Cell(...) as cell`, or `with` in the blocking client"


def perceived(scene: PlanningScene) -> list[CollisionObject]:
    """Return the perceived objects of a planning scene."""
    return [each for each in scene.objects if each.role in ("target", "contained")]


class Cell(Part):
    """One work cell, joined inside `async with`. Several programs may join the same cell.

    Attributes:
        owner: name of this client in its requests.
        arm: state, plans, motions, jogging.
        arms: the arms of a cell with several, by name: `cell.arms["left"].move("home")`.
        gripper: fingers or suction cup.
        io: digital and analog inputs and outputs.
        task: start, pause, resume, stop, status.
        param: parameters of the services by path.
        scene: solids in the planning scene that no camera sees.
        world: the simulated world.
        bus: connection of this program to the cell.
    """

    owner: str
    arm: Arm
    arms: Arms[Arm]
    gripper: Gripper
    io: Signals
    task: TaskControl
    param: Parameters
    scene: Scene
    world: World

    def __init__(
        self, name: str | None = None, *, domain: int | str | None = None, connect: str | None = None,
        secure: str | None = None, owner: str | None = None, application: str = "",
        remapped: Mapping[str, str] | None = None,
    ) -> None:
        """A running cell; nothing happens before `async with`.

        Args:
            name: of the cell; not needed if only one is running.
            domain: 0 to 232, as for `--domain`; default: ZENCELL_DOMAIN, or 42, or the one with the only cell of this
                host if nothing runs in 42.
            connect: endpoint of its router, such as tcp/192.168.1.10:7489; default: ZENCELL_CONNECT.
            secure: folder of certificates with that of the operator; default: ZENCELL_SECURE.
            owner: name of this client in its requests; default: user and host.
            application: dotted module of a custom application.
            remapped: keys of the cell by the platform's names, like `topics:` of a service in a cell file.

        Raises:
            ConfigError: the owner is not a valid name.
        """
        self._where: dict[str, Any] = {"domain": domain, "connect": connect, "secure": secure, "remapped": remapped}
        self._name, self._application = name, application
        # Checked now: a bad name must not prevent a stop later.
        self._set(owner=check(StopRequest, {"owner": owner or operator_name()}).owner)
        self._joined = contextlib.AsyncExitStack()
        self._started: StartedCell | None = None
        self._bus: Bus | None = None
        self._entered = False
        self._frames: Frames | None = None

    @classmethod
    def start(
        cls, cell: str, *, speed: float = 1.0, world: str | None = None, seed: int | None = None,
        overrides: Sequence[str] = (), autostart: bool = False, viewer: bool = False, domain: int | str | None = None,
        owner: str | None = None, application: str = "",
    ) -> Cell:
        """Return a cell that is started when it is entered with `async with`, and ended when that is left.

        Args:
            cell: a name of `zencell cells`, or the path of a YAML file.
            speed: cell time per wall time, 0.1 to 10; 1 with a real arm.
            world: another world, by name or path.
            seed: of all random numbers.
            overrides: values of the cell, as for `--set`.
            autostart: start its task at once; otherwise nothing moves before a request.
            viewer: start the operator's page.
            domain: 0 to 232; default: a free one.
            owner: name of this client in its requests; default: user and host.
            application: dotted module of a custom application.
        """
        started = cls(owner=owner, application=application)
        values = [*overrides, f"autostart={str(autostart).lower()}"]
        started._started = StartedCell(cell, speed=speed, world=world, seed=seed, overrides=values, viewer=viewer,
                                       domain=domain)
        return started

    @classmethod
    def on(cls, bus: Bus, *, owner: str | None = None, application: str = "") -> Cell:
        """Return the cell of an existing bus, which the caller closes."""
        cell = cls(bus.cell, owner=owner, application=application)
        cell._attach(bus)
        return cell

    def _attach(self, bus: Bus) -> None:
        self._bus, self._subscriptions = bus, Subscriptions(bus)
        arm = Arm(self._subscriptions, self.owner, self.tf)
        self._set(
            arm=arm, arms=Arms(bus, lambda name: self.of_arm(name).arm),
            gripper=Gripper(self._subscriptions, self.owner, arm),
            io=Signals(self._subscriptions, self.owner),
            task=TaskControl(self._subscriptions, self.owner, self._application), param=Parameters(bus),
            scene=Scene(self._subscriptions, self.owner), world=World(bus, self._subscriptions))

    async def __aenter__(self) -> Cell:
        if self._entered:
            raise ZencellError("the cell is joined already")
        async with contextlib.AsyncExitStack() as stack:
            if self._started is not None:
                up = await stack.enter_async_context(self._started)
                self._name, self._where = up.name, {**self._where, "domain": up.domain}
            if self._bus is None:
                if self._where["domain"] is None and self._where["connect"] is None:
                    self._where["domain"] = await domain_of_only(self._name, self._where["secure"])
                bus = await stack.enter_async_context(joined(self._name, identity=OPERATOR, **self._where))
                bus.clock = await cell_clock(bus)
                self._attach(bus)
                stack.callback(setattr, self, "_bus", None)
            self._joined = stack.pop_all()
        self._entered = True
        return self

    async def __aexit__(self, *_: object) -> None:
        self._frames, self._entered = None, False
        try:
            await self.arm.end()
        finally:
            await self._joined.aclose()

    def __getattr__(self, name: str) -> Any:
        """Raise an error that says why an attribute is missing.

        Raises:
            ZencellError: the cell is not joined.
            AttributeError: there is no such attribute.
        """
        if name in Cell.__annotations__:
            raise ZencellError(f"cell.{name}: the cell {NOT_JOINED}")
        raise AttributeError(f"a Cell has no {name!r}")

    @property
    def bus(self) -> Bus:
        """The connection to the cell, for what this class does not offer.

        Raises:
            ZencellError: the cell is not joined.
        """
        if self._bus is None:
            raise ZencellError(f"the cell {NOT_JOINED}")
        return self._bus

    def of_arm(self, name: str) -> Cell:
        """Return the cell of one of its arms, joined as long as this one; its `task.stop` stops all arms.

        Its `arm`, `gripper`, `task`, `scene` and `planning_scene` are those of the arm.
        """
        return Cell.on(self.bus.of_arm(name), owner=self.owner, application=self._application)

    @property
    def name(self) -> str:
        """Name of the cell, the first part of all its keys."""
        return self.bus.cell

    async def services(self) -> SupervisorStatus:
        """Return all processes of the cell, its speed and seed, from its supervisor."""
        status = await supervisor_status(self.bus)
        if status is None:
            raise NothingReceived(f"{self.name}/{topics.SUPERVISOR_STATUS.key}")
        return status

    # --- perception -----------------------------------------------------------------------------------------------

    async def cameras(self) -> list[str]:
        """Return the names of its cameras."""
        return await cameras(self.bus)

    def camera(self, name: str = "") -> Camera:
        """Return a camera; the name may be omitted if there is one. `await cell.camera().image()` works directly.

        Raises:
            UnknownName: with the choices, when the camera is awaited or used.
        """
        _ = self.bus  # raises if the cell is not joined
        return Camera(name, self._subscriptions, self.tf)

    async def planning_scene(self) -> PlanningScene:
        """Return the obstacles of planners: fixtures, perceived objects, and solids that operators added."""
        return await self._subscriptions.query(topics.PLANNING_SCENE)

    async def objects(self, least: int = 0, *, timeout: float = TIMEOUT) -> list[CollisionObject]:
        """Return the perceived objects: ids, shapes, dimensions [m], colours, and poses in world.

        Args:
            least: wait for that many; just after a start no image was processed yet.
            timeout: for this wait [s, wall].

        Raises:
            NothingReceived: there are fewer.
        """
        number("least", least)
        require_seconds("timeout", timeout)
        reader = self._subscriptions.reader(topics.PLANNING_SCENE)
        found = perceived(await self.planning_scene())
        try:
            async with asyncio.timeout(timeout):
                while len(found) < least:
                    found = perceived(await reader.next())
        except TimeoutError:
            missing = f"{self.name}/planning_scene with {least} objects, only with {len(found)}"
            raise NothingReceived(missing, timeout) from None
        return found

    async def tf(self, target: str, source: str) -> NDArray[np.float64]:
        """Return the pose (4, 4) of frame `source` in frame `target`: "world", "tcp", and those of `zencell tf frames`.

        Raises:
            UnknownName: an unknown frame; with the choices.
            NothingReceived: no transforms are published, or a moving one is outdated.
        """
        target, source = [await self._frame(name) for name in (target, source)]
        known = self._frames
        if known is None:
            known = self._frames = await self._joined.enter_async_context(Frames(self.bus))
            await known.until_known(target, source)
        else:
            await known.until_known(target, source)
            await known.until_moved(target, source)
        return known.tree.pose(target, source)

    async def _frame(self, name: str) -> str:
        return (await self.arm.description()).tcp if name == "tcp" else name

    # --- any key --------------------------------------------------------------------------------------------------

    async def _topic(self, key: str | AnyTopic) -> AnyTopic | None:
        if isinstance(key, Topic | Request):
            return key
        if not isinstance(key, str):
            raise ConfigError("key", key, "must be a key, or its Topic or Request")
        return find_topic(key) or await find_live_topic(self.bus, key)

    async def call(
        self, key: str | Request[Any, Any], message: Message | Mapping[str, Any] | None = None, *,
        timeout: float = TIMEOUT, **fields: Any,
    ) -> Any:
        """Send a request and return the answer.

        Args:
            key: such as "motion/stop", or the `Request`.
            message: the request message, or its fields.
            timeout: [s, wall].
            fields: of the message, instead of `message`.

        Raises:
            UnknownName: there is no such request; with the choices.
            ConfigError: a field is not valid.
            NoResponder, RemoteError, RequestLost, RequestTimeout: the four ways in which a request gets no answer.
        """
        request = await self._topic(key)
        if not isinstance(request, Request):
            raise UnknownName("request", str(key), [n for n, each in all_topics().items() if isinstance(each, Request)])
        require_seconds("timeout", timeout)
        if not isinstance(message, Message | Mapping | None):
            raise ConfigError(request.key, message, f"must be a {request.message.__name__}, or its fields")
        checked = message if isinstance(message, Message) else check(
            request.message, {**(message or {}), **fields}, request.key)
        if isinstance(header := getattr(checked, "header", None), Header) and not header.stamp:
            checked = checked.model_copy(update={"header": self.bus.header(header.frame_id)})  # decided now
        return await self.bus.client(request).call(checked, timeout)

    async def listen(
        self, key: str | Topic[Any], *, plain: bool = False, timeout: float | None = None
    ) -> AsyncIterator[Any]:
        """Yield messages of a key from now on: of a stream or state the newest, of an event topic all.

        Args:
            key: such as "joint_states", or the `Topic`.
            plain: accept any key, and yield unpacked msgpack: dictionaries, lists, numbers.
            timeout: for each message [s, wall]; without one this waits forever, also after the end of the cell.

        Raises:
            UnknownName: no service of zencell writes the key and it is not `plain`, or it is not a valid key.
            ConfigError: it is a request.
            DecodeError: a payload is not msgpack.
            NothingReceived: no message arrived in time.
        """
        topic = None if plain else await self._topic(key)
        if timeout is not None:
            require_seconds("timeout", timeout)
        if plain:
            require_text("key", key)
            require_key(str(key))
        if topic is None and not plain:
            raise UnknownName("key", str(key), published_keys())
        if isinstance(topic, Request):
            raise ConfigError("key", topic.key, f"is a request: await cell.call({topic.key!r}, ...)")
        found = messages(self.bus, topic) if topic is not None else self._unpacked(f"{self.name}/{key}")
        async with contextlib.aclosing(found):
            while True:
                try:
                    async with asyncio.timeout(timeout):
                        message = await anext(found)
                except TimeoutError:
                    raise NothingReceived(f"{self.name}/{topic.key if topic else key}", timeout or 0.0) from None
                yield message

    async def _unpacked(self, key: str) -> AsyncGenerator[Any]:
        async for sample in self.bus.raw_reader(key):
            try:
                value = msgpack.unpackb(sample.payload, strict_map_key=False)
            except (ValueError, TypeError, RecursionError, msgpack.UnpackException):
                raise DecodeError(f"{key}: {len(sample.payload)} bytes received that are not msgpack") from None
            yield value
