"""Observers of a simulated cell: a hardware backend that shows every set-point, and a recording of every message."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from common import topics
from common.config import Cell, HardwareConfig, Parameters, RobotConfig
from common.errors import ConfigError
from common.hardware.backends import find_backend, load_hardware
from common.hardware.interface import Gripper, Hardware, Limits, SensingArm, Vector
from common.messages import SupervisorStatus
from common.transport.codec import decode, decode_attachment
from common.transport.reader import SequenceFilter
from common.transport.session import RawSample
from recording.capture import CustomTopics
from recording.sample import Sample, message_of
from recording.writer import RUN, RecordingWriter, run_of

simulated = True  # this module is a hardware backend
# limits, measured q, commanded q [rad], dq, cell time [s], name of the arm
OnSetPoint = Callable[[Limits, Vector, Vector, Vector, float, str], None]
FLUSH_NS = 800_000_000  # of virtual time


class Options(Parameters):
    """The observed backend with its options."""

    backend: str
    options: dict[str, Any]
    arm: str = ""  # in a cell of several


class _Observer:
    on_set_point: OnSetPoint | None = None


class ObservedArm:
    """Arm that passes every set-point to the observer and on to the simulated arm below."""

    def __init__(self, below: Hardware, limits: Limits, arm: str) -> None:
        self._below, self._limits, self._arm = below, limits, arm
        self._measured: Vector | None = None
        self.gripper: Gripper | None = below.gripper

    def read(self, now: float) -> tuple[Vector, Vector]:
        """Return measured positions and velocities of the arm below."""
        measured = self._below.read(now)
        self._measured = measured[0]
        return measured

    def write(self, positions: Vector, velocities: Vector, now: float) -> None:
        """Show a set-point to the observer and pass it on."""
        if _Observer.on_set_point is not None:
            measured = positions if self._measured is None else self._measured
            _Observer.on_set_point(self._limits, measured, positions, velocities, now, self._arm)
        self._below.write(positions, velocities, now)

    def close(self) -> None:
        """Close the arm below."""
        self._below.close()


class ObservedSensor(ObservedArm):
    """An observed arm with a force sensor."""

    _below: SensingArm

    @property
    def known_payload(self) -> tuple[float, float, float, float] | None:
        """What the sensor of the arm below does not measure."""
        return self._below.known_payload

    def wrench(self) -> Vector | None:
        """Return the wrench of the arm below."""
        return self._below.wrench()


def _around(below: Hardware, limits: Limits, arm: str) -> ObservedArm:
    return (ObservedSensor if isinstance(below, SensingArm) else ObservedArm)(below, limits, arm)


def create(robot: RobotConfig, limits: Limits, start: Vector, options: Options) -> ObservedArm:
    """Return an observed arm around the configured backend."""
    below = robot.model_copy(update={"hardware": HardwareConfig(backend=options.backend, options=options.options)})
    return _around(load_hardware(below, limits, start), limits, options.arm)


def around(
    robot: RobotConfig, limits: Limits, start: Vector, options: Options, arm: Callable[[], Hardware]
) -> ObservedArm:
    """Return an observed arm around the arm of a simulated world, which replaces the configured backend."""
    below = robot.model_copy(update={"hardware": HardwareConfig(backend=options.backend, options=options.options)})
    return _around(load_hardware(below, limits, start, arm), limits, options.arm)


def with_observed_arm(cell: Cell) -> Cell:
    """Return the cell with observed arms.

    Raises:
        ConfigError: its arm is real, so it cannot run on virtual time.
    """
    robots = {arm: _observed(robot, arm) for arm, robot in cell.robots.items()}
    return cell.model_copy(update={"robot": _observed(cell.robot), "robots": robots})


def _observed(robot: RobotConfig, arm: str = "") -> RobotConfig:
    hardware = robot.hardware
    if not find_backend(robot).simulated:  # a backend that talks to an arm has a clock of its own
        raise ConfigError("robot.hardware.backend", hardware.backend, "is a real arm: simulate needs a simulated one")
    options = {"backend": hardware.backend, "options": hardware.options, "arm": arm}
    observed = HardwareConfig(backend=__name__, options=options)
    return robot.model_copy(update={"hardware": observed})


@contextmanager
def observe_set_points(on_set_point: OnSetPoint) -> Iterator[None]:
    """Call back for every set-point within the block."""
    before, _Observer.on_set_point = _Observer.on_set_point, on_set_point
    try:
        yield
    finally:
        _Observer.on_set_point = before


class Trace:
    """Recording of every message at its virtual time, for `info`, `play`, `report` and the page."""

    def __init__(self, path: Path, about: Mapping[str, Any], custom: CustomTopics) -> None:
        """Create the file.

        Args:
            path: of the file.
            about: description of the recording.
            custom: topics of the cell that do not come with the project.

        Raises:
            RecordingError: the file exists already, or cannot be written.
        """
        self._writer = RecordingWriter(path, about)
        self._kinds = custom.kinds(custom.topics())
        self._newness: dict[str, SequenceFilter] = {}
        self._run_known = False
        self._flushed = 0

    @property
    def messages(self) -> int:
        """Number of messages written."""
        return self._writer.messages

    def add(self, raw: RawSample, now: int) -> None:
        """Write a message put at `now` [ns since the Unix epoch]; skip repetitions."""
        origin = decode_attachment(raw.attachment)
        if origin is None or not self._newness.setdefault(raw.key, SequenceFilter()).is_new(origin):
            return
        topic = raw.key.partition("/")[2]
        if topic == topics.SUPERVISOR_STATUS.key and not self._run_known:
            self._run_known = True
            self._writer.describe(RUN, run_of(decode(SupervisorStatus, raw.payload)))
        kind = self._kinds.get(topics.general_key(topic), "stream")
        self._writer.add(Sample(
            raw.key, raw.payload, now, message=message_of(raw.encoding), kind=kind,
            writer=origin.writer, sequence=origin.sequence, trace=origin.trace,
        ))
        if now - self._flushed > FLUSH_NS:
            self._flushed = now
            self._writer.flush()

    def close(self, reason: str) -> None:
        """Write the rest and why the recording ended."""
        self._writer.close({"reason": reason, "missed": {}, "dropped": {}})
