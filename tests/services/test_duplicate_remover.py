"""Coordinates from a file instead of perception."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from applications.outlining.stage_files import write_points
from applications.outlining.topics import CONTOUR_PATH, CONTOUR_POINTS, OutlinePoints
from common.errors import ConfigError
from common.process.in_process import running_service
from common.transport.local import LocalNetwork
from services import duplicate_remover

TRIANGLE = [(0.5, 0.0, 1.0), (0.6, 0.0, 1.0), (0.5, 0.1, 1.0)]


@pytest.mark.parametrize(("points", "problem"), [
    (TRIANGLE * 7000, "at most 20000"), ([*TRIANGLE, (5e8, 0.0, 0.0)], "10000000"),
], ids=["too many", "too far"])
def test_too_many_coordinates_are_rejected_at_the_start(
    tmp_path: Path, points: list[tuple[float, float, float]], problem: str
) -> None:
    write_points(file := tmp_path / "a.json", points)
    with pytest.raises(ConfigError, match=problem):
        duplicate_remover.points_of(file)


async def test_coordinates_are_read_from_any_folder_name(tmp_path: Path) -> None:
    write_points(file := tmp_path / ("a" * 200) / "b\tc.json", TRIANGLE)
    net, bus = (net := LocalNetwork()), net.bus("tester")
    outlines, paths = bus.writer(CONTOUR_POINTS), bus.reader(CONTOUR_PATH)
    await bus.ready()
    config = duplicate_remover.Config(coordinates=str(file))
    async with running_service(net, duplicate_remover.run, config, name="duplicate_remover"), asyncio.timeout(20):
        outlines.put(OutlinePoints())
        path = await paths.next()
    assert path.given and len(path.poses) == 3 and path.object.endswith(r"a/b\u0009c.json")
