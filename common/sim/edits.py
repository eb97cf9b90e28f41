"""Validate operator edits of the simulated world: new bodies, their shapes, and limits on size and number."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping

import numpy as np

from common.config import ObjectConfig
from common.errors import Refused, UnknownName
from common.messages import Vector3, WorldEdit
from common.planning.prism import convex_hull
from common.sim.bodies import Body
from common.sim.footprints import is_convex
from common.sim.objects import Solid, make_solid, solid_of

MAX_OBJECTS = 500  # in the world: each is published while it moves, and checked in every cycle
MAX_CORNERS = 50_000  # of all objects together
FARTHEST = 1000.0  # [m] from the origin of world along each axis, and from an object's own origin
MAX_CONCAVE = 200  # corners of a concave cross-section: overlap tests cost the product of corner counts


def new_body(
    request: WorldEdit, first: Mapping[str, ObjectConfig], solids: Mapping[str, Solid], spare: ObjectConfig | None,
    existing: Mapping[str, Body],
) -> Body:
    """Return the body that an `add` request describes, without a position yet.

    Args:
        request: the edit.
        first: objects of the initial layout, by id.
        solids: their shapes.
        spare: template for a request without `like`.
        existing: bodies in the world, by id.

    Raises:
        Refused: an unknown template, a used or invalid id, an invalid shape.
    """
    model = first.get(request.like) if request.like else spare
    if model is None:
        raise Refused("unknown_id", str(UnknownName("object of the first layout", request.like, first)))
    name = request.id or _free_name(request.shape or re.sub(r"_\d+$", "", model.id), existing)
    if name in existing:
        raise Refused("id_exists", f"id: {name!r} exists already; leave it empty for a new one")
    if not re.fullmatch(r"[A-Za-z0-9_.-]{1,60}", name):
        raise Refused("bad_id", f"id: {name[:60]!r} must be letters, digits, '_', '.' and '-', at most 60")
    c = request.color
    color = model.color if c is None else (c.r, c.g, c.b)
    if request.shape is None:
        solid = solids.get(model.id) or solid_of(model)
        like = model.id if model.id in first and c is None else ""
    else:
        solid, like = requested_solid(request), ""
    return Body(name, solid, color, np.eye(4), "elsewhere", added=True, like=like)


def _free_name(kind: str, taken: Collection[str]) -> str:
    return next(n for i in range(1, len(taken) + 2) if (n := f"{kind}_{i}") not in taken)


def requested_solid(request: WorldEdit) -> Solid:
    """Return the shape that a request describes.

    Raises:
        Refused: a value of the shape is missing or out of range.
    """
    size = request.size
    if request.shape is None or size is None or size.x <= 0 or (request.shape != "sphere" and size.z <= 0):
        raise Refused("no_size", f"size: a {request.shape} needs one, for example {{x: 0.04, y: 0.04, z: 0.04}}")
    inner = (request.inner_radius or 0.0) if request.shape == "ring" else 0.0
    if request.shape == "ring" and not 0 < inner < size.x / 2:
        raise Refused("no_size", f"inner_radius: a ring needs one below {size.x / 2:g} m")
    if request.shape == "box" and size.y <= 0:
        raise Refused("no_size", "size: a box needs x, y and z")
    if request.shape == "prism" and len(request.polygon) < 3:
        raise Refused("no_size", "polygon: a prism needs at least 3 corners")
    if len(request.polygon) > MAX_CONCAVE and not is_convex(np.array(request.polygon)):
        raise Refused("too_many_corners", f"polygon: has {len(request.polygon)} corners and is not convex; at most "
                                          f"{MAX_CONCAVE} are supported")
    if request.shape == "prism" and len(convex_hull(np.array(request.polygon))) < 3:
        raise Refused("no_size", "polygon: encloses no area")
    solid = make_solid(request.shape, size, inner, request.polygon)
    if solid.reach > FARTHEST:
        raise Refused("no_size", f"size: extends {solid.reach:g} m from its center; the limit is {FARTHEST:g} m")
    return solid


def requested_position(request: WorldEdit) -> Vector3:
    """Return the position of a request.

    Raises:
        Refused: it is missing or too far away.
    """
    at = request.position
    if at is None:
        raise Refused("no_position", f"position: {request.op} needs one, for example {{x: 0.5, y: 0.0}}")
    if max(abs(at.x), abs(at.y), abs(at.z)) > FARTHEST:
        raise Refused("too_far", f"position: is more than {FARTHEST:g} m from the origin of world")
    return at


def require_room(solids: Iterable[Solid], count: int) -> None:
    """Check that the world may hold these shapes, including a new one, in addition to `count` objects.

    Raises:
        Refused: a limit would be exceeded.
    """
    if count >= MAX_OBJECTS:
        raise Refused("world_full", f"there are {count} objects; at most {MAX_OBJECTS} are supported")
    corners = sum(len(solid.section) + len(solid.hole) + 3 * len(solid.mesh) for solid in solids)
    if corners > MAX_CORNERS:
        raise Refused("world_full", f"all objects together would have {corners} corners; at most {MAX_CORNERS} are "
                                    "supported")
