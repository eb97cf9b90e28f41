"""Faults on purpose: a run ends as it should under a plan of them, and no message from anywhere stops a service."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest

from common import topics
from common.chaos.agent import Chaos
from common.chaos.plan import Fault, Form
from common.config import load_cell
from common.process.wiring import owned_in, wiring_of
from tests.harness import RunningCell, beside

pytestmark = [pytest.mark.cell, pytest.mark.slow]

BALLS = 3


async def test_a_run_under_a_plan_of_faults_ends_done_with_every_ball_in_the_box(tmp_path: Path) -> None:
    options = ["--speed", "5", "--set", f"world.count={BALLS}", "--chaos", "7"]
    with RunningCell(tmp_path, "run", "panda", *options) as cell:
        assert await cell.ended(150) == 0, cell.tail(80)
        assert not cell.processes()
        assert cell.summary["state"] == "DONE"
        assert cell.summary["truth"] == {"in_box": BALLS, "on_table": 0, "elsewhere": 0, "containers": {"box": BALLS}}
        assert cell.summary["chaos"], cell.tail(80)
        for fault in cell.summary["chaos"]:
            assert f"CHAOS {fault['t']:.1f} s: {fault['what'].partition(':')[0]}" in cell.text


async def test_bad_messages_stop_no_service_and_a_ball_that_slips_is_taken_again(tmp_path: Path) -> None:
    panda = load_cell("panda")
    apart = load_cell("panda", ["services.viewer.port=0"])
    keys = list(owned_in({entry.name: await wiring_of(apart, entry) for entry in apart.services.values()}))
    forms = [form for form in get_args(Form) if form not in ("", "huge")]
    bad = [Fault(0.0, "corrupt", key, form=form, count=2, seed=i) for i, key in enumerate(keys) for form in forms]
    bad += [Fault(0.0, "corrupt", key, form="huge") for key in (topics.GRIPPER_STATE.key, topics.JOINT_STATES.key)]
    old = [Fault(0.0, "replay", key, 0.5, count=3) for key in keys]
    with RunningCell(tmp_path, "run", "panda", "--speed", "5", "--set", f"world.count={BALLS}") as cell:
        async with cell.listen() as bus:
            chaos = Chaos(bus, [Fault(0.0, "drop"), *bad, *old], dict, [panda.world.container], patience=60)
            async with beside(chaos.run()):
                assert await cell.ended(150) == 0, cell.tail(80)
        summary = cell.summary
        assert not cell.processes()
    assert summary["truth"] == {"in_box": BALLS, "on_table": 0, "elsewhere": 0, "containers": {"box": BALLS}}
    assert not any(summary["restarts"].values()), cell.tail(80)
    assert len({one.target for one in chaos.happened}) > len(keys) / 2
    assert "what is held slips" in {one.what for one in chaos.happened} and summary["failures"] >= 1
    assert "refused a message of" in cell.text
