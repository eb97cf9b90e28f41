"""A resolved cell."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from common.config.basics import Section
from common.config.motion import Grasp, Motion, Pipeline, Run, Watchdogs
from common.config.robot import RobotConfig
from common.config.world import Scenery, Surroundings, World


class ServiceEntry(Section):
    """A process of the cell: its module and its parameters, which are checked by the service itself."""

    name: str = Field(description="unique in the cell: one module may run several times")
    module: str
    topics: dict[str, str] = Field({}, description="keys of the cell by the keys in its code")
    parameters: dict[str, Any] = {}

    @property
    def kind(self) -> str:
        """Last part of its module."""
        return self.module.rpartition(".")[2]

    @property
    def name_option(self) -> list[str]:
        """Command line option with its name, if that differs from its kind."""
        return [] if self.name == self.kind else ["--name", self.name]


class Members(Section):
    """All services of the cell, for services that monitor all of it."""

    services: list[str] = Field(description="in start order")
    task: str = Field(description="the service that runs the task")
    application: str = Field("", description="application: a name, or a dotted module")
    keys: list[dict[str, str]] = Field([], description="remapping tables: keys of the cell by the keys in the code")


class Reach(Section):
    """Parameters of all services: some of them define the reachable workspace."""

    parameters: dict[str, dict[str, Any]] = Field({}, description="parameters by service")


class Cell(Section):
    """A resolved cell: the complete configuration of its services."""

    run: Run
    robot: RobotConfig
    world: World
    motion: Motion = Motion()
    grasp: Grasp = Grasp()
    pipeline: Pipeline
    watchdogs: Watchdogs = Watchdogs()
    services: dict[str, ServiceEntry]
    task: str = Field(description="the service that runs the task and ends in DONE")
    application: str = Field(description="application: a name, or a dotted module")

    @property
    def name(self) -> str:
        """The first part of every key."""
        return self.run.cell

    def section(self, kind: type[Section], camera: str | None = None) -> Section:
        """Return the section of a type; surroundings are the world without its objects.

        Args:
            kind: the type.
            camera: name of the camera that becomes `camera` of the surroundings; by default the first.

        Raises:
            UnknownName: the world has no such camera.
        """
        if kind is Surroundings:
            around = {f: getattr(self.world, f) for f in Surroundings.model_fields}
            return Surroundings.model_validate(around | {"camera": self.world.camera_of(camera)})
        if kind is Scenery:
            return Scenery.model_validate({f: getattr(self.world, f) for f in Scenery.model_fields})
        if kind is Members:
            names = [entry.name for entry in self.services.values()]
            keys = [entry.topics for entry in self.services.values() if entry.topics]
            return Members(services=names, task=self.task, application=self.application, keys=keys)
        if kind is Reach:
            return Reach(parameters={name: entry.parameters for name, entry in self.services.items()})
        for value in (self.run, self.robot, self.world, self.motion, self.grasp, self.pipeline, self.watchdogs):
            if type(value) is kind:
                return value
        raise TypeError(f"{kind.__name__} is not a section of a cell")
