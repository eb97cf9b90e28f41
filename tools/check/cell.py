"""Checks of a cell: its files within milliseconds, its robot with a model, and its services as they declare keys.

`RobotModel` itself checks joints, locked_joints, tcp_link, base_link and the limits of named poses.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import pickle
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from difflib import get_close_matches
from itertools import chain
from typing import TYPE_CHECKING, NamedTuple

from common.application import find_application
from common.config import Cell, GripperConfig, RobotConfig, ServiceEntry, Surroundings, located
from common.errors import ConfigError, ZencellError
from common.hardware.backends import has_simulated_world, real_arm
from common.messages import TaskStatus
from common.robot.finger_joints import driven_position
from common.robot.urdf import merged_urdf
from common.sim.generators import require_generator
from common.sim.interface import require_simulator
from common.supervision.launch import module_command
from common.supervision.wiring import WiringFailed, load_service, wire_service
from common.transport import ownership
from common.transport.ownership import SHARED, Owner
from tools.check import Finding, error, refusal, warning
from tools.check.signals import check_signals, require_valid_io

if TYPE_CHECKING:
    from common.robot.model import RobotModel


def blocking_errors(cell: Cell) -> list[Finding]:
    """Return errors of the robot file with which nothing may start; takes milliseconds.

    Errors that services find when they start are left out: parameters, joints and links of the robot, keys with two
    owners, and collisions at the home pose.
    """
    from tools.check.cell import check_robot_file

    try:
        found = (*check_arms(cell), *chain(*map(check_robot_file, _robots(cell))))
        return [each for each in found if each.refused]
    except ConfigError:  # a service reports it
        return []


def _robots(cell: Cell) -> list[RobotConfig]:
    return list(cell.robots.values()) or [cell.robot]


def require_safe(cell: Cell) -> None:
    """Return if the arm and its fingers would move correctly as far as the files show.

    Raises:
        ConfigError: they would not, with the finding of `zencell check`; or the simulator is not usable.
        UnknownName: the simulator does not exist.
    """
    if any(map(has_simulated_world, _robots(cell))):
        require_simulator(cell.world.simulator)
        require_generator(cell.world)
    for found in blocking_errors(cell):
        field, _, rest = found.line.partition(": ")
        raise ConfigError(field, ..., rest)


def require_valid_services(cell: Cell) -> None:
    """Validate parameters and remapped keys of services before any process starts.

    A service of the project without either has its defaults, and its imports would delay the start.

    Raises:
        ConfigError: names the field, the value and the choices, or a file that is missing on this host.
    """
    require_valid_io(cell)
    given = [entry for entry in cell.services.values()
             if entry.parameters or entry.topics or not entry.module.startswith("services.")]
    if not given:
        return
    for entry in given:
        with contextlib.suppress(WiringFailed):  # its process reports the error
            _require_usable(cell, entry)
            if entry.topics:
                wire_service(cell, entry)


def _require_usable(cell: Cell, entry: ServiceEntry) -> None:
    _, config = load_service(cell, entry)
    try:
        config.require_usable()
    except ConfigError as problem:
        raise located(problem, config, entry.name) from None


def require_task(cell: Cell) -> None:
    """Return if the cell has a task, and the services without which no task moves an arm.

    Args:
        cell: with its services on all hosts.

    Raises:
        ConfigError: it has none, or a service is missing.
    """
    if not cell.task:
        raise ConfigError("task", ..., f"is missing: {cell.name} has nothing to run; `zencell up` brings it up, and "
                          "clients can move its arm")
    if cell.task not in cell.services:
        raise ConfigError("services", ..., f"{cell.task}, the task of {cell.name}, is missing among them: "
                          f"{', '.join(cell.services) or 'there are none'}")
    if all(entry.module.startswith("services.") for entry in cell.services.values()):  # others may serve the same keys
        kinds = {entry.kind for entry in cell.services.values()}
        for kind in ("motion_planner", "trajectory_executor"):
            if kind not in kinds:
                raise ConfigError("services", ..., f"{kind} is missing among them: it is needed by {cell.task}")


def quick_warnings(cell: Cell) -> list[Finding]:
    """Return the findings of `check_files` with which the cell still starts."""
    return [found for found in check_files(cell) if not found.refused]


def check_files(cell: Cell) -> list[Finding]:
    """Return findings from the files; the robot model is loaded only for a camera on the arm."""
    from tools.check.cell import check_robot_file
    from tools.check.world import check_world

    of_robot = [*check_arms(cell), *_collect(lambda: chain(*map(check_robot_file, _robots(cell))))]
    try:
        seen = seen_from_home(cell)
    except ConfigError as problem:
        return [*of_robot, refusal(problem)]
    checks = find_application(cell.application).checks
    place = " from home" if cell.world.on_hand else ""
    return [*of_robot, *_collect(lambda: check_world(seen, find_application(cell.application), place)),
            *_of_application(checks.quick if checks else None, seen)]


def seen_from_home(cell: Cell, robot: RobotModel | None = None) -> Cell:
    """Return the cell with cameras on the arm fixed where they are at the home pose.

    Raises:
        ConfigError: the robot file does not fit its description, or has no such link.
    """
    if not cell.world.on_hand:
        return cell
    from common.perception.pinhole import cameras_at_home
    from common.robot.model import RobotModel

    return cell.model_copy(update={"world": cameras_at_home(cell.world, robot or RobotModel.load(cell.robot))})


def check_model(cell: Cell) -> Iterator[Finding]:
    """Yield findings that need the robot model; with several arms what one of them reaches is within reach."""
    each = [cell.of_arm(arm) for arm in cell.robots] or [cell]
    found = [list(_check_model(one)) for one in each]
    about = [{_subject(finding) for finding in findings} for findings in found]
    for number, findings in enumerate(found):
        for finding in findings:
            if finding.refused or all(_subject(finding) in others for others in about[number + 1:] + about[:number]):
                yield finding


def _subject(finding: Finding) -> str:
    return " ".join(finding.what.split()[:2])


def _check_model(cell: Cell) -> Iterator[Finding]:
    from tools.check.arm import Arm

    try:
        arm = Arm(cell.robot, cell.section(Surroundings))  # type: ignore[arg-type]
    except ConfigError as problem:
        yield refusal(problem)
        return
    yield from arm.check_poses()
    checks = find_application(cell.application).checks
    yield from _of_application(checks.reach if checks else None, seen_from_home(cell, arm.robot), arm)


def _of_application(check: Callable[..., Iterator[Finding]] | None, *args: object) -> list[Finding]:
    return _collect(lambda: check(*args)) if check is not None else []


def _collect(check: Callable[[], Iterator[Finding]]) -> list[Finding]:
    """Return the findings of a check; a configuration error that ends it is one more."""
    found: list[Finding] = []
    try:
        found.extend(check())
    except ConfigError as problem:
        found.append(refusal(problem))
    return found


# --- quick checks in a subprocess, whose imports, half a planner, are gone afterwards ---------------------------------


NICE = 10  # the services have priority


class QuickCheckFailed(ZencellError):
    """The subprocess failed."""


async def warnings_in_subprocess(cell: Cell, environ: Mapping[str, str]) -> list[Finding]:
    """Return `quick_warnings` of a cell, computed in a subprocess that ends with the call.

    Args:
        cell: as it was loaded.
        environ: of the subprocess.

    Raises:
        QuickCheckFailed: the subprocess failed; stderr has its output.
    """
    process = await asyncio.create_subprocess_exec(
        *module_command("tools.check.quick"), stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
        env=environ, start_new_session=True,  # so that it does not get Ctrl-C
    )
    try:
        output, _ = await process.communicate(pickle.dumps(sys.path) + pickle.dumps(cell))
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    if process.returncode:
        raise QuickCheckFailed(f"the quick check failed (exit code {process.returncode}); see `zencell check`")
    found: list[Finding] = pickle.loads(output)
    return found


TURNS, SLIDES = ("revolute", "continuous"), ("prismatic",)  # joint types
SLACK = 1e-3  # [m] or [rad] by which a finger position may exceed its limit: both files have rounded numbers


def check_arms(cell: Cell) -> Iterator[Finding]:
    """Yield an arm with two executors, or with none, and two arms that are one device."""
    executors = [entry for entry in cell.services.values() if entry.kind == EXECUTOR]
    if not cell.robots and len(executors) > 1:
        yield error(f"services.{executors[1].name}: is a second {EXECUTOR} besides {executors[0].name}, but a cell "
                    "with `robot` has one arm", "name the arms below `robots`: docs/two_arms.md", refused=True)
    driven: dict[str, str] = {}
    for entry in executors if cell.robots else ():
        for arm in [entry.arm] if entry.arm else [a for a, robot in cell.robots.items() if has_simulated_world(robot)]:
            if arm in driven:
                yield error(f"services.{entry.name}: drives {arm}, as {driven[arm]} does", "leave one of them out",
                            refused=True)
            driven[arm] = entry.name
    devices: dict[str, str] = {}
    for arm, robot in cell.robots.items():
        if executors and arm not in driven:
            yield error(f"robots.{arm}: no {EXECUTOR} drives it", f"add {arm}_executor: {{service: {EXECUTOR}, arm: "
                        f"{arm}}}", refused=True)
        if device := real_arm(robot):
            if device in devices:
                yield error(f"robots.{arm}.hardware: is {device}, which {devices[device]} is already",
                            "give each arm the address of its own controller", refused=True)
            devices[device] = arm


def check_robot_file(config: RobotConfig) -> Iterator[Finding]:
    """Yield contradictions between a robot file and its description.

    Raises:
        ConfigError: the description does not exist, or cannot be parsed.
    """
    gripper = config.gripper
    if gripper is None:
        return
    robot = ET.fromstring(merged_urdf(config))
    links = [link.get("name", "") for link in robot.findall("link")]
    joints = {joint.get("name", ""): joint for joint in robot.findall("joint")}
    for name in gripper.links:
        if name not in links:
            yield error(f"robot.gripper.links: {name!r} is no link of the description, so that the fingers may not "
                        "touch what they take", f"name links among {', '.join(links)}", refused=True)
    moving = [name for name, joint in joints.items() if joint.get("type") in (*TURNS, *SLIDES)]
    for number, name in enumerate(gripper.joints):
        if name not in moving:
            yield error(f"robot.gripper.joints: {name!r} is no joint of the description that moves",
                        f"name joints among {', '.join(moving)}", refused=True)
        elif name in config.joints:
            yield error(f"robot.gripper.joints: {name!r} is one of robot.joints, too: the arm would move as the "
                        "fingers close", "leave it in one of the two", refused=True)
        else:
            yield from _opening(gripper, number, joints[name])


def _opening(gripper: GripperConfig, number: int, joint: ET.Element) -> Iterator[Finding]:
    """Check that a finger's joint fits the conversion of widths to its positions."""
    name, turns = gripper.joints[number], joint.get("type") in TURNS
    angles = "linkage" if gripper.linkage is not None else "jaw" if gripper.jaw is not None else ""
    if gripper.travel:
        angles, positions = "travel", [row[number + 1] for row in gripper.travel]
    else:
        factor = gripper.mimic[number] if gripper.mimic else 1.0
        positions = [factor * driven_position(gripper, width) for width in (0.0, gripper.max_width)]
    if turns and not angles and number == 0:
        yield error(f"robot.gripper.joints: {name!r} turns ({joint.get('type')}), but without gripper.linkage half of "
                    "the width [m] is taken for its position [rad]", "give gripper.linkage: length, open_angle and "
                    "closed; or gripper.jaw, where the other finger is fixed", refused=True)
        return
    if not turns and angles not in ("", "travel") and number == 0:
        yield error(f"robot.gripper.joints: {name!r} slides ({joint.get('type')}), but gripper.{angles} gives angles "
                    "for it", f"leave gripper.{angles} out", refused=True)
        return
    if turns and not angles:
        return
    limit = joint.find("limit")
    if limit is None or joint.get("type") == "continuous":
        return
    low, high = (float(limit.get(side, "nan")) for side in ("lower", "upper"))
    unit = "rad" if turns else "m"
    if not (math.isnan(low) or math.isnan(high)) and (min(positions) < low - SLACK or max(positions) > high + SLACK):
        yield warning(f"robot.gripper: {name!r} would go from {min(positions):g} to {max(positions):g} {unit} between "
                      f"closed and open, its limits are {low:g} to {high:g}",
                      f"correct gripper.max_width, gripper.{angles or 'closed'} or gripper.mimic")


