"""Several simulated arms in one world: they share its objects, its long changes and its state file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import cast

from pydantic import BaseModel, Field

from common.config import GripperConfig
from common.errors import ConfigError
from common.sim.interface import PhysicalWorld, PhysicalWorldOfArms, SimulatedWorld, WorldOfGrippers
from common.sim.state_file import Saver, SimulationState, StateFile, matching_state


class ArmState(BaseModel):
    """Joints (dof,) [rad] and fingers [m] of one more arm."""

    q: list[float]
    width: float | None = None
    commanded_width: float | None = None
    commanded_effort: float = 0.0  # [N]


class SeveralArmsState(SimulationState):
    """State of a world with several arms: that of the first, and the other ones by name."""

    others: dict[str, ArmState] = Field(default_factory=dict)


def worlds_of(
    world: SimulatedWorld, simulator: str, grippers: Mapping[str, GripperConfig | None]
) -> dict[str, SimulatedWorld]:
    """Return the world as each arm meets it.

    Raises:
        ConfigError: the simulator is for one arm.
    """
    if isinstance(world, PhysicalWorldOfArms):
        return dict.fromkeys(grippers, world)
    if isinstance(world, PhysicalWorld) or not hasattr(world, "hand"):
        raise ConfigError("world.simulator", simulator, "simulates one arm, but the cell has several: use kinematic")
    shared = cast(WorldOfGrippers, world)
    return {arm: shared.hand(arm, gripper) for arm, gripper in grippers.items()}


def persisted_states(
    file: StateFile, simulator: str, world: SimulatedWorld, dofs: Mapping[str, int]
) -> dict[str, SimulationState | None]:
    """Return the persisted state of each arm, with the objects; None for all unless the world is still the same one."""
    first, *rest = dofs
    state = matching_state(file.load(), simulator, world, dofs[first])
    if not isinstance(state, SeveralArmsState) or set(state.others) != set(rest) or any(
            len(state.others[arm].q) != dofs[arm] for arm in rest):
        return dict.fromkeys(dofs)
    found: dict[str, SimulationState | None] = {first: state}
    for arm in rest:
        found[arm] = state.model_copy(update=vars(state.others[arm]))
    return found


class SharedSaver:
    """Combines the states of several arms into one file, so that grippers and held objects are of one moment."""

    def __init__(self, saver: Saver, arms: Sequence[str]) -> None:
        """Write to a saver once every arm has a state; the first arm is the one of the main fields."""
        self._saver, self._arms = saver, arms
        self._states: dict[str, SimulationState] = {}
        self._open = set(arms)

    def part(self, arm: str) -> SaverPart:
        """Return the saver of one arm."""
        return SaverPart(self, arm)

    def save(self, arm: str, state: SimulationState) -> None:
        """Take the state of an arm, and write that of all."""
        self._states[arm] = state
        first, *rest = self._arms
        if len(self._states) < len(self._arms):
            return
        others = {name: ArmState.model_construct(**{
            field: getattr(self._states[name], field) for field in ArmState.model_fields}) for name in rest}
        values = vars(self._states[first]) | {"objects": state.objects, "others": others}
        self._saver.save(SeveralArmsState.model_construct(**values))

    def close(self, arm: str) -> None:
        """Close the file with the last arm."""
        self._open.discard(arm)
        if not self._open:
            self._saver.close()


class SaverPart:
    """Saves the state of one arm."""

    def __init__(self, shared: SharedSaver, arm: str) -> None:
        """Save through the shared one."""
        self._shared, self._arm = shared, arm

    def save(self, state: SimulationState) -> None:
        """Write a state."""
        self._shared.save(self._arm, state)

    def close(self) -> None:
        """Close the part of this arm."""
        self._shared.close(self._arm)
