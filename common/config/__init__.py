"""Configuration: a cell file names a robot, a world, a pipeline and its services; every value has a unit and bounds.

`load_cell` resolves the names, applies `--set PATH=VALUE` overrides and checks all of it. A service declares a
`Config` (a `Parameters`); its fields are either parameters, set under `services.<name>` of the cell, or sections of
the cell, which are recognised by their type and filled in. Only what a service declares reaches it: `World` (where
things really lie) is declared by the simulated hardware alone, everything else takes `Surroundings`.
"""

from __future__ import annotations

from common.config.basics import Coordinate, Length, Number, Parameters, Point, Rgb, Section, Tunable
from common.config.cell import Cell, Members, Reach, ServiceEntry
from common.config.checking import check
from common.config.files import config_root, find_file, names_of, parse_yaml, read_robot, read_yaml
from common.config.light import Light
from common.config.loading import load_cell, load_robot, service_config, service_names
from common.config.motion import Grasp, Motion, Pipeline, PlannerEntry, Run, Watchdogs
from common.config.overrides import expanded, parse_override, yaml_line
from common.config.robot import (
    AttachmentConfig,
    FingerShape,
    GripperConfig,
    HardwareConfig,
    ParallelLinkage,
    RobotConfig,
    SuctionCup,
    TcpConfig,
)
from common.config.world import CameraConfig, Container, Fixture, ObjectConfig, Scenery, Surroundings, World
