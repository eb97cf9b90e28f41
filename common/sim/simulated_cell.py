"""The simulated world behind the hardware seam: what the gripper meets and holds, edits, and persistence.

Real hardware does not return to its initial state when a driver restarts. So joints, gripper and objects are saved to a
file, which survives the process however it ends.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

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
    GraspTolerances,
    GripperDrivenWorld,
    ObjectSnapshot,
    SimulatedWorld,
    load_world,
)
from common.sim.layout import layout
from common.sim.state_file import Saver, SimulationState

CONTACT = 1e-3  # [m] by which fingers may be wider than the object that they press on
WORLD_PERIOD = 0.05  # [s] cell time between reports of a moving object
REACH_MARGIN = 0.008  # [m] of random positions to the ends of the reach: a detected position is a few millimetres off


class Kinematics(Protocol):
    """Forward kinematics of the arm."""

    def fk(self, q: Vector) -> NDArray[np.float64]:
        """Return T_world_tcp (4, 4) at q (dof,) [rad]."""


def create_world(
    world: World, seed: int, robot: RobotModel, grasp: Grasp, bounds: WorkspaceBounds, tolerances: GraspTolerances,
    gripper: GripperConfig | None, others: Sequence[tuple[RobotModel, WorkspaceBounds]] = (),
) -> SimulatedWorld:
    """Create the world with all its objects laid out; random positions are within reach of the robot, or of `others`.

    Raises:
        ConfigError: no layout was found, or the simulator or the generator of objects cannot be used.
    """
    world = with_generated(world, seed)
    seen = cameras_at_home(world, robot)
    objects = layout(seen, seed, lambda x, y, z: any(
        _within_reach(each, (x, y, z), grasp, within) for each, within in ((robot, bounds), *others)))
    return load_world(world, objects, tolerances, gripper)


def _within_reach(
    robot: RobotModel, position: tuple[float, float, float], grasp: Grasp, bounds: WorkspaceBounds
) -> bool:
    """Return whether the arm can grasp at a position [m], and REACH_MARGIN nearer and farther."""
    (x, y, z), (x0, y0, _) = position, robot.config.base_position
    radius = max(math.hypot(x - x0, y - y0), REACH_MARGIN)
    scales = (1 + off / radius for off in (REACH_MARGIN, -REACH_MARGIN, 0.0))
    return all(not unreachable_reason(robot, (x0 + s * (x - x0), y0 + s * (y - y0), z), grasp, bounds, explained=False)
               for s in scales)


class SimulatedCell:
    """A simulated world around simulated hardware: see `common.hardware.interface.WorldBackend`.

    Attributes:
        restored: whether objects and gripper were put where they were before a restart.
    """

    def __init__(
        self, world: SimulatedWorld, hardware: Hardware, kinematics: Kinematics | None, *,
        simulator: str = "kinematic", persisted: SimulationState | None = None, saver: Saver | None = None,
        first: SimulatedCell | None = None, reports: bool = True,
    ) -> None:
        """Surround this hardware.

        Args:
            world: the objects.
            hardware: the arm with its gripper.
            kinematics: of the arm.
            simulator: name of the simulator.
            persisted: the state before a restart, which `restore` applies.
            saver: of the state.
            first: that of the first arm, if this is a further one in the same world.
            reports: whether it reports the objects: the last arm does, once all have moved what they hold.

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
        self._first, self._reports = first, reports
        self._suspended = False
        self.defers_steps = False
        self.deferred: Callable[[], None] | None = None
        self.restored = False

    @property
    def suspended(self) -> bool:
        """Whether a long change of the world is in progress, which all arms wait for."""
        return self._suspended if self._first is None else self._first.suspended

    @suspended.setter
    def suspended(self, value: bool) -> None:
        if self._first is None:
            self._suspended = value
        else:
            self._first.suspended = value

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
        if self.suspended or not self._reports:
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
        if self.suspended or not self._reports:
            return None
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
