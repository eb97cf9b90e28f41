"""The simulated world behind the hardware seam: what the gripper meets and holds, edits, and persistence.

Real hardware does not return to its initial state when a driver restarts. So joints, gripper and objects are saved to a
file, which survives the process however it ends.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import struct
import threading
import zlib
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Protocol

import msgpack
import numpy as np
from numpy.typing import NDArray
from pydantic import AliasChoices, BaseModel, ConfigDict, Field

from common.atomic_file import Unreadable, open_regular, world_file
from common.config import Grasp, GripperConfig, World
from common.errors import ConfigError
from common.hardware.interface import (
    GripperReading,
    Hardware,
    PersistedState,
    PlaceableGripper,
    SimulatedGripper,
    Vector,
)
from common.hardware.mock import SimulatedFingers
from common.messages import ConveyorSet, ConveyorState, Header, SceneUpdate, WorldEdit, WorldEditReply, WorldObjects
from common.perception.pinhole import cameras_at_home
from common.robot.model import RobotModel
from common.scene.workspace import WorkspaceBounds, unreachable_reason
from common.sim.conveyors import Belts
from common.sim.generators import with_generated
from common.sim.interface import (
    KINEMATIC,
    GraspTolerances,
    GripperDrivenWorld,
    ObjectSnapshot,
    SimulatedWorld,
    load_world,
)
from common.sim.layout import layout

CONTACT = 1e-3  # [m] by which fingers may be wider than the object that they press on
WORLD_PERIOD = 0.05  # [s] cell time between reports of a moving object
REACH_MARGIN = 0.008  # [m] of random positions to the ends of the reach: a detected position is a few millimetres off


class Kinematics(Protocol):
    """Forward kinematics of the arm."""

    def fk(self, q: Vector) -> NDArray[np.float64]:
        """Return T_world_tcp (4, 4) at q (dof,) [rad]."""


class Saver(Protocol):
    """Where the state of the simulated hardware is written."""

    def save(self, state: SimulationState) -> None:
        """Write a state."""

    def close(self) -> None:
        """Write what is not written yet."""


def create_world(
    world: World, seed: int, robot: RobotModel, grasp: Grasp, bounds: WorkspaceBounds, tolerances: GraspTolerances,
    gripper: GripperConfig | None,
) -> SimulatedWorld:
    """Create the world with all its objects laid out; random positions are within reach of the robot.

    Raises:
        ConfigError: no layout was found, or the simulator or the generator of objects cannot be used.
    """
    world = with_generated(world, seed)
    seen = cameras_at_home(world, robot)
    objects = layout(seen, seed, lambda x, y, z: _within_reach(robot, (x, y, z), grasp, bounds))
    return load_world(world, objects, tolerances, gripper)


def _within_reach(
    robot: RobotModel, position: tuple[float, float, float], grasp: Grasp, bounds: WorkspaceBounds
) -> bool:
    """Return whether the arm can grasp at a position [m], and REACH_MARGIN nearer and farther."""
    x, y, z = position
    radius = max(math.hypot(x, y), REACH_MARGIN)
    scales = (1 + off / radius for off in (REACH_MARGIN, -REACH_MARGIN, 0.0))
    return all(not unreachable_reason(robot, (s * x, s * y, z), grasp, bounds, explained=False) for s in scales)


def matching_state(
    state: SimulationState | None, simulator: str, world: SimulatedWorld, dof: int
) -> SimulationState | None:
    """Return a persisted state if it is of this simulator, layout and robot; else None."""
    fits = state is not None and (
        state.simulator == simulator and state.layout == world.layout and len(state.q) == dof)
    return state if fits else None


class SimulatedCell:
    """A simulated world around simulated hardware: see `common.hardware.interface.WorldBackend`.

    Attributes:
        restored: whether objects and gripper were put where they were before a restart.
    """

    def __init__(
        self, world: SimulatedWorld, hardware: Hardware, kinematics: Kinematics | None, *,
        simulator: str = "kinematic", persisted: SimulationState | None = None, saver: Saver | None = None,
    ) -> None:
        """Surround this hardware; `persisted` is the state before a restart, which `restore` applies.

        Raises:
            ConfigError: the gripper cannot be blocked by objects.
        """
        self._world, self._kinematics, self._saver = world, kinematics, saver
        self._simulator, self._persisted = simulator, persisted
        self._felt = world if isinstance(world, GripperDrivenWorld) else None
        self._gripper = hardware.gripper
        self._blockable = self._gripper if isinstance(self._gripper, SimulatedGripper) else None
        if self._felt is not None and self._gripper is not None and self._blockable is None:
            raise ConfigError("robot.hardware.backend", type(hardware).__name__,
                              "is simulated: its gripper needs obstruct()")
        self._width = 0.0  # of the newest reading [m]
        self._published_version, self._published_at = -1, -math.inf  # cell time [s]
        self._saved: tuple[object, ...] = ()
        self._saved_objects: tuple[int, dict[str, ObjectSnapshot]] | None = None  # with the version of the world
        self.suspended = False
        self.defers_steps = False
        self.deferred: Callable[[], None] | None = None
        self.restored = False

    def obstruct(self, q: Vector) -> None:
        """Block the fingers of the arm at q (dof,) [rad] at what is between them."""
        if self._felt is not None and self._kinematics is not None and self._blockable is not None and (
            not self.suspended
        ):
            self._blockable.obstruct(self._felt.obstruction(self._kinematics.fk(q), self._width))
            if isinstance(self._blockable, SimulatedFingers):
                self._blockable.no_seal = getattr(self._felt, "no_seal", "")

    def step(self, now: float, q: Vector, gripper: GripperReading) -> None:
        """Advance to a cell time [s] with the arm at q (dof,) [rad]; defer a step that takes long."""
        self._width = gripper.width
        if self._felt is None or self._kinematics is None or self._blockable is None or self.suspended:
            return
        advance = partial(self._felt.tick, now, self._kinematics.fk(q), gripper.width, gripper.holding)
        takes_long = getattr(self._felt, "takes_long", None)
        if self.defers_steps and takes_long is not None and takes_long(gripper.width, gripper.holding):
            self.deferred, self.suspended = advance, True
        else:
            advance()

    def edit_takes_long(self, request: WorldEdit) -> bool:
        """Return whether an edit may take longer than a control cycle."""
        takes_long = getattr(self._world, "edit_takes_long", None)
        return takes_long is not None and bool(takes_long(request))

    def edit(self, request: WorldEdit, now: float) -> WorldEditReply:
        """Change the world.

        Raises:
            Refused: with the reason; nothing has changed then.
        """
        return WorldEditReply(id=self._world.edit(request, now), ids=self._world.ids)

    def updates(self, header: Header) -> tuple[list[SceneUpdate], WorldObjects | None]:
        """Return the events since the last call, and all objects if it is time to publish a change."""
        if self.suspended:
            return [], None
        events = [update.model_copy(update={"header": header}) for update in self._world.take_events()]
        now = header.stamp * 1e-9
        due = now - self._published_at >= WORLD_PERIOD or bool(events)
        if self._world.version == self._published_version or not due:
            return events, None
        self._published_version, self._published_at = self._world.version, now
        return events, self._world.objects(header)

    @property
    def _belts(self) -> Belts:
        belts = getattr(self._world, "belts", None)
        return belts if isinstance(belts, Belts) else Belts({})

    def set_conveyor(self, request: ConveyorSet, header: Header) -> ConveyorState:
        """Start or stop a belt, or change its speed; return the state of all belts.

        Raises:
            Refused: no such belt, or it is not that fast.
        """
        self._belts.set(request)
        return self._belts.state(header)

    def conveyors(self, header: Header, stopped: int) -> ConveyorState | None:
        """Return the state of all belts if it is to be published; `stopped` is the time of a STOP, or 0 [ns]."""
        self._belts.apply_stop(stopped)
        return self._belts.changed(header)

    def save(self, state: PersistedState) -> None:
        """Persist the world with arm and gripper, if something has changed."""
        if self._saver is None or self.suspended:
            return
        mark = (state.q.tobytes(), *state[1:], self._world.version)
        if mark == self._saved:
            return
        # Physics moves objects between its reports: gripper and held object must be saved as of one moment, or they
        # overlap when they are restored, and fly apart.
        if self._felt is None or self._saved_objects is None or self._saved_objects[0] != self._world.version:
            self._saved_objects = self._world.version, dict(self._world.snapshot())
        self._saved = mark
        self._saver.save(SimulationState.model_construct(  # copies nothing: equal objects are not written again
            simulator=self._simulator, layout=self._world.layout, q=state.q.tolist(), width=state.width,
            commanded_width=state.commanded_width, commanded_effort=state.commanded_effort,
            objects=self._saved_objects[1],
        ))

    def restore(self, stopped: bool) -> PersistedState | None:
        """Put objects and fingers where they were before a restart; return what the gripper is to continue.

        With `stopped`, fingers that press on nothing stay where they are. None when nothing was persisted.
        """
        state, gripper = self._persisted, self._gripper
        if state is None:
            return None
        self._world.restore(state.objects)
        self.restored = True
        if not isinstance(gripper, PlaceableGripper) or state.width is None:
            return None
        gripper.place(state.width)
        self._width, target = state.width, state.commanded_width
        q = np.array(state.q)
        if self._felt is not None and self._blockable is not None and self._kinematics is not None:
            between = self._felt.obstruction(self._kinematics.fk(q), state.width)
            self._blockable.obstruct(between)
            pressing = target is not None and target < state.width <= between + CONTACT
            if stopped and not pressing:  # pressing continues, moving does not
                target = state.width
        return PersistedState(q, state.width, target, state.commanded_effort)

    def close(self) -> None:
        """Write what is not persisted yet."""
        if self._saver is not None:
            self._saver.close()


SLOT = 4 * 1024 * 1024  # [bytes] for each of the two newest states
CLOSE_SECONDS = 0.3
_HEAD = struct.Struct("<QII")  # number of the state, its length and checksum


class SimulationState(BaseModel):
    """Joints (dof,) [rad], fingers [m] and objects at one moment; initial positions (x, y, z) [m].

    Details of objects are specific to the `simulator`.
    """

    model_config = ConfigDict(extra="forbid", populate_by_name=True)

    simulator: str = KINEMATIC
    layout: dict[str, tuple[float, ...]]
    q: list[float]
    width: float | None = None
    commanded_width: float | None = Field(None, validation_alias=AliasChoices("commanded_width", "told_width"))
    commanded_effort: float = Field(0.0, validation_alias=AliasChoices("commanded_effort", "told_effort"))  # [N]
    objects: dict[str, ObjectSnapshot] = {}


class StateFile:
    """Stores the newest state in a file with two alternating slots, of which one is always valid."""

    def __init__(self, path: Path) -> None:
        """Open the file, or create it.

        Raises:
            Unreadable: it cannot be opened, or is a symbolic link, which could point to a foreign file.
        """
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._descriptor = open_regular(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW)
        except OSError as error:
            raise Unreadable(path, "it is a link" if error.errno == errno.ELOOP else error.strerror or str(error)
                             ) from None
        self._number = 0
        self._packer = msgpack.Packer(default=vars)
        self._packed: dict[str, tuple[object, bytes]] = {}  # packed maps of the newest state, most of which stay equal

    def load(self) -> SimulationState | None:
        """Return the newest valid state, or None."""
        newest: SimulationState | None = None
        for place in (0, SLOT):
            head = os.pread(self._descriptor, _HEAD.size, place)
            if len(head) < _HEAD.size:
                continue
            number, length, checksum = _HEAD.unpack(head)
            body = os.pread(self._descriptor, min(length, SLOT), place + _HEAD.size)
            if number <= self._number or _checksum(number, body) != checksum:
                continue
            try:
                found = SimulationState.model_validate(msgpack.unpackb(body))
                if _finite(found.model_dump()):  # else positions would be undefined
                    newest, self._number = found, number
            except (ValueError, RecursionError):  # another version, or foreign data
                continue
        return newest

    def save(self, state: SimulationState) -> None:
        """Write a state; it survives this process immediately, but not a crash of the machine."""
        fields = vars(state)
        packed = [self._packer.pack(name) + self._pack(name, value) for name, value in fields.items()]
        body = self._packer.pack_map_header(len(fields)) + b"".join(packed)
        if _HEAD.size + len(body) > SLOT:  # it would overwrite the previous state
            return
        self._number += 1
        place = SLOT * (self._number % 2)
        os.pwrite(self._descriptor, _HEAD.pack(self._number, len(body), _checksum(self._number, body)) + body, place)

    def _pack(self, name: str, value: object) -> bytes:
        before, packed = self._packed.get(name, (None, b""))
        if value is not before or not isinstance(value, dict):
            packed = self._packer.pack(value)
            self._packed[name] = value, packed
        return packed

    def close(self) -> None:
        """Close the file."""
        os.close(self._descriptor)


class BackgroundSaver:
    """Saves the newest state on a thread: a slow disk blocks no caller."""

    def __init__(self, file: StateFile) -> None:
        """Save to this file."""
        self._file = file
        self._newest: SimulationState | None = None
        self._ends = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._work, name="state-file", daemon=True)
        self._thread.start()

    def save(self, state: SimulationState) -> None:
        """Save a state next; replaces one that is not written yet."""
        with self._changed:
            self._newest = state
            self._changed.notify()

    def close(self, seconds: float = CLOSE_SECONDS) -> None:
        """Close the file once everything is written; wait at most this long [s]."""
        with self._changed:
            self._ends = True
            self._changed.notify()
        self._thread.join(seconds)

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._newest is not None or self._ends)
                state, self._newest = self._newest, None
            if state is None:
                return self._file.close()
            with contextlib.suppress(OSError):  # a full disk must not stop the arm; the previous state stays
                self._file.save(state)


def _finite(value: object) -> bool:
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list | tuple) else None
    return all(map(_finite, parts)) if parts is not None else not isinstance(value, float) or math.isfinite(value)


def _checksum(number: int, body: bytes) -> int:
    """Checksum including the number: a state written over an older one must not become the newest by accident."""
    return zlib.crc32(body, zlib.crc32(number.to_bytes(8, "little")))


def state_file(cell: str, environ: Mapping[str, str] = os.environ) -> StateFile | None:
    """Return the state file of a cell, or None if no folder is configured."""
    path = world_file(cell, environ)
    return StateFile(path) if path else None
