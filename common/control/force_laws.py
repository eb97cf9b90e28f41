"""Laws of force motions: from the commanded offset and the measured wrench to a velocity. No I/O and no kinematics.

All quantities are in the axes of the motion: z is its direction, the origin where it starts. Offsets (6,) are a
translation [m] and a rotation vector [rad] of the contact point; wrenches (6,) [N, N m] are what the environment exerts
on the tool at that point; so a tool that presses along the motion feels a negative force z.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from common.control.goals import Outcome
from common.messages import ForceMotion

Vector = NDArray[np.float64]

STOPPING_TIME = 0.02  # [s] in which a force motion comes to rest: it starts to brake so long before its end
DEADBAND = np.array([0.5, 0.5, 0.5, 0.05, 0.05, 0.05])  # [N, N m] smaller wrenches are noise and drift
FIRST_TOUCH = 0.4  # share of the pressing force that counts as the first contact of an insertion
DROP = 0.4e-3  # [m] below the first contact and the run of the search: the part has found the hole
PAST = 2e-3  # [m] beyond the expected surface without contact: the part is in the hole
STUCK_TIME, STUCK = 1.5, 0.1e-3  # [s], [m] a push that gets no deeper in this time is stuck: search again
SEARCHES = 8  # of one insertion
TURN_DAMPING = 25.0  # [N m s] of the rotation in an insertion
SIDE_DAMPING = 2500.0  # [N s/m] across the direction in an insertion


class Sample(NamedTuple):
    """What a law decides by: time in motion [s], commanded and measured offset (6,), wrench (6,) with less noise.

    `newest` is the wrench (6,) of this cycle without the low-pass, which decides about contact and limits.
    """

    time: float
    commanded: Vector
    measured: Vector
    wrench: Vector
    newest: Vector

    @property
    def pressing(self) -> float:
        """Force of the tool along the direction [N]."""
        return -float(self.wrench[2])

    @property
    def contact(self) -> float:
        """The same without the low-pass [N]."""
        return -float(self.newest[2])


class Law(Protocol):
    """Decides the velocity of the contact point."""

    def velocity(self, sample: Sample, dt: float) -> Vector | Outcome:
        """Return the velocity (6,) [m/s, rad/s] for the next `dt` [s], or how the motion ends."""


def law_of(request: ForceMotion) -> Law:
    """Return the law of a request."""
    kinds: dict[str, Callable[[ForceMotion], Law]] = {"until": Until, "comply": Comply, "insert": Insert}
    return kinds[request.kind](request)


def described(sample: Sample) -> str:
    """Return force and distance in words."""
    return f"{sample.contact:.1f} N after {1e3 * sample.measured[2]:.2f} mm"


class Until:
    """Moves along the direction until the tool presses with a force."""

    def __init__(self, request: ForceMotion) -> None:
        """Take speed, force and distance from the request."""
        self._p = request

    def velocity(self, sample: Sample, dt: float) -> Vector | Outcome:
        """Return the speed along the direction; end at the contact or at the largest distance."""
        if sample.contact >= self._p.force:
            return Outcome("succeeded", message=f"contact: {described(sample)}")
        if sample.commanded[2] + self._p.speed * (dt + STOPPING_TIME) >= self._p.max_distance:
            return Outcome("aborted", "no_contact", f"no contact of {self._p.force:g} N within "
                                                    f"{1e3 * self._p.max_distance:g} mm: {described(sample)}")
        return along(self._p.speed)


class Comply:
    """Yields to the wrench like a mass with damping, and a spring to the start if there is a stiffness.

    m dv/dt = F + F_target - d v - k x, each axis for itself; the velocity along the direction also presses with
    `force`. Rotations use the same values times the square of `lever`.
    """

    def __init__(self, request: ForceMotion) -> None:
        """Start at rest."""
        self._p, self._v = request, np.zeros(6)
        self._scale = np.array([1.0, 1.0, 1.0, *(3 * [request.lever**2])])
        self._most = np.array([*(3 * [request.speed]), *(3 * [request.speed / request.lever])])
        free = [request.along, request.across, request.turn]
        self._free = np.array([free[1], free[1], free[0], free[2], free[2], free[2]], dtype=float)

    def velocity(self, sample: Sample, dt: float) -> Vector | Outcome:
        """Return the velocity within the region; end after the timeout, which is no failure."""
        if sample.time >= self._p.timeout:
            return Outcome("succeeded", message=f"complied for {self._p.timeout:g} s: {described(sample)}")
        force = np.where(np.abs(sample.wrench) > DEADBAND, sample.wrench, 0.0)
        force[2] += self._p.force
        damping, mass = self._p.damping * self._scale, self._p.mass * self._scale
        share = 1.0 - np.exp(-damping * dt / mass)  # exact for a constant force: stable for any step
        target = (force - self._p.stiffness * self._scale * sample.commanded) / damping
        v = self._v + share * (target - self._v)
        v = np.clip(self._free * v, -self._most, self._most)
        self._v = self._inside(v, sample.commanded, dt)
        return self._v.copy()

    def _inside(self, v: Vector, x: Vector, dt: float) -> Vector:
        """Return the velocity without what would leave the region: a cylinder, and a cone of rotations."""
        v, reach = v.copy(), dt + STOPPING_TIME
        if x[2] + v[2] * reach > self._p.max_distance or x[2] + v[2] * reach < 0.0:
            v[2] = 0.0
        for part, most in ((slice(0, 2), self._p.radius), (slice(3, 6), self._p.angle)):
            ahead = x[part] + v[part] * reach
            size = float(np.linalg.norm(ahead))
            if size > most and size > float(np.linalg.norm(x[part])):
                outward = ahead / size
                v[part] -= max(float(outward @ v[part]), 0.0) * outward
                if float(np.linalg.norm(x[part] + v[part] * reach)) > most + 1e-5:
                    v[part] = 0.0
        return v


class Insert:
    """Approaches to contact, searches the hole on a spiral under a pressing force, and pushes to the depth.

    Whitney, "Quasi-static assembly of compliantly supported rigid parts" (1982): the push yields across the direction
    and turns about the tip of the part, so that the walls of the hole align it. With `tilt` the part searches tilted.
    """

    def __init__(self, request: ForceMotion) -> None:
        """Start with the approach."""
        self._p = request
        self._phase = "approach"
        self._surface = 0.0  # measured distance of the first contact [m]
        self._angle, self._turn = 0.0, 1.0  # on the spiral [rad], and its sense
        self._center = np.zeros(2)  # of the spiral [m]
        self._found = np.zeros(2)  # where the newest push began [m]
        self._searches = 0
        self._deepest, self._deepest_at = 0.0, 0.0

    def velocity(self, sample: Sample, dt: float) -> Vector | Outcome:
        """Return the velocity of the present phase, or that the part is inserted, or is not."""
        depth = float(sample.measured[2]) - self._surface
        if self._phase != "approach" and depth >= self._p.depth:
            return Outcome("succeeded", message=f"inserted {1e3 * depth:.1f} mm: {described(sample)}")
        if sample.time > self._p.timeout:
            return self._failed(f"within {self._p.timeout:g} s", depth)
        if sample.commanded[2] >= self._p.max_distance:
            return self._failed(f"within {1e3 * self._p.max_distance:g} mm", depth)
        if self._phase == "approach":
            return self._approach(sample)
        if self._phase == "search":
            return self._search(sample, dt, depth)
        return self._push(sample, dt, depth)

    def _failed(self, why: str, depth: float) -> Outcome:
        where = "no contact" if self._phase == "approach" else f"{1e3 * depth:.2f} of {1e3 * self._p.depth:g} mm deep"
        return Outcome("aborted", "not_inserted", f"not inserted {why}: {where}, in the {self._phase}")

    def _approach(self, sample: Sample) -> Vector:
        if sample.contact >= FIRST_TOUCH * self._p.force:
            self._phase, self._surface = "search", float(sample.measured[2])
            self._deepest, self._deepest_at = 0.0, sample.time
            self._center = sample.commanded[:2].copy()
            return np.zeros(6)
        if self._p.surface is not None and sample.measured[2] > self._p.surface + PAST:
            self._phase, self._surface, self._found = "push", self._p.surface, sample.commanded[:2].copy()
            self._deepest, self._deepest_at = 0.0, sample.time
            return np.zeros(6)
        v = along(self._p.speed)
        v[3:] = _toward(self._tilted(), sample.commanded[3:], self._p.speed / self._p.lever)
        return v

    def _tilted(self) -> Vector:
        return np.array([self._p.tilt, 0.0, 0.0])

    def _search(self, sample: Sample, dt: float, depth: float) -> Vector | Outcome:
        if depth > DROP:
            self._phase, self._found = "push", sample.commanded[:2].copy()
            self._deepest, self._deepest_at = depth, sample.time
            return np.zeros(6)
        radius = self._p.pitch * self._angle / (2 * math.pi)
        if radius > self._p.radius:  # friction drags the part: the way back, and the other way round, meet other places
            return self._search_again(depth) or np.zeros(6)
        self._angle += self._p.search_speed * dt / math.hypot(radius, self._p.pitch / (2 * math.pi))
        target = self._center + radius * np.array([math.cos(self._angle), self._turn * math.sin(self._angle)])
        v = np.zeros(6)
        v[:2] = _toward(target, sample.commanded[:2], 2 * self._p.search_speed, dt)
        v[2] = self._press(sample, self._p.force)
        v[3:] = _toward(self._tilted(), sample.commanded[3:], self._p.search_speed / self._p.lever)
        return v

    def _search_again(self, depth: float) -> Outcome | None:
        """Begin a new spiral the other way round; after SEARCHES return how the motion ends."""
        self._searches, self._angle, self._turn = self._searches + 1, 0.0, -self._turn
        return self._failed(f"in {SEARCHES} searches", depth) if self._searches >= SEARCHES else None

    def _push(self, sample: Sample, dt: float, depth: float) -> Vector | Outcome:
        if depth > self._deepest + STUCK:
            self._deepest, self._deepest_at = depth, sample.time
        elif sample.time - self._deepest_at > STUCK_TIME:
            self._phase, self._center = "search", self._found
            return self._search_again(depth) or along(-self._p.speed)
        v = np.zeros(6)
        free = np.where(np.abs(sample.wrench) > DEADBAND, sample.wrench, 0.0)
        v[:2] = np.clip(free[:2] / SIDE_DAMPING, -self._p.search_speed, self._p.search_speed)
        v[2] = self._press(sample, self._p.force)
        v[3:5] = np.clip(free[3:5] / TURN_DAMPING, -0.2, 0.2)
        return v

    def _press(self, sample: Sample, force: float) -> float:
        """Return the speed along the direction that lets the tool press with a force [N]."""
        return float(np.clip((force - sample.pressing) / self._p.damping, -self._p.speed, self._p.speed))


def along(speed: float) -> Vector:
    """Return the velocity (6,) along the direction [m/s]."""
    v = np.zeros(6)
    v[2] = speed
    return v


def _toward(target: Vector, now: Vector, most: float, dt: float = 0.05) -> Vector:
    """Return a velocity that reaches a target in `dt`, of at most this norm."""
    v = (target - now) / dt
    size = float(np.linalg.norm(v))
    return np.asarray(v if size <= most else v * (most / size))
