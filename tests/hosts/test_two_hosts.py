"""A cell on two hosts, each a network namespace with a router of its own: what a cut link does to a run."""

from __future__ import annotations

from pathlib import Path

import pytest

from common.messages import CLOSED_BEFORE
from tests.hosts.cut_cell import CutCell
from tests.hosts.two_hosts import two_hosts, why_not

REASON = why_not()
pytestmark = [pytest.mark.cell, pytest.mark.slow, pytest.mark.skipif(bool(REASON), reason=REASON)]

SHORT = ("--speed", "3", "--set", "world.count=3", "--seed", "3")


def test_run_goes_through_cuts_in_the_middle_of_a_motion_and_between_motions(tmp_path: Path) -> None:
    with two_hosts() as two, CutCell(two, tmp_path, options=SHORT) as cell:
        cell.until(lambda e: e["what"] == "motion" and e["state"] == "active" and e["progress"] > 0.3)
        cell.cut(1.0)
        cell.until(lambda e: e["what"] == "motion" and e["state"] == "succeeded")
        long = cell.cut(10.0)
        summary = cell.end()
        aborted = {e["error"] for e in cell.events if e["what"] == "motion" and e["state"] == "aborted"}
    said = (tmp_path / "second.log").read_text(encoding="utf-8")
    assert summary["state"] == "DONE" and summary["placed"] == 3, said[-2000:]
    wanted = {"in_box": 3, "on_table": 0, "elsewhere": 0, "containers": {"box": 3}}
    assert summary["truth"] == wanted, "nothing is lost or placed twice"
    assert "no fresh picture" in said
    assert long.noticed is not None, "who is on the other host is known to be gone"
    # A busy machine holds the arm up as the fingers close, cut or not: that is tried again.
    assert aborted <= {CLOSED_BEFORE}, "no motion was given up for a cut"