EXECUTOR = "trajectory_executor"
VIEWER = "viewer"  # shows any topics, so none is missing


def examine(cell: Cell) -> Iterator[Finding]:
    """Yield all findings of a cell, each once; the quick ones first."""
    known: set[str] = set()
    for found in (*check_files(cell), *check_signals(cell), *check_model(cell), *wiring(cell)):
        if not any(found.what.startswith(what) for what in known):  # a service may find the same
            known.add(found.what)
            yield found


def wiring(cell: Cell) -> Iterator[Finding]:
    """Yield configurations that services refuse, a missing task, and keys that do not match."""
    found, complete = [], True
    if cell.task and cell.task not in cell.services:
        yield error(f"task: {cell.task!r} is no service of the cell, so that a run never ends",
                    f"name one of {', '.join(cell.services)}")
    for entry in cell.services.values():
        try:
            _require_usable(cell, entry)
            each = wire_service(cell, entry)
        except ConfigError as problem:
            yield refusal(problem)
        except WiringFailed as problem:
            yield error(str(problem), "correct the service, or its parameters", refused=True)
        except ZencellError as problem:
            yield error(f"services.{entry.name}: {problem}", "correct it", refused=True)
        else:
            if entry.name == cell.task and not any(
                    issubclass(each.topics[key].message, TaskStatus) for key in each.writes):
                yield error(f"task: {cell.task} publishes no status of a task, so that a run never ends",
                            "name the service that does, or leave task out")
            reads = [key for key in each.reads if not getattr(each.topics[key], "commands", False)]  # of any client
            found.append(Keys(each.name, reads, each.writes, each.serves, each.calls, entry.kind == VIEWER))
            continue
        complete = False
    for finding in check_wiring(found):
        if complete or finding.severity == "error":  # keys of a refused service are unknown
            yield finding


