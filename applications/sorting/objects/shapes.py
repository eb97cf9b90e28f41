"""Shapes of the kinds of objects: each a function of a random generator that returns convex pieces [mm]."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from applications.sorting.objects.pieces import (
    Piece,
    box,
    cylinder,
    lathe,
    moved,
    polygon,
    prism,
    ring,
    superquadric,
    tube,
    turned,
)

Rng = np.random.Generator
QUARTER = math.pi / 2


# --- kinds to train with ----------------------------------------------------------------------------------------------


def block(rng: Rng) -> list[Piece]:
    """Box, bevelled or not."""
    section = rng.uniform(20, 90, 2) * [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)]
    return [prism(section, rng.uniform(20, 60), rng.choice([1.0, 0.85, 0.6]))]


def can(rng: Rng) -> list[Piece]:
    """Cylinder or cone."""
    return [cylinder(rng.uniform(12, 32), rng.uniform(20, 120), top=rng.uniform(0.5, 1.0), count=16)]


def pebble(rng: Rng) -> list[Piece]:
    """Superquadric: rounded box, ellipsoid, or lens."""
    return [superquadric(rng.uniform((20, 15, 10), (60, 32, 30)), rng.uniform(0.3, 1.4, 2))]


def bar(rng: Rng) -> list[Piece]:
    """Prism of three to six sides, lying."""
    section = polygon(int(rng.integers(3, 7)), rng.uniform(10, 28), rng.uniform(0.6, 1.0))
    return [turned(prism(section, rng.uniform(50, 130), rng.uniform(0.7, 1.0)), "y", QUARTER)]


def plate(rng: Rng) -> list[Piece]:
    """Thin plate: rectangular, round, or of several sides."""
    section = polygon(int(rng.choice([4, 5, 6, 14])), rng.uniform(25, 50), rng.uniform(0.6, 1.0))
    return [prism(section, rng.uniform(5, 12))]


def angle_bracket(rng: Rng) -> list[Piece]:
    """Two plates at a right angle."""
    x, z, thick, deep = rng.uniform(40, 80), rng.uniform(30, 70), rng.uniform(6, 14), rng.uniform(20, 50)
    return [box(x, deep, thick), moved(box(thick, deep, z), x / 2 - thick / 2, 0, (z + thick) / 2 - 0.2)]


def tee(rng: Rng) -> list[Piece]:
    """T of two bars."""
    x, y, thick, high = rng.uniform(60, 110), rng.uniform(30, 70), rng.uniform(12, 25), rng.uniform(12, 30)
    return [box(x, thick, high), moved(box(thick * rng.uniform(0.7, 1.2), y, high), rng.uniform(-0.3, 0.3) * x,
                                       (y + thick) / 2 - 0.2, 0)]


def cross(rng: Rng) -> list[Piece]:
    """Two bars across each other."""
    x, y, a, b = *rng.uniform(60, 110, 2), *rng.uniform(12, 26, 2)
    return [box(x, a, rng.uniform(12, 30)), box(b, y, rng.uniform(12, 30))]


def washer(rng: Rng) -> list[Piece]:
    """Ring."""
    outer = rng.uniform(22, 45)
    return ring(outer * rng.uniform(0.4, 0.75), outer, rng.uniform(8, 30), count=12)


def hammer(rng: Rng) -> list[Piece]:
    """Handle with a head across its end."""
    length, thick, head = rng.uniform(90, 140), rng.uniform(10, 18), rng.uniform(40, 70)
    handle = turned(cylinder(thick / 2, length, top=rng.uniform(0.7, 1.1), count=10), "y", QUARTER)
    face = turned(cylinder(rng.uniform(0.6, 1.1) * thick, head, top=rng.uniform(0.6, 1.0), count=10), "x", QUARTER)
    return [handle, moved(face, length / 2, 0, 0)]


def mug(rng: Rng) -> list[Piece]:
    """Cup with a handle."""
    radius, high, wall = rng.uniform(24, 31), rng.uniform(50, 85), rng.uniform(4, 7)
    loop, thick = rng.uniform(0.22, 0.32) * high, rng.uniform(6, 9)
    handle = [moved(turned(piece, "x", QUARTER), radius - 1, 0, high / 2)
              for piece in ring(loop - thick / 2, loop + thick / 2, thick, count=5, start=-QUARTER, stop=QUARTER)]
    return [moved(cylinder(radius - 0.5, 6, count=10), 0, 0, 3), *handle,
            *(moved(piece, 0, 0, high / 2) for piece in ring(radius - wall, radius, high, count=10))]


def bottle(rng: Rng) -> list[Piece]:
    """Body, shoulder, neck and cap."""
    radius, body, neck = rng.uniform(16, 31), rng.uniform(40, 75), rng.uniform(15, 30)
    thin = radius * rng.uniform(0.35, 0.6)
    return lathe([(radius, 0), (radius, body), (thin, body + rng.uniform(5, 20)), (thin, body + 20 + neck)], count=14)


def bolt(rng: Rng) -> list[Piece]:
    """Shaft with a head of six sides."""
    radius, length, head = rng.uniform(6, 13), rng.uniform(50, 100), rng.uniform(10, 20)
    return [cylinder(radius, length, count=12),
            moved(prism(polygon(6, radius * rng.uniform(1.6, 2.2)), head), 0, 0, (length + head) / 2 - 0.2)]


def channel(rng: Rng) -> list[Piece]:
    """U profile."""
    x, y, z, thick = rng.uniform(50, 110), rng.uniform(30, 55), rng.uniform(20, 45), rng.uniform(5, 9)
    sides = [moved(box(x, thick, z), 0, sign * (y - thick) / 2, (z + thick) / 2 - 0.2) for sign in (-1, 1)]
    return [box(x, y, thick), *sides]


def cluster(rng: Rng) -> list[Piece]:
    """Two to four simple bodies, each of which overlaps the one before."""
    pieces: list[Piece] = []
    at = np.zeros(3)
    for _ in range(int(rng.integers(2, 5))):
        size = rng.uniform(12, 28, 3)
        choices = (box(*(2 * size)), superquadric(size, rng.uniform(0.4, 1.2, 2), rings=5, count=7),
                   turned(cylinder(size[0], 2 * size[2]), "x", rng.uniform(0, 3)))
        piece = choices[rng.integers(len(choices))]
        pieces.append(turned(piece, "z", rng.uniform(0, math.pi)) + at)
        direction = rng.normal(size=3) * (1.0, 1.0, 0.6)
        at = at + rng.uniform(18, 34) * direction / np.linalg.norm(direction)
    return pieces


# --- kinds to test with -----------------------------------------------------------------------------------------------


def wrench(rng: Rng) -> list[Piece]:
    """Open-ended wrench."""
    length, thick, wide, jaw = rng.uniform(70, 100), rng.uniform(6, 12), rng.uniform(12, 18), rng.uniform(14, 20)
    opening = rng.uniform(0.5, 0.9)
    ends = [moved(piece, length / 2 + 0.8 * jaw, 0, 0)
            for piece in ring(0.5 * jaw, jaw, thick, count=7, start=opening, stop=2 * math.pi - opening)]
    closed = [moved(piece, -length / 2 - 0.7 * jaw, 0, 0) for piece in ring(0.5 * jaw, 0.85 * jaw, thick, count=8)]
    return [box(length, wide, thick), *ends, *(closed if rng.random() < 0.5 else [])]


def screwdriver(rng: Rng) -> list[Piece]:
    """Thick handle, thin shaft, flat tip."""
    radius, handle, shaft = rng.uniform(11, 17), rng.uniform(55, 80), rng.uniform(40, 70)
    thin = rng.uniform(3, 5)
    return [*lathe([(0.7 * radius, 0), (radius, 0.3 * handle), (0.8 * radius, handle)], count=10),
            moved(cylinder(thin, shaft, count=8), 0, 0, handle + shaft / 2 - 0.5),
            moved(box(2.6 * thin, thin, 10), 0, 0, handle + shaft + 3)]


def goblet(rng: Rng) -> list[Piece]:
    """Foot, stem and bowl."""
    foot, bowl, stem = rng.uniform(20, 30), rng.uniform(20, 31), rng.uniform(20, 45)
    high, wall = rng.uniform(30, 50), rng.uniform(4, 6)
    wall_of_bowl = tube([(0.55 * bowl - wall, 0.55 * bowl, stem + 8), (bowl - wall, bowl, stem + 8 + high)], count=9)
    return [moved(cylinder(foot, 6, top=0.7), 0, 0, 3), moved(cylinder(5, stem, count=8), 0, 0, 5 + stem / 2),
            moved(cylinder(0.55 * bowl, 6, count=9), 0, 0, stem + 7), *wall_of_bowl]


def star(rng: Rng) -> list[Piece]:
    """Extruded star."""
    count, outer, high = int(rng.integers(4, 7)), rng.uniform(28, 48), rng.uniform(10, 26)
    inner = outer * rng.uniform(0.35, 0.6)
    angles = 2 * math.pi * np.arange(count) / count
    half = math.pi / count
    spikes = [np.array([(0.0, 0.0), (inner * math.cos(a - half), inner * math.sin(a - half)),
                        (outer * math.cos(a), outer * math.sin(a)),
                        (inner * math.cos(a + half), inner * math.sin(a + half))]) for a in angles]
    return [prism(spike, high) for spike in spikes]


def dumbbell(rng: Rng) -> list[Piece]:
    """Two heads with a grip between them."""
    head, grip, length = rng.uniform(18, 30), rng.uniform(6, 11), rng.uniform(40, 80)
    thick = rng.uniform(14, 28)
    ends = [superquadric((head, head, thick / 2), (rng.uniform(0.4, 1.0), 1.0), rings=5, count=9) for _ in range(2)]
    return [cylinder(grip, length, count=10), *(moved(end, 0, 0, sign * length / 2)
                                               for end, sign in zip(ends, (-1, 1), strict=True))]


def gear(rng: Rng) -> list[Piece]:
    """Disc with teeth and a hub."""
    count, radius, high = int(rng.integers(6, 11)), rng.uniform(22, 36), rng.uniform(8, 20)
    tooth = box(rng.uniform(12, 18), rng.uniform(7, 10), high * 0.9)
    teeth = [turned(moved(tooth, radius, 0, 0), "z", 2 * math.pi * k / count) for k in range(count)]
    return [cylinder(radius, high, count=14), cylinder(0.4 * radius, high + rng.uniform(6, 20), count=10), *teeth]


def hook(rng: Rng) -> list[Piece]:
    """Straight shaft that ends in an arc."""
    bend, thick, shaft = rng.uniform(18, 30), rng.uniform(9, 15), rng.uniform(40, 75)
    arc = ring(bend - thick / 2, bend + thick / 2, thick, count=8, start=-math.pi, stop=rng.uniform(0.0, 0.8))
    return [*arc, moved(box(thick, shaft, thick * 0.97), -bend, shaft / 2 - 1, 0)]


def key(rng: Rng) -> list[Piece]:
    """Ring, stem and bits."""
    bow, thick, stem = rng.uniform(16, 24), rng.uniform(6, 10), rng.uniform(50, 75)
    bits = [moved(box(rng.uniform(5, 9), rng.uniform(10, 18), thick * 0.9), bow + stem - at, 9, 0) for at in (5, 18)]
    return [*ring(0.55 * bow, bow, thick, count=9), moved(box(stem, 9, thick * 0.95), bow + stem / 2 - 2, 0, 0), *bits]


def step_block(rng: Rng) -> list[Piece]:
    """Z profile: two offset plates with a web."""
    x, y, z, thick = *rng.uniform((25, 20, 25), (45, 50, 50)), rng.uniform(7, 13)
    return [moved(box(x, y, thick), -x / 2, 0, 0), moved(box(x, y, thick), x / 2 - thick, 0, z),
            moved(box(thick, y * 0.98, z + thick - 0.4), -thick / 2, 0, z / 2)]


def jack(rng: Rng) -> list[Piece]:
    """Three bars across each other with knobs at some ends."""
    length, thick = rng.uniform(50, 75), rng.uniform(8, 13)
    bars = [cylinder(thick / 2, length, count=8) for _ in range(3)]
    knobs = [superquadric([0.8 * thick] * 3, (1.0, 1.0), rings=5, count=8) for _ in range(2)]
    return [bars[0], turned(bars[1], "x", QUARTER), turned(bars[2], "y", QUARTER),
            moved(knobs[0], 0, 0, length / 2), moved(knobs[1], length / 2, 0, 0)]


def spoon(rng: Rng) -> list[Piece]:
    """Flat bowl at the end of a bent handle."""
    length, wide, thick = rng.uniform(70, 100), rng.uniform(9, 14), rng.uniform(5, 8)
    bend = rng.uniform(0.1, 0.4)
    quarter = length / 4
    handle = turned(box(2 * quarter + 2, wide, thick), "y", bend)
    return [box(2 * quarter, wide * 0.96, thick),
            moved(superquadric((24, 17, thick), (0.9, 1.0), rings=5), -quarter - 20, 0, 0),
            moved(handle, quarter + quarter * math.cos(bend), 0, -quarter * math.sin(bend))]


def duck(rng: Rng) -> list[Piece]:
    """Body, head, beak and tail, all rounded."""
    body, head = rng.uniform((28, 20, 18), (42, 29, 26)), rng.uniform(13, 19)
    at = (0.6 * body[0], 0.0, 0.75 * body[2] + 0.6 * head)
    return [superquadric(body, (1.0, 1.0)), moved(superquadric([head] * 3, (1.0, 1.0), rings=5, count=10), *at),
            moved(box(14, 10, 5), at[0] + head, 0, at[2] - 2),
            moved(turned(box(20, 18, 8), "y", 0.5), -body[0] + 2, 0, 0.3 * body[2])]


def castle(rng: Rng) -> list[Piece]:
    """Blocks of a staircase."""
    count, wide, deep = int(rng.integers(2, 5)), rng.uniform(18, 28), rng.uniform(20, 50)
    heights = rng.uniform(15, 60, count)
    return [moved(box(wide, deep * rng.uniform(0.8, 1.0), high), (wide - 0.3) * k, 0, high / 2)
            for k, high in enumerate(heights)]


def pipe_elbow(rng: Rng) -> list[Piece]:
    """Bar with a bend."""
    radius, bend, straight = rng.uniform(8, 14), rng.uniform(22, 36), rng.uniform(15, 45)
    angles = np.linspace(0.0, rng.uniform(0.9, 1.6), 5)
    pieces = [moved(turned(cylinder(radius, straight, count=9), "x", QUARTER), bend, -straight / 2 + 0.5, 0)]
    for a, b in pairwise(angles):
        part = turned(cylinder(radius, 1.15 * bend * (b - a), count=9), "x", QUARTER)
        pieces.append(turned(moved(part, bend, 0, 0), "z", (a + b) / 2))
    return pieces
