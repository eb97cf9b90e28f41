"""A work cell for a program: `async with Cell() as cell: await cell.arm.move("home")`."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncGenerator, AsyncIterator, Mapping, Sequence
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from common import topics
from common.application import all_topics, find_topic
from common.client.arm import Arm, Gripper
from common.client.foreign import require_key
from common.client.frames import Frames
from common.client.joining import cell_clock, joined, person, supervisor_status
from common.client.parameters import Parameters
from common.client.part import Part
from common.client.scene import Scene
from common.client.starting import StartedCell
from common.client.subscriptions import (
    Camera,
    Carried,
    NothingReceived,
    Subscriptions,
    cameras,
    find_live_topic,
    messages,
)
from common.client.task import TaskControl
from common.config import check
from common.errors import ConfigError, DecodeError, UnknownName, ZencellError
from common.messages import (
    CollisionObject,
    Header,
    Message,
    PlanningScene,
    StopRequest,
    SupervisorStatus,
    WorldEdit,
    WorldObject,
)
from common.topics import Request, Topic
from common.transport.bus import Bus
from common.transport.credentials import OPERATOR

TIMEOUT = 5.0  # [s] wall for an answer
NOT_JOINED = "is not joined: use it inside `async with Cell(...) as cell`, or `with` where nothing is awaited"


def seen(scene: PlanningScene) -> list[CollisionObject]:
    """What was perceived of a planning scene."""
    return [each for each in scene.objects if each.role in ("target", "contained")]


class World(Part):
    """The simulated world; a real one is not changed by saying so."""

    def __init__(self, bus: Bus, ear: Subscriptions) -> None:
        """The world of a cell."""
        self._bus, self._ear = bus, ear

    async def edit(self, op: str, **fields: Any) -> list[str]:
        """Ids of all there is after an edit: the fields are those of a `WorldEdit`."""
        asked = check(WorldEdit, {"op": op, **fields}, "world")
        return (await self._bus.client(topics.WORLD_EDIT).call(asked, TIMEOUT)).ids

    async def add(self, x: float, y: float, **more: Any) -> list[str]:
        """Put one more object at a place [m]: like the first of the world, but for what else is said."""
        return await self.edit("add", position={"x": x, "y": y}, **more)

    async def move(self, name: str, x: float, y: float, **more: Any) -> list[str]:
        """Put an object elsewhere [m]."""
        return await self.edit("move", id=name, position={"x": x, "y": y}, **more)

    async def remove(self, name: str) -> list[str]:
        """Take an object away."""
        return await self.edit("remove", id=name)

    async def reset(self) -> list[str]:
        """Bring the first layout back."""
        return await self.edit("reset")

    async def objects(self) -> list[WorldObject]:
        """The truth: where everything is. What perceives must not use it."""
        return (await self._ear.now(topics.SCENE_OBJECTS)).objects


class Cell(Part):
    """One work cell. Inside `async with` it is joined; many programs may be in one cell at the same time.

    Attributes:
        owner: in whose name it is moved.
        arm: where it is, plans, motions, jogging.
        gripper: the fingers or cup.
        task: start, pause, resume, stop, and how far it is.
        param: parameters of the services by path.
        scene: solids that motion keeps away from though nobody perceives them.
        world: the simulated world.
        bus: what all of this stands on.
    """

    owner: str
    arm: Arm
    gripper: Gripper
    task: TaskControl
    param: Parameters
    scene: Scene
    world: World

    def __init__(
        self, name: str | None = None, *, domain: int | str | None = None, connect: str | None = None,
        secure: str | None = None, owner: str | None = None, application: str = "",
        remapped: Mapping[str, str] | None = None,
    ) -> None:
        """A cell that is up; nothing is done before `async with`.

        Args:
            name: of the cell; not needed while only one is up.
            domain: 0 to 232, as given to `--domain`; else ZENCELL_DOMAIN, or 42.
            connect: endpoint of its router, as tcp/192.168.1.10:7489; else ZENCELL_CONNECT.
            secure: folder of certificates, in which there is the operator's; else ZENCELL_SECURE.
            owner: in whose name it is moved; user and host if not given.
            application: dotted module of the cell's application, if it is one of your own.
            remapped: keys of the cell by the platform's words, where a cell has several arms: as `topics:` of a
                service in a cell file.

        Raises:
            ConfigError: nobody may be called like that owner.
        """
        self._where: dict[str, Any] = {"domain": domain, "connect": connect, "secure": secure, "remapped": remapped}
        self._name, self._application = name, application
        # Said now: who is to stop the arm must not learn only then that nobody may be called so.
        self._has(owner=check(StopRequest, {"owner": owner or person()}).owner)
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
        """A cell that is brought up when it is entered with `async with`, and ended when that is left.

        Args:
            cell: a name of `zencell cells`, or the path of a YAML file.
            speed: cell time per wall time, 0.1 to 10; 1 with a real arm.
            world: another one, by name or path.
            seed: of everything random.
            overrides: values of the cell, as of `--set`.
            autostart: whether its task begins by itself; else nothing moves until it is asked to.
            viewer: whether it has the operator's page.
            domain: 0 to 232; one that is free if not given.
            owner: in whose name it is moved; user and host if not given.
            application: dotted module of the cell's application, if it is one of your own.
        """
        made = cls(owner=owner, application=application)
        values = [*overrides, f"autostart={str(autostart).lower()}"]
        made._started = StartedCell(cell, speed=speed, world=world, seed=seed, overrides=values, viewer=viewer,
                                domain=domain)
        return made

    @classmethod
    def on(cls, bus: Bus, *, owner: str | None = None, application: str = "") -> Cell:
        """A cell that a bus is in already, which is not closed from here."""
        made = cls(bus.cell, owner=owner, application=application)
        made._take(bus)
        return made

    def _take(self, bus: Bus) -> None:
        self._bus, self._ear = bus, Subscriptions(bus)
        arm = Arm(self._ear, self.owner, self.tf)
        self._has(
            arm=arm, gripper=Gripper(self._ear, self.owner, arm),
            task=TaskControl(self._ear, self.owner, self._application), param=Parameters(bus),
            scene=Scene(self._ear, self.owner), world=World(bus, self._ear))

    async def __aenter__(self) -> Cell:
        if self._entered:
            raise ZencellError("the cell is joined already")
        async with contextlib.AsyncExitStack() as stack:
            if self._started is not None:
                up = await stack.enter_async_context(self._started)
                self._name, self._where = up.name, {**self._where, "domain": up.domain}
            if self._bus is None:
                bus = await stack.enter_async_context(joined(self._name, identity=OPERATOR, **self._where))
                bus.clock = await cell_clock(bus)
                self._take(bus)
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
        """Say why an attribute is not there yet.

        Raises:
            ZencellError: the cell is not joined.
            AttributeError: there is no such attribute at all.
        """
        if name in Cell.__annotations__:
            raise ZencellError(f"cell.{name}: the cell {NOT_JOINED}")
        raise AttributeError(f"a Cell has no {name!r}")

    @property
    def bus(self) -> Bus:
        """The program's place in the cell, for what is not here.

        Raises:
            ZencellError: it is not joined.
        """
        if self._bus is None:
            raise ZencellError(f"the cell {NOT_JOINED}")
        return self._bus

    @property
    def name(self) -> str:
        """Of the cell, the first part of all its keys."""
        return self.bus.cell

    async def services(self) -> SupervisorStatus:
        """All processes of the cell, its speed and seed, as its supervisor has them."""
        status = await supervisor_status(self.bus)
        if status is None:
            raise NothingReceived(f"{self.name}/{topics.SUPERVISOR_STATUS.key}")
        return status

    # --- what is seen ---------------------------------------------------------------------------------------------

    async def cameras(self) -> list[str]:
        """Names of its cameras."""
        return await cameras(self.bus)

    def camera(self, name: str = "") -> Camera:
        """A camera; its name may be left out where there is one. `await cell.camera().image()` looks it up, too.

        Raises:
            UnknownName: with the choices, when it is awaited or asked for anything.
        """
        _ = self.bus  # says so where the cell is not joined
        return Camera(name, self._ear, self.tf)

    async def planning_scene(self) -> PlanningScene:
        """What planners avoid: fixtures, what was perceived, and what persons added."""
        return await self._ear.now(topics.PLANNING_SCENE)

    async def objects(self, least: int = 0, *, timeout: float = TIMEOUT) -> list[CollisionObject]:
        """What was perceived: ids, shapes, dimensions [m], colours, and poses in world.

        Args:
            least: wait until so many are seen: just after a start nobody has looked yet.
            timeout: for so long [s, wall].

        Raises:
            NothingReceived: there are fewer.
        """
        reader, found = self._ear.reader(topics.PLANNING_SCENE), seen(await self.planning_scene())
        try:
            async with asyncio.timeout(timeout):
                while len(found) < least:
                    found = seen(await reader.next())
        except TimeoutError:
            missing = f"{self.name}/planning_scene with {least} objects, only with {len(found)}"
            raise NothingReceived(missing, timeout) from None
        return found

    async def tf(self, target: str, source: str) -> NDArray[np.float64]:
        """The pose (4, 4) of one frame in another, now: "world", "tcp", and those of `zencell tf frames`.

        Raises:
            UnknownName: a frame that nobody tells of; with the choices.
            NothingReceived: nobody tells of any, or of one that moves any more.
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

    async def _carried(self, key: str | Carried) -> Carried | None:
        if isinstance(key, Topic | Request):
            return key
        if not isinstance(key, str):
            raise ConfigError("key", key, "must be a key, or its Topic or Request")
        return find_topic(key) or await find_live_topic(self.bus, key)

    async def call(
        self, key: str | Request[Any, Any], message: Message | Mapping[str, Any] | None = None, *,
        timeout: float = TIMEOUT, **fields: Any,
    ) -> Any:
        """The answer to a request.

        Args:
            key: such as "motion/stop", or the `Request`.
            message: what is asked, or its fields.
            timeout: [s, wall].
            fields: of the message, when it is not given.

        Raises:
            UnknownName: there is no such request; with the choices.
            ConfigError: a field that does not fit.
            NoResponder, RemoteError, RequestLost, RequestTimeout: the four ways to no answer.
        """
        request = await self._carried(key)
        if not isinstance(request, Request):
            raise UnknownName("request", str(key), [n for n, each in all_topics().items() if isinstance(each, Request)])
        if not math.isfinite(timeout) or timeout <= 0:
            raise ConfigError("timeout", timeout, "must be more than 0")
        if not isinstance(message, Message | Mapping | None):
            raise ConfigError(request.key, message, f"must be a {request.message.__name__}, or its fields")
        asked = message if isinstance(message, Message) else check(
            request.message, {**(message or {}), **fields}, request.key)
        if isinstance(header := getattr(asked, "header", None), Header) and not header.stamp:
            asked = asked.model_copy(update={"header": self.bus.header(header.frame_id)})  # decided now
        return await self.bus.client(request).call(asked, timeout)

    async def listen(
        self, key: str | Topic[Any], *, plain: bool = False, timeout: float | None = None
    ) -> AsyncIterator[Any]:
        """Messages of a key from now on: of a stream or state the newest, of an event all.

        Args:
            key: such as "joint_states", or the `Topic`.
            plain: take any key, and what comes as it was packed: dictionaries, lists, numbers.
            timeout: for each message [s, wall]; else they are waited for without end, also once the cell has ended.

        Raises:
            UnknownName: no service of zencell writes it, and it is not asked for as `plain`; or it is no key; with
                the choices.
            ConfigError: it is a request.
            DecodeError: what came is not packed as messages are.
            NothingReceived: nothing came in time.
        """
        topic = None if plain else await self._carried(key)
        if plain:
            require_key(str(key))
        if topic is None and not plain:
            raise UnknownName("key", str(key), [name for name, t in all_topics().items() if isinstance(t, Topic)])
        if isinstance(topic, Request):
            raise ConfigError("key", topic.key, f"is a request: await cell.call({topic.key!r}, ...)")
        found = messages(self.bus, topic) if topic is not None else self._packed(f"{self.name}/{key}")
        async with contextlib.aclosing(found):
            while True:
                try:
                    async with asyncio.timeout(timeout):
                        message = await anext(found)
                except TimeoutError:
                    raise NothingReceived(f"{self.name}/{topic.key if topic else key}", timeout or 0.0) from None
                yield message

    async def _packed(self, key: str) -> AsyncGenerator[Any]:
        async for sample in self.bus.raw_reader(key):
            try:
                value = msgpack.unpackb(sample.payload, strict_map_key=False)
            except (ValueError, TypeError, RecursionError, msgpack.UnpackException):
                raise DecodeError(f"{key}: {len(sample.payload)} bytes came that are not msgpack") from None
            yield value
