"""Operates a cell by a device: jogging, gripper, stop and home, with a line that shows the state."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Coroutine, Sequence
from typing import Any, get_args

from common import topics
from common.client.cell import Cell
from common.client.operator_motion import MotionFailed
from common.errors import RequestFailed, ZencellError
from common.messages import GripperCommand
from common.messages.execution import JogFrame
from common.supervision.lifecycle import run_with_background
from common.time_source import monotonic, new_id
from tools.teleoperation.devices import REST, Action, Device
from tools.teleoperation.jogging import JogSender

PERIOD = 0.02  # [s] between two readings of the devices
SHOW_PERIOD = 0.2  # [s]
FASTER, SLOWEST = 1.25, 0.02  # factor, and least share, of the speed
FRAMES: tuple[JogFrame, ...] = get_args(JogFrame)
CONTROL = "/control"  # end of the key by which an operator takes over from a task
OPEN = 0.5  # share of the largest width, above which the gripper counts as open

Show = Callable[[str], None]


class Operation:
    """One operator at the devices. The first device that requests a motion moves the arm."""

    def __init__(self, cell: Cell, devices: Sequence[Device], *, frame: JogFrame, speed: float, show: Show) -> None:
        """Operate a joined cell.

        Args:
            cell: joined.
            devices: read in this order.
            frame: whose axes the devices move along.
            speed: share of 0.25 m/s and 1 rad/s.
            show: called with a line that replaces the one before.
        """
        self.cell, self.message, self._where = cell, "", ""
        self._devices, self._show = devices, show
        self._jog = JogSender(cell, frame, speed)
        self._requests, self._motions = set[asyncio.Task[None]](), set[asyncio.Task[None]]()
        self._quit = asyncio.Event()
        self.in_control = False  # instead of the task
        self._must_release = False  # until then the devices do not move the arm

    def act(self, action: Action) -> None:
        """Carry out an action; requests are sent in the background."""
        match action:
            case "quit":
                self._quit.set()
            case "stop":
                self._stop_all()
            case "faster":
                self._jog.speed = min(self._jog.speed * FASTER, 1.0)
            case "slower":
                self._jog.speed = max(self._jog.speed / FASTER, SLOWEST)
            case "frame":
                self._jog.frame = FRAMES[(FRAMES.index(self._jog.frame) + 1) % len(FRAMES)]
            case "gripper":
                self.start("gripper", self._toggle_gripper(), moves=False)
            case "control":
                self.start("control", self._toggle_control(), moves=False)
            case "home":
                self.start("home", self.go_home())

    def describe(self) -> str:
        """Return what else to show in the line."""
        return ""

    async def run(self) -> None:
        """Operate until the operator quits. At the end the arm is at rest.

        Raises:
            DeviceLost: a device was unplugged.
        """
        try:
            await run_with_background(self._follow_pose(), run_with_background(self._show_state(), self._operate()))
        finally:
            self._jog.release()
            self._cancel_motions()
            await asyncio.gather(*self._requests, return_exceptions=True)
            self._show("")

    async def _operate(self) -> None:
        while not self._quit.is_set():
            self.step(monotonic())
            await asyncio.sleep(PERIOD)

    def step(self, now: float) -> None:
        """Read the devices once at a monotonic time [s], and send what they request.

        Raises:
            DeviceLost: a device was unplugged; the motion was ended.
        """
        try:
            readings = [device.read(now) for device in self._devices]
        except ZencellError:
            self._jog.release()
            raise
        for reading in readings:
            for action in reading.actions:
                self.act(action)
        axes = next((each.axes for each in readings if each.axes != REST), REST)
        for task in [each for each in self._requests if each.done()]:
            self._requests.discard(task)
            self._motions.discard(task)
            if not task.cancelled():
                task.result()
        self._must_release = axes != REST and (self._must_release or bool(self._motions))
        before = self._jog.problem
        self._jog.update(REST if self._must_release else axes, now)
        if self._jog.following:
            self.message = ""
        elif self._jog.problem not in ("", before):
            self.message = self._jog.problem

    def start(self, name: str, request: Coroutine[Any, Any, None], *, moves: bool = True) -> None:
        """Send a request in the background unless another one is under way.

        While one that `moves` is under way, the device moves nothing. A STOP, and the end of the operation, cancel it.
        """
        if self._requests:
            request.close()
            self.message = "wait for the motion to end, or stop it"
            return
        self.message = f"{name} ..."
        self._spawn(self._reported(request), moves=moves)

    def _spawn(self, request: Coroutine[Any, Any, None], *, moves: bool) -> None:
        task = asyncio.create_task(request)
        self._requests.add(task)
        if moves:
            self._motions.add(task)

    def _cancel_motions(self) -> None:
        """Cancel the motions that were requested: their requester then stops them."""
        for task in self._motions:
            task.cancel()

    async def _reported(self, request: Coroutine[Any, Any, None]) -> None:
        try:
            await request
            self.message = ""
        except ZencellError as error:
            self.message = str(error)

    def _stop_all(self) -> None:
        self._must_release = True
        self._cancel_motions()
        self._spawn(self._stop(), moves=False)

    async def _stop(self) -> None:
        try:
            await self.cell.arm.stop("stopped by the operator's device")
            self.message = "STOPPED: the next motion of yours releases it"
        except RequestFailed as error:
            self.message = f"NOT STOPPED: {error}"

    async def _toggle_gripper(self) -> None:
        """Close the fingers, or open them; return when the executor has accepted that, so that jogging continues.

        The executor checks the owner of motion: the arm of a task that gave control to an operator has none.
        """
        description = await self.cell.arm.description()
        if not description.gripper:
            raise MotionFailed("no_gripper", "the robot of this cell has no gripper")
        state = await self.cell.gripper.state()
        width = 0.0 if state.width > OPEN * description.gripper_width else description.gripper_width
        reply = await self.cell.call(topics.GRIPPER_COMMAND, GripperCommand(
            header=self.cell.bus.header(), id=f"gripper-{new_id()}", owner=self.cell.owner, width=width,
            acknowledged=(await self.cell.arm.status()).newest))
        if reply.state == "rejected":
            raise MotionFailed(reply.error, f"the gripper rejected the command: {reply.message}")

    async def _toggle_control(self) -> None:
        """Take the arm from the task of the cell, or give it back; the application serves a request for that."""
        keys = [owner.key for owner in await self.cell.bus.owners() if owner.key.endswith(CONTROL)]
        if not keys:
            raise MotionFailed("no_control", "no task of this cell hands its control over: stop the task instead")
        reply = await self.cell.call(keys[0], take=not self.in_control, owner=self.cell.owner)
        self.in_control = reply.control == "operator" and reply.operator == self.cell.owner

    async def go_home(self) -> None:
        """Move the arm to its home pose by a planned motion."""
        await self.cell.arm.move("home")

    async def _follow_pose(self) -> None:
        while True:
            with contextlib.suppress(ZencellError):
                x, y, z = (await self.cell.arm.pose())[:3, 3]
                self._where = f"tcp {x:.3f} {y:.3f} {z:.3f} m  "
            await asyncio.sleep(SHOW_PERIOD)

    async def _show_state(self) -> None:
        while True:
            control = "IN CONTROL, p: give back  " if self.in_control else ""
            self._show(f"{self._where}{control}speed {100 * self._jog.speed:.0f} % in {self._jog.frame}  "
                       f"{self.describe()}{self.message and f'| {self.message}'}")
            await asyncio.sleep(SHOW_PERIOD)
