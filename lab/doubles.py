"""A cell with doubles in the place of its perception and its planner: what decides and moves is as it is."""

from __future__ import annotations

from common.application import find_application
from common.config import Cell, ServiceEntry
from common.errors import ConfigError

PLANNER, PERCEPTION = "motion_planner", "perception"
PLANNER_DOUBLE = "lab.planner_double"
LEFT_OUT = ("robot_state_publisher", "viewer")  # nobody looks at frames where there are no pictures
# Control cycles are most of the work of a run; what holds in each of them is looked at all the same.
EXECUTOR, FEWER_CYCLES = "trajectory_executor", {"joint_state_rate": 25.0}  # [Hz]


def settings_of(application: str) -> tuple[str, ...]:
    """What its application sets in a cell with doubles, as of `--set`, before all that a person sets."""
    double = find_application(application).double
    return double.settings if double is not None else ()


def with_doubles(cell: Cell) -> Cell:
    """The cell with doubles.

    Raises:
        ConfigError: its application brings no double of its perception.
    """
    double = find_application(cell.application).double
    if double is None:
        raise ConfigError("--doubles", cell.application, "has no simulation double of its perception")
    services: dict[str, ServiceEntry] = {}
    for name, entry in cell.services.items():
        if entry.kind == PLANNER:
            services[name] = ServiceEntry(name=name, module=PLANNER_DOUBLE)
        elif entry.kind in double.replaces:
            services.setdefault(PERCEPTION, ServiceEntry(name=PERCEPTION, module=double.module))
        elif entry.kind == EXECUTOR:
            services[name] = entry.model_copy(update={"parameters": FEWER_CYCLES | entry.parameters})
        elif entry.kind not in LEFT_OUT:
            services[name] = entry
    return cell.model_copy(update={"services": services})


def is_double(entry: ServiceEntry) -> bool:
    """Whether a service stands for others, and may see the truth."""
    return entry.name == PERCEPTION
