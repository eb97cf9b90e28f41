"""Hardware backends by name: arms, grippers that go with any arm, and the arm of a simulated world."""

import sys
import types

import numpy as np
import pytest

from common.config import HardwareConfig, Parameters, RobotConfig, load_cell
from common.errors import ConfigError, UnknownName
from common.hardware import backends as loading
from common.hardware.driven_gripper import DrivenGripper
from common.hardware.driver_process import DriverProcess
from common.hardware.interface import Limits
from common.hardware.mock import SimulatedFingers

START = np.array([0.1, -0.2])


def robot(backend, gripper=None, **options):
    return RobotConfig(
        name="two", urdf="two.urdf", joints=["shoulder", "elbow"], base_link="base", tcp_link="tip",
        named_poses={"home": [0, 0]}, acceleration_limits=[1, 1], jerk_limits=[1, 1],
        gripper={"joints": ["finger"], "links": [], "hardware": gripper},
        hardware=HardwareConfig(backend=backend, options=options))


@pytest.fixture
def own(monkeypatch):
    """Backends of the user: an arm, which brings a gripper if its robot has one, and a gripper."""
    class Options(Parameters):
        port: int = 1

    arm, gripper = types.ModuleType("mine.arm"), types.ModuleType("mine.gripper")
    arm.Options, arm.simulated = Options, False
    arm.create = lambda robot, limits, start, options: types.SimpleNamespace(
        names=limits.names, port=options.port, gripper="its own" if robot.gripper else None)
    gripper.GripperOptions, gripper.create_gripper = Parameters, None
    for name, module in (("mine", types.ModuleType("mine")), ("mine.arm", arm), ("mine.gripper", gripper)):
        monkeypatch.setitem(sys.modules, name, module)
    return types.SimpleNamespace(arm=arm, gripper=gripper)


@pytest.fixture
def no_driver(monkeypatch):
    """Start no process of a driver."""
    monkeypatch.setattr(DriverProcess, "keep_running", lambda process: None)


# --- arms ---



def test_backends_are_found_by_name():
    assert loading.backend_names() == ["franka", "lag", "mock", "ur"]
    assert loading.gripper_backend_names() == ["franka_hand", "mock", "robotiq"]
    assert all(loading.is_simulated(robot(name)) for name in ("lag", "mock"))


def test_user_backend_is_a_dotted_module(limits, own):
    assert not loading.find_backend(robot("mine.arm")).simulated
    arm = loading.load_hardware(robot("mine.arm", port=7), limits, START)
    assert (arm.names, arm.port, arm.gripper) == (("shoulder", "elbow"), 7, "its own")
    assert loading.find_gripper_backend(HardwareConfig(backend="mine.gripper")) is own.gripper


@pytest.mark.parametrize(("name", "error"), [
    ("mok", r"'mok' \(did you mean 'mock'\?\); choices: franka, lag, mock, ur"),
    ("no.such.module", r"robot\.hardware\.backend: "), ("common.control.executor", r"robot\.hardware\.backend: "),
    ("mujoco", r"leave the backend at mock and set world\.simulator: mujoco in the cell"),
])
def test_unsuitable_backend_is_refused_with_the_choices(name, error):
    with pytest.raises((ConfigError, UnknownName), match=error):
        loading.find_backend(robot(name))


@pytest.mark.parametrize(("options", "field"), [({"time_constant": -1}, "time_constant"), ({"lag": 1}, "lag")])
def test_invalid_option_is_refused_by_name(limits, options, field):
    with pytest.raises(ConfigError, match=rf"robot\.hardware\.options\.{field}"):
        loading.load_hardware(robot("lag", **options), limits, START)


