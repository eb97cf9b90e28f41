"""The wrench at the tool in the control cycle: reads the sensor, knows the payload, makes the message."""

from __future__ import annotations

import numpy as np

from common.config import GripperConfig, WrenchConfig
from common.control.devices import call_device
from common.control.wrench import FlangeKinematics, Payload, WrenchEstimator
from common.errors import Refused
from common.hardware.interface import Hardware, HardwareFault, SensingArm, Vector
from common.messages import Header, Vector3, Wrench

REASON_PERIOD = 1.0  # [s] between messages without a wrench
STILL = 0.02  # [rad/s] a faster joint is not at rest, as of an arm that is moved by hand
NO_SENSOR = ("this arm has no force sensor; in simulation, the kinematic world has no forces: world.simulator: mujoco "
             "has them")


class ForceSensing:
    """The estimate of an arm's wrench; of an arm without a sensor, the reason why there is none.

    Attributes:
        estimator: None if the arm has no sensor.
        reason: why there is no wrench now; empty while there is one.
    """

    def __init__(
        self, hardware: Hardware, kinematics: FlangeKinematics | None = None, frame: str = "",
        gripper: GripperConfig | None = None, config: WrenchConfig | None = None, described: Payload | None = None,
    ) -> None:
        """Sense with this hardware.

        Args:
            hardware: with a sensor, or without.
            kinematics: None: there is no wrench.
            frame: name of the TCP's link.
            gripper: has the payload.
            config: of the estimate.
            described: mass of the gripper in the robot's description, in place of a payload of the gripper; for sensors
                that subtract nothing by themselves.
        """
        self._arm = hardware if isinstance(hardware, SensingArm) and kinematics is not None else None
        self._frame, self._gripper, self._described = frame, gripper, described or Payload()
        self.reason = NO_SENSOR if self._arm is None else "no reading of the force sensor received yet"
        self.estimator = None
        if self._arm is not None and kinematics is not None:
            config = config or WrenchConfig()
            self.estimator = WrenchEstimator(kinematics, bandwidth=config.bandwidth, inertia=config.inertia)
            self._T_flange_tcp = kinematics.T_flange_tcp
        self._subtracted = Payload()
        self._published_at = -float("inf")

    def update(self, now: float, q: Vector, dq: Vector, held: float, at_rest: bool) -> None:
        """Read the sensor at a time [s], with the arm at q (dof,) [rad] and a held mass [kg]."""
        if self._arm is None or self.estimator is None:
            return
        try:
            raw = call_device("reading the force sensor", self._arm.wrench)
        except HardwareFault as fault:
            self.lose(str(fault))
            return
        if raw is None:
            self.lose("the arm reports no force")
            return
        self.reason = ""
        known, measured = self._arm.known_payload, self._measured(self._arm, held)
        self._subtracted = measured if known is None else measured.with_other(Payload(*known))
        still = at_rest and float(np.abs(dq).max()) < STILL
        self.estimator.update(now, raw, q, dq, measured, still)

    def lose(self, reason: str) -> None:
        """Forget the wrench, for a reason."""
        if self.estimator is not None:
            self.reason = reason
            self.estimator.lose()

    def _measured(self, arm: SensingArm, held: float) -> Payload:
        """Return the payload that the sensor measures."""
        known = arm.known_payload
        if self._gripper is not None and self._gripper.payload is not None:
            total = Payload(*self._gripper.payload.with_held(held))
        elif known is not None:  # its controller subtracts the gripper, and no held object
            return Payload(held, *self._T_flange_tcp[:3, 3].tolist())
        else:
            total = self._described.with_other(Payload(held, *self._T_flange_tcp[:3, 3].tolist()))
        return total if known is None else total.without(Payload(*known))

    def zero(self) -> None:
        """Take the present wrench as zero.

        Raises:
            Refused: the arm moves, or there is no wrench.
        """
        if self.estimator is None or self.reason:
            raise Refused("no_wrench", self.reason)
        self.estimator.zero()

    def message(self, header: Header) -> Wrench:
        """Return the newest wrench, or why there is none."""
        header = header.model_copy(update={"frame_id": self._frame})
        if self.estimator is None or self.reason or self.estimator.wrench is None:
            return Wrench(header=header, reason=self.reason)
        mass, x, y, z = self._subtracted
        fx, fy, fz, tx, ty, tz = self.estimator.wrench.tolist()
        return Wrench(header=header, force=Vector3(x=fx, y=fy, z=fz), torque=Vector3(x=tx, y=ty, z=tz),
                      zeroed=self.estimator.zeroed, payload=mass, com=Vector3(x=x, y=y, z=z))

    def due(self, header: Header) -> Wrench | None:
        """Return the message of this cycle; without a wrench, one each second."""
        now = header.stamp * 1e-9
        if self.reason and now - self._published_at < REASON_PERIOD:
            return None
        self._published_at = now
        return self.message(header)
