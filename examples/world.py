"""Add, move and remove objects of the simulated world, and measure the error of their detection."""

import sys

import numpy as np

from zencell import RemoteError
from zencell.blocking import Cell

with Cell(sys.argv[1]) if sys.argv[1:] else Cell.start("panda", overrides=["world.count=1"]) as cell:
    seen = cell.objects(least=1)
    there = {each.id for each in cell.world.objects()}
    (new,) = set(cell.world.add(0.45, -0.1)) - there
    print(f"{new} was added, {len(cell.objects(least=len(seen) + 1))} are seen")
    try:
        cell.world.move(new, 9.0, 0.0)
    except RemoteError as error:
        print(f"{error.code}: {error.message}")
    truth = {each.id: each.pose.position for each in cell.world.objects()}
    nearest = min(np.hypot(each.pose.position.x - truth[new].x, each.pose.position.y - truth[new].y)
                  for each in cell.objects())
    print(f"{new} is seen {1e3 * nearest:.1f} mm from where it is")
    cell.world.remove(new)
    print("left:", ", ".join(cell.world.reset()))