@pytest.mark.parametrize("steps", [1, 7, 100])
def test_lag_is_first_order_at_any_step(limits, steps):
    hardware = loading.load_hardware(robot("lag", time_constant=0.1), limits, START)
    hardware.write(START + 1, START, 0.0)
    for t in np.linspace(0.0, 0.1, steps + 1):
        q, dq = hardware.read(float(t))
    assert np.allclose(q, START + 1 - np.exp(-1)) and np.allclose(dq, np.exp(-1) / 0.1)


# --- grippers ---


@pytest.mark.parametrize("arm", ["mock", "lag", "mine.arm"])
@pytest.mark.parametrize(("gripper", "kind"), [
    ({"backend": "mock"}, SimulatedFingers), ({"backend": "franka_hand", "options": {"host": "h"}}, DrivenGripper),
    ({"backend": "robotiq", "options": {"host": "h", "model": "2f85"}}, DrivenGripper),
])
def test_any_gripper_goes_with_any_arm(limits, no_driver, own, arm, gripper, kind):
    assert isinstance(loading.load_hardware(robot(arm, gripper), limits, START).gripper, kind)


def test_arm_is_created_without_its_own_gripper_if_another_one_is_named(limits, monkeypatch):
    seen, lag = [], loading.find_backend(robot("lag"))
    create = lag.create
    monkeypatch.setattr(lag, "create", lambda robot, *args: (seen.append(robot.gripper), create(robot, *args))[1])
    loading.load_hardware(robot("lag"), limits, START)
    loading.load_hardware(robot("lag", {"backend": "mock"}), limits, START)
    assert [gripper is None for gripper in seen] == [False, True]


@pytest.mark.parametrize(("gripper", "error"), [
    ({"backend": "robotik"}, r"'robotik' \(did you mean 'robotiq'\?\); choices: franka_hand, mock, robotiq"),
    ({"backend": "no.such.module"}, r"robot\.gripper\.hardware\.backend: "),
    ({"backend": "common.hardware.pace"}, r"robot\.gripper\.hardware\.backend: .*it has no GripperOptions"),
    ({"backend": "robotiq", "options": {"host": "h", "model": "3f"}}, r"gripper\.hardware\.options\.model: '3f'"),
    ({"backend": "robotiq", "options": {"model": "2f85"}}, r"robot\.gripper\.hardware\.options\.host"),
])
def test_unsuitable_gripper_backend_is_refused_with_the_choices(limits, gripper, error):
    config = robot("mock", gripper)
    for refuse in (loading.has_simulated_world, lambda config: loading.load_hardware(config, limits, START)):
        with pytest.raises((ConfigError, UnknownName), match=error):
            refuse(config)


def test_ur_arm_brings_the_gripper_of_its_option(no_driver):
    pytest.importorskip("rtde_control", reason="make setup EXTRAS=ur")
    six = np.ones(6)
    limits = Limits(tuple("abcdef"), -6 * six, 6 * six, 3 * six, 5 * six, 10 * six, 500 * six)

    def load(gripper):
        options = (f"{name}={value}" for name, value in {
            "backend": "ur", "options.host": "127.0.0.9", "options.model": "ur5e", "options.gripper": gripper}.items())
        return loading.load_hardware(
            load_cell("ur5", [f"robot.hardware.{option}" for option in options]).robot, limits, limits.lower)

    assert isinstance(load("2f85").gripper, DrivenGripper)
    with pytest.raises(ConfigError, match=r"robot\.hardware\.options\.gripper: '3f'"):
        load("3f")


# --- the arm of a simulated world ---


def test_arm_of_a_world_replaces_only_mock(limits):
    arm = object()
    assert loading.load_hardware(robot("mock"), limits, START, lambda: arm) is arm
    for config, error in (
        (robot("lag"), r"'lag' moves the joints itself.*set mock here, or kinematic there"),
        (robot("mock", {"backend": "mock"}), r"robot\.gripper\.hardware\.backend: 'mock' moves the gripper, and so"),
    ):
        with pytest.raises(ConfigError, match=error):
            loading.load_hardware(config, limits, START, lambda: arm)
