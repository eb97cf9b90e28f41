import sys
import types

import numpy as np
import pytest

from common.config import HardwareConfig, Parameters, RobotConfig
from common.errors import ConfigError, UnknownName
from common.hardware.interface import Limits, SimulatedGripper
from common.hardware.loading import backend_names, find_backend, is_simulated, load_hardware

START = np.array([0.1, -0.2])


def robot(backend: str, **options: object) -> RobotConfig:
    return RobotConfig(
        name="two", urdf="two.urdf", joints=["shoulder", "elbow"], base_link="base", tcp_link="tip",
        named_poses={"home": [0, 0]}, acceleration_limits=[1, 1], jerk_limits=[1, 1],
        gripper={"joints": ["finger"], "links": []},  # type: ignore[arg-type]
        hardware=HardwareConfig(backend=backend, options=options),
    )


@pytest.mark.parametrize("name", ["mock", "lag"])
def test_every_backend_starts_at_the_start_at_rest_and_goes_where_it_is_sent(limits: Limits, name: str) -> None:
    hardware = load_hardware(robot(name), limits, START)
    q, dq = hardware.read(5.0)
    assert np.array_equal(q, START) and not dq.any() and isinstance(hardware.gripper, SimulatedGripper)
    hardware.write(START + 1, np.ones(2), 5.0)
    assert np.allclose(hardware.read(6.0)[0], START + 1)
    hardware.close()


def test_backends_are_found_by_name() -> None:
    assert backend_names() == ["franka", "lag", "mock", "ur"]
    assert all(is_simulated(robot(name)) for name in ("lag", "mock"))


def test_unknown_backend_names_the_choices() -> None:
    with pytest.raises(UnknownName, match=r"'mok' \(did you mean 'mock'\?\); choices: franka, lag, mock, ur"):
        find_backend(robot("mok"))


@pytest.mark.parametrize("name", ["no.such.module", "common.control.trajectory_controller"])
def test_module_that_is_no_backend_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=r"robot\.hardware\.backend: "):
        find_backend(robot(name))


def test_backend_of_ones_own_is_a_dotted_module(limits: Limits, monkeypatch: pytest.MonkeyPatch) -> None:
    module = types.ModuleType("mine.arm")

    class Options(Parameters):
        port: int = 1

    module.Options, module.simulated = Options, False  # type: ignore[attr-defined]
    module.create = lambda robot, limits, start, options: (limits.names, options.port)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "mine", types.ModuleType("mine"))
    monkeypatch.setitem(sys.modules, "mine.arm", module)
    assert not find_backend(robot("mine.arm")).simulated
    made: object = load_hardware(robot("mine.arm", port=7), limits, START)
    assert made == (("shoulder", "elbow"), 7)


@pytest.mark.parametrize(("options", "field"), [({"time_constant": -1}, "time_constant"), ({"lag": 1}, "lag")])
def test_bad_option_is_refused_by_name(limits: Limits, options: dict[str, object], field: str) -> None:
    with pytest.raises(ConfigError, match=rf"robot\.hardware\.options\.{field}"):
        load_hardware(robot("lag", **options), limits, START)


def test_lag_is_first_order_whatever_the_steps(limits: Limits) -> None:
    for steps in (1, 7, 100):
        hardware = load_hardware(robot("lag", time_constant=0.1), limits, START)
        hardware.write(START + 1, START, 0.0)
        for t in np.linspace(0.0, 0.1, steps + 1):
            q, dq = hardware.read(float(t))
        assert np.allclose(q, START + 1 - np.exp(-1)) and np.allclose(dq, np.exp(-1) / 0.1)


# --- the arm of a simulated world -----------------------------------------------------------------------------------


def test_arm_of_a_world_takes_the_place_of_mock_alone(limits: Limits) -> None:
    arm: object = object()
    assert load_hardware(robot("mock"), limits, START, lambda: arm) is arm  # type: ignore[arg-type,return-value]
    with pytest.raises(ConfigError, match=r"'lag' moves the joints itself.*set mock here, or kinematic there"):
        load_hardware(robot("lag"), limits, START, lambda: arm)  # type: ignore[arg-type,return-value]


def test_world_in_the_place_of_a_backend_says_where_it_is_named() -> None:
    with pytest.raises(ConfigError, match=r"leave the backend at mock and set world\.simulator: mujoco in the cell"):
        find_backend(robot("mujoco"))
