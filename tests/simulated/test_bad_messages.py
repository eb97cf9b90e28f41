"""Whatever is put under the keys of a cell, no service stops, and what slips out of the hand is taken again."""

from __future__ import annotations

from typing import get_args

import pytest

from common import topics
from common.config import Cell, load_cell
from common.supervision.wiring import owned_in, wiring_of
from common.transport.bus import Bus
from lab.chaos.agent import Chaos
from lab.chaos.plan import Fault, Form
from tests.harness import running_with
from tests.simulated.visited import SimulatedCell

pytestmark = pytest.mark.timeout(600)  # some seconds of work, on a machine that may be busy

BALLS = 2


async def keys_in(cell: Cell) -> list[str]:
    return list(owned_in({entry.name: await wiring_of(cell, entry) for entry in cell.services.values()}))


@pytest.mark.slow
def test_bad_messages_stop_no_service_and_a_slipped_ball_is_grasped_again() -> None:
    happened: set[tuple[str, str]] = set()
    keys: list[str] = []

    async def visit(cell: SimulatedCell, bus: Bus) -> None:
        keys[:] = await keys_in(load_cell("panda", ["services.viewer.port=0"]))
        forms = [form for form in get_args(Form) if form not in ("", "huge")]
        bad = [Fault(0.0, "corrupt", key, form=form, count=2, seed=i) for i, key in enumerate(keys) for form in forms]
        bad += [Fault(0.0, "corrupt", key, form="huge") for key in (topics.GRIPPER_STATE.key, topics.JOINT_STATES.key)]
        old = [Fault(0.0, "replay", key, 0.5, count=3) for key in keys]
        chaos = Chaos(bus, [Fault(0.0, "drop"), *bad, *old], dict, cell.cell.world, slip_timeout=60)
        async with running_with(chaos.run()):
            await cell.ended.wait()
        happened.update((one.what, one.target) for one in chaos.injected)

    cell = SimulatedCell("panda", [f"world.count={BALLS}"], visit=visit)
    summary = cell.summary
    assert summary["truth"] == {"in_box": BALLS, "on_table": 0, "elsewhere": 0, "containers": {"box": BALLS}}
    assert summary["restarts"] == {}
    assert len({target for _, target in happened}) > len(keys) / 2
    assert "held object slips" in {what for what, _ in happened} and summary["failures"] >= 1
    assert "refused a message of" in cell.text
