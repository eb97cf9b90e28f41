"""Injected faults: a run ends as it should under a plan of them."""

from pathlib import Path

import pytest

from tests.harness import RunningCell
from tests.simulated.visited import in_box

pytestmark = [pytest.mark.cell, pytest.mark.slow]


async def test_run_with_chaos_ends_done_with_every_ball_in_the_box(tmp_path: Path) -> None:
    options = ["--speed", "2", "--set", "world.count=1", "--chaos", "7", "--chaos-rate", "60"]
    with RunningCell(tmp_path, "run", "panda", *options) as cell:
        assert await cell.ended(150) == 0, cell.tail(80)
        assert not cell.processes()
        assert cell.summary["state"] == "DONE"
        assert cell.summary["truth"] == in_box(1)
        assert cell.summary["chaos"], cell.tail(80)
        for fault in cell.summary["chaos"]:
            assert f"CHAOS {fault['t']:.1f} s: {fault['what'].partition(':')[0]}" in cell.text
