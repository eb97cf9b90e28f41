from pathlib import Path

import pytest

from common.config import load_cell, service_config
from common.errors import ConfigError
from services.arm_coordinator import Config, coordinator_of

CELL = str(Path(__file__).parents[1] / "data" / "two_arms.yaml")


def config(*options: str) -> Config:
    return service_config(load_cell(CELL, list(options)), "arm_coordinator", Config)


def test_arms_of_a_cell_are_coordinated_by_their_names() -> None:
    coordinator, scenes = coordinator_of(config("services.arm_coordinator.clearance=0.05"), "arm_coordinator")
    assert list(coordinator.arms) == list(scenes.robots) == ["left", "right"]
    assert coordinator.options.clearance == 0.05


def test_arms_that_touch_at_home_are_one_clear_line() -> None:
    near = config("robots.right.base_position=[0.0, 0.2, 0.0]")
    with pytest.raises(ConfigError, match=r"^robots: .* closer than 0\.02 m at home: panda_\w+ and "):
        coordinator_of(near, "arm_coordinator")


def test_a_cell_with_one_robot_has_no_coordinator() -> None:
    one = load_cell("panda", ["services.arm_coordinator={}"])
    with pytest.raises(ConfigError, match=r"services\.arm_coordinator.* is for a cell with several robots"):
        coordinator_of(service_config(one, "arm_coordinator", Config), "arm_coordinator")
