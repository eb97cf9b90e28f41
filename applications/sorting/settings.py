"""Parameters of the sorting task, its input, and what it remembers over a restart."""

from __future__ import annotations

from dataclasses import dataclass

from pydantic import BaseModel, Field, model_validator

from applications.sorting.choice import Failure
from applications.sorting.contents import Contents
from applications.sorting.places import require_tray
from applications.sorting.rules import Rule
from applications.sorting.topics import GraspCandidate, Heap, SeenObject
from common.config import Surroundings, Tunable
from common.errors import ConfigError
from common.tasks.decisions import TaskConfig
from common.tasks.stages import View


class Config(TaskConfig):
    """The rule, and when an object is given up; times are cell time unless they say wall."""

    world: Surroundings
    tray: str = Field("tray", description="id of the container that objects are taken from")
    by: str = Field("color", description="color, size, shape, or module:function of yours, which gets a SeenObject and "
                                         "returns the id of a container")
    where: dict[str, str] = Field({}, description="container by color, size or shape; '*' for all others")
    large: float = Field(0.06, gt=0, le=1, description="an object this long or longer is large [m]")
    frame_timeout: Tunable[float] = Field(
        3.0, ge=0.1, le=60, description="an older picture starts no motion [s, wall time]")
    obstacle_patience: Tunable[float] = Field(
        3.0, ge=0, le=3600, description="a motion that a foreign body blocks for longer is planned again [s]")
    penalty: Tunable[float] = Field(60.0, ge=0, le=3600, description="a place where a grasp failed is avoided for [s]")
    most_tries: Tunable[int] = Field(4, ge=1, le=100, description="failed grasps of an object until it is left")
    most_stirs: Tunable[int] = Field(3, ge=0, le=20, description="pushes through the heap, in a row, if nothing can be "
                                                                 "grasped")
    width_tolerance: Tunable[float] = Field(
        0.015, gt=0, le=0.1, description="what is held may be so much wider or narrower than it was seen [m]")
    carrying: Tunable[float] = Field(
        0.25, gt=0, le=1, description="fraction of the joints' acceleration limits while an object is held")
    check_patience: Tunable[float] = Field(
        1.0, ge=0, le=60, description="wait for a picture of the tray before an object is released [s]")
    empty: Tunable[float] = Field(1.0, ge=0, le=600, description="the tray must look empty for so long [s]")
    give_up: Tunable[float] = Field(4.0, ge=0, le=600, description="for so long nothing must be graspable before the "
                                                                   "heap is stirred or the task ends [s]")

    @model_validator(mode="after")
    def _require_rule(self) -> Config:
        try:
            self.rule()
        except ConfigError as error:
            raise ValueError(str(error)) from None
        return self

    def rule(self) -> Rule:
        """Return the rule.

        Raises:
            ConfigError: the tray, a value or a container is unknown.
        """
        require_tray(self.world, self.tray, "tray")
        others = [name for name in self.world.containers if name != self.tray]
        return Rule(self.by, self.where, others, self.large)


@dataclass
class SortingView(View):
    """What the task knows: in addition what the cameras see."""

    heap: Heap | None = None


class Memory(BaseModel):
    """What a restarted task cannot see: counters, failed places, and where the held object goes."""

    attempts: int = 0
    done: int = 0
    seconds: float = 0.0  # [s] of work until the last one was done
    sorted: dict[str, int] = {}
    outcomes: dict[str, int] = {}
    failures: list[Failure] = []
    thing: SeenObject | None = None
    grasp: GraspCandidate | None = None
    before: list[SeenObject] = []  # objects in the tray when the grasp was chosen
    checked: bool = False  # whether what is held is known
    container: str = ""
    back: bool = False
    inside: int = 0  # objects seen in that container before
    left: int = 0  # objects seen outside of the containers before
    stirs: int = 0
    wider: str = ""  # by how much the fingers are wider apart than expected
    doubt: str = ""  # why two objects may be in the container, until an image shows it
    contents: dict[str, Contents] = {}
    two_at_once: int = 0  # objects that arrived in a container in addition to those that were released
    arrivals: list[str] = []  # what images showed of them
