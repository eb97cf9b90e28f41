"""Services under names of their own as processes: what the supervisor, the tokens and the parameters call them."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import pytest

from common.transport.zenoh_session import connect
from tests.harness import Place, RunningCell

pytestmark = [pytest.mark.cell, pytest.mark.slow]

CELL = str(Path(__file__).parents[1] / "data" / "two_cameras.yaml")
SERVICES = ["motion_planner", "robot_state_publisher", "trajectory_executor", "left_camera", "right_camera",
            "left_detector", "right_detector", "workspace_validator", "scene_manager", "smart_pick_place"]


async def until_all_are_up(cell: RunningCell) -> None:
    async with connect(cell="two_cameras", service="watcher", endpoint=cell.endpoint, timeout=60.0) as bus:
        await bus.alive.wait(SERVICES[-1], 60.0)


def test_running_cell_lists_several_services_of_a_kind_by_name(tmp_path: Path) -> None:
    with RunningCell(tmp_path, "up", CELL, "--set", "autostart=false") as cell:
        asyncio.run(until_all_are_up(cell))
        place = Place(tmp_path, cell.domain)
        listed = place.ask("node", "list").stdout.split()
        assert {f"two_cameras/{name}" for name in SERVICES} <= set(listed)
        topic = json.loads(place.ask("topic", "info", "left/camera/image_raw", "--json").stdout)
        assert (topic["writer"], topic["message"], topic["kind"]) == ("left_camera", "Image", "stream")
        listed = [json.loads(line) for line in place.ask("topic", "list", "--json").stdout.splitlines()]
        own = {one["key"]: (one["writer"], one["message"], one["kind"]) for one in listed}
        assert own["right/camera/camera_info"] == ("right_camera", "CameraInfo", "state")
        assert place.ask("param", "set", "services.right_camera.rate=5").returncode == 0
        rates = [place.ask("param", "get", f"services.{name}.rate").stdout.strip() for name in
                 ("left_camera", "right_camera")]
        assert [float(rate) for rate in rates] == [10.0, 5.0]
        info = json.loads(place.ask("topic", "echo", "left/camera/camera_info", "-n", "1", "--json").stdout)
        assert info["header"]["frame_id"] == "left_optical_frame"
        # A second instance is refused, also when a user starts it.
        twice = cell.command("service", "left_camera", "--cell", CELL)
        assert twice.returncode == 2
        assert "another left_camera is up, which has left/camera/camera_info already" in twice.stderr.splitlines()[-1]
