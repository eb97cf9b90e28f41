"""Executors of the arms that one process hosts: one arm, or all simulated arms of a cell around one world."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Protocol

import numpy as np

from common.config import Arms, Grasp, Reach, RobotConfig, Run, World
from common.control.executor import Executor
from common.control.force_requests import ForceLimits
from common.control.force_sensing import ForceSensing
from common.control.interlocks import InterlockStore
from common.control.trajectory import Tolerances
from common.control.vacuum import VacuumCup
from common.control.wrench import Payload
from common.errors import ConfigError
from common.hardware.backends import has_simulated_world, load_hardware
from common.hardware.interface import ControlledArm, Hardware, Limits, Vector
from common.robot.model import RobotModel
from common.robot.tool_mass import described_tool
from common.scene.workspace import configured_bounds
from common.sim.interface import GraspTolerances, PhysicalWorld, PhysicalWorldOfArms, SimulatedWorld
from common.sim.several_arms import SeveralArmsState, SharedSaver, persisted_states, worlds_of
from common.sim.simulated_cell import SimulatedCell, create_world
from common.sim.state_file import Saver, SimulationState, StateFile, matching_state, state_file
from common.transport.bus import Bus


class ExecutorConfig(Protocol):
    """What executors are created from."""

    robot: RobotConfig
    arms: Arms
    world: World
    run: Run
    grasp: Grasp
    reach: Reach
    tolerances: Tolerances
    grasp_tolerances: GraspTolerances


def hosted_arms(config: ExecutorConfig, service: str) -> dict[str, RobotConfig]:
    """Return the robots that the process of an executor hosts by arm; the name is empty in a cell with one robot.

    Raises:
        ConfigError: a real arm needs a process of its own, or a simulated one must share that of the others.
    """
    arms = config.arms
    if not arms.robots:
        return {"": config.robot}
    simulated = {arm: robot for arm, robot in arms.robots.items() if has_simulated_world(robot)}
    if not arms.own:
        if not simulated:
            raise ConfigError(f"services.{service}", ..., "hosts simulated arms, and all arms of the cell are real: "
                              "add `each: arm`, so that each has a process of its own")
        return simulated
    if arms.own in simulated and len(simulated) > 1:
        raise ConfigError(f"services.{service}", ..., f"is for {arms.own} alone, but the simulated arms "
                          f"{', '.join(simulated)} share one world: list trajectory_executor once, without `each` and "
                          "`arm`")
    return {arms.own: config.robot}


def create_executors(
    bus: Bus, config: ExecutorConfig, robots: Mapping[str, RobotConfig], stores: Mapping[str, InterlockStore],
    simulated: bool, period: float, saver_for: Callable[[StateFile], Saver],
) -> dict[str, Executor]:
    """Create the executors with their hardware at the home poses and, when simulated, all objects laid out.

    Cycles are `period` of wall time [s] apart. Simulated hardware starts where it was before a restart, if that was
    in the same world.
    """
    models = {arm: RobotModel.load(robot) for arm, robot in robots.items()}
    starts = {arm: model.named("home") for arm, model in models.items()}
    worlds: Mapping[str, SimulatedWorld | None] = dict.fromkeys(robots)
    persisted: Mapping[str, SimulationState | None] = dict.fromkeys(robots)
    savers: Mapping[str, Saver | None] = dict.fromkeys(robots)
    if simulated:
        bounds = [(model, configured_bounds(config.reach.of(arm))) for arm, model in models.items()]
        (first, own), *others = bounds
        world = create_world(config.world, config.run.seed, first, config.grasp, own, config.grasp_tolerances,
                             first.config.gripper, others)
        file = state_file(bus.cell, model=SeveralArmsState if others else SimulationState)
        persisted, savers = _persistence(config, world, models, file, saver_for)
        worlds = dict.fromkeys(robots, world) if not others else worlds_of(
            world, config.world.simulator, {arm: robot.gripper for arm, robot in robots.items()})
        starts |= {arm: np.array(state.q) for arm, state in persisted.items() if state is not None}
    found: dict[str, Executor] = {}
    first_cell: SimulatedCell | None = None
    for arm, model in models.items():
        within, limits, start = worlds[arm], _limits(model), starts[arm]
        hardware = load_hardware(
            model.config, limits, start, _arm_of(within, arm if len(models) > 1 else "", model, limits, start))
        if isinstance(hardware, ControlledArm) and bus.clock.speed != 1.0:
            hardware.close()
            raise ConfigError("speed", bus.clock.speed, "must be 1: the arm has a controller with a clock of its own")
        gripper, vacuum = model.config.gripper, None
        if gripper is not None and gripper.vacuum is not None:
            vacuum = VacuumCup(gripper, hardware.gripper)
            hardware.gripper = hardware.gripper or vacuum
        cell = None if within is None else SimulatedCell(
            within, hardware, model, simulator=config.world.simulator, persisted=persisted[arm], saver=savers[arm],
            first=first_cell, reports=arm == [*models][-1])
        first_cell = first_cell or cell
        tool = described_tool(model)
        force = ForceSensing(hardware, model, model.config.tcp_link, model.config.gripper, model.config.wrench,
                             Payload(tool[0], *tool[1].tolist()) if tool is not None else None)
        found[arm] = Executor(
            hardware, limits, start, tolerances=config.tolerances, gripper=gripper, vacuum=vacuum,
            controller=model.config.controller, kinematics=model, world=cell, interlocks=stores[arm].interlocks,
            force=force, period=period * bus.clock.speed,
            force_limits=ForceLimits(model.config.force_limit, model.config.torque_limit),
        )
    for executor in found.values():
        executor.restore(bus.clock.now())
    return found


def _persistence(
    config: ExecutorConfig, world: SimulatedWorld, models: Mapping[str, RobotModel], file: StateFile | None,
    saver_for: Callable[[StateFile], Saver],
) -> tuple[dict[str, SimulationState | None], Mapping[str, Saver | None]]:
    """Return the persisted state and the saver of each arm."""
    if file is None:
        return dict.fromkeys(models), dict.fromkeys(models)
    if len(models) == 1:
        (arm, model), = models.items()
        return {arm: matching_state(file.load(), config.world.simulator, world, model.dof)}, {arm: saver_for(file)}
    states = persisted_states(file, config.world.simulator, world, {arm: model.dof for arm, model in models.items()})
    shared = SharedSaver(saver_for(file), list(models))
    return states, {arm: shared.part(arm) for arm in models}


def _limits(robot: RobotModel) -> Limits:
    braking = robot.config.deceleration_limits
    return Limits(tuple(robot.joint_names), robot.lower, robot.upper, robot.velocity, robot.acceleration,
                  np.array(braking) if braking else None, robot.jerk)


def _arm_of(
    world: SimulatedWorld | None, arm: str, robot: RobotModel, limits: Limits, start: Vector
) -> Callable[[], Hardware] | None:
    """Return what creates the arm of a physical world, or of one with several arms; None: the backend creates it."""
    if isinstance(world, PhysicalWorldOfArms) and arm:
        return partial(world.arm, arm, robot, limits, start)
    return partial(world.hardware, robot, limits, start) if isinstance(world, PhysicalWorld) else None