PER_SERVICE = ("log", "counters", "param")  # first parts of keys that each service or the supervisor has


class Keys(NamedTuple):
    """Keys of a service in the cell."""

    service: str
    reads: Collection[str]
    writes: Collection[str]
    serves: Collection[str]
    calls: Collection[str]
    reads_any: bool = False  # a viewer, whose unwritten keys are no problem


def check_wiring(services: Sequence[Keys]) -> Iterator[Finding]:
    """Yield keys with two owners, and keys that are read or called but not written or served."""
    owners: dict[str, str] = {}
    reported: set[tuple[str, str]] = set()
    for each in services:
        for key in sorted({*each.writes, *each.serves} - {*SHARED}):
            first = owners.setdefault(key, each.service)
            if first != each.service and (first, each.service) not in reported:
                reported.add((first, each.service))
                said = ownership.refusal(Owner(key, key, each.service, each.service), Owner(key, key, first, first))
                what, _, remedy = said.partition(": ")
                yield error(f"services.{each.service}: {what}", remedy, refused=True)
    served = {key for each in services for key in each.serves}
    for each in services:
        if each.reads_any:
            continue
        for verb, done, keys in (("reads", "writes", {*each.reads} - {*owners, *SHARED}),
                                 ("calls", "serves", {*each.calls} - served)):
            for key in sorted(key for key in keys if key.partition("/")[0] not in PER_SERVICE):
                near = get_close_matches(key, owners, n=1)
                remedy = f"add the service that {done} it, or rename it with topics of services.{each.service}"
                yield warning(f"services.{each.service}: {verb} {key}, which no service of the cell {done}",
                              remedy + (f" (is it {near[0]}?)" if near else ""))
