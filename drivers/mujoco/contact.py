"""How things touch: the numbers of MuJoCo's solver, and who meets whom. docs/physics.md says where they come from."""

from __future__ import annotations

from typing import Any

TIMESTEP = 0.002  # [s]
IMPRATIO = 10.0  # friction is stiffer than contact: what is held does not creep
SOLREF = (0.004, 1.0)  # time constant [s], damping: MuJoCo's own 0.02 squeezes fingers 11 mm into what they hold
SOLIMP = (0.95, 0.99, 0.001, 0.5, 2.0)
SLIDING, TORSION, ROLLING = 1.0, 0.01, 0.001  # coefficient, [m], [m]: without rolling friction nothing round stops
FINGER_SLIDING = 1.5  # rubber pads
CONDIM = 6  # sliding, torsion and rolling

ROBOT, FIXED, THING, HIDDEN = 1, 2, 4, 0  # what meets what; a robot meets itself only in its planner's mind
_MEETS = {ROBOT: 0, FIXED: ROBOT, THING: ROBOT | FIXED | THING, HIDDEN: 0}

# Groups of shapes, for who draws them: what is only seen, and what only collides.
SEEN, COLLIDES = 2, 3


def touches(geom: Any, kind: int, *, group: int = 0) -> Any:
    """The geom (of an MjSpec) with the contact of its kind."""
    geom.contype, geom.conaffinity, geom.group = kind, _MEETS[kind], group
    geom.condim = CONDIM if kind == THING else 3
    geom.friction, geom.solref, geom.solimp = (SLIDING, TORSION, ROLLING), SOLREF, SOLIMP
    return geom


def grips(geom: Any) -> Any:
    """The geom of a finger with the contact of its pads, which counts more than that of what it holds."""
    geom.friction = (FINGER_SLIDING, TORSION, ROLLING)
    geom.condim, geom.priority = CONDIM, 1
    return geom


def only_seen(geom: Any) -> Any:
    """The geom without contact and mass."""
    geom.contype = geom.conaffinity = HIDDEN
    geom.group, geom.mass, geom.density = SEEN, 0.0, 0.0
    return geom
