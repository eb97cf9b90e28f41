"""Configuration: a cell file names a robot, a world, a pipeline and its services; every value has a unit and bounds.

`load_cell` resolves the names, applies `--set PATH=VALUE` overrides and validates the result. A service declares a
`Config` (a `Parameters`) with parameters, which are set under `services.<name>` of the cell, and sections of the cell,
which are recognised by their type. A service gets only what it declares: simulated hardware declares `World`, which has
the true poses of objects; all other services declare `Surroundings`.
"""

from __future__ import annotations

from common.config.basics import Coordinate, Length, Number, Parameters, Point, Rgb, Section, Tunable, check
from common.config.cell import (
    Arms,
    Cell,
    Cups,
    Grasp,
    Members,
    Motion,
    Pipeline,
    PlannerEntry,
    Reach,
    Run,
    ServiceEntry,
    Watchdogs,
)
from common.config.conveyors import Conveyor
from common.config.files import config_root, find_file, names_of, parse_yaml, read_robot, read_yaml
from common.config.io import Io, Signal
from common.config.loading import (
    OVERRIDES_VARIABLE,
    default_cell,
    expanded,
    load_cell,
    load_robot,
    located,
    parse_override,
    service_config,
    service_names,
    yaml_line,
)
from common.config.robot import (
    AttachmentConfig,
    FingerShape,
    GripperConfig,
    HardwareConfig,
    ParallelLinkage,
    PayloadConfig,
    RobotConfig,
    SuctionCup,
    TcpConfig,
    WrenchConfig,
)
from common.config.world import (
    CameraConfig,
    Container,
    Fixture,
    Generator,
    Light,
    ObjectConfig,
    Scenery,
    Surroundings,
    World,
)
