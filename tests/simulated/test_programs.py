"""Complete programs on the virtual clock."""

from __future__ import annotations

from pathlib import Path

from tests.simulated.program_cell import Operator, simulate

TEND = """\
steps:
  - {step: move, to: home}
  - {step: output, signal: clamp}
  - {step: wait, for: {signal: clamp_closed}, timeout: 2}
  - step: loop
    count: 2
    steps:
      - {step: move, id: down, to: {by: [0, 0, -0.1]}, straight: true, requires: {clamp_closed: true}}
      - {step: retreat, id: up, distance: 0.1, axis: world}
  - step: if
    when: {signal: busy}
    then: [{step: wait, seconds: 60}]
    else:
      - {step: output, signal: start}
      - {step: wait, for: {signal: busy}}
      - {step: output, signal: start, value: false}
  - {step: call, program: finish}
"""
FINISH = """\
steps:
  - {step: wait, for: {signal: busy, value: false}, timeout: 5}
  - {step: output, signal: clamp, value: false}
  - {step: through, points: [{position: [0.5, 0.2, 0.5]}, {position: [0.5, -0.2, 0.5]}, home], blend: 0.05}
"""


def test_program_with_io_loops_conditions_and_a_call_runs_to_its_end(tmp_path: Path) -> None:
    (tmp_path / "tend.yaml").write_text(TEND)
    (tmp_path / "finish.yaml").write_text(FINISH)
    seen: list[str] = []

    async def visit(operator: Operator) -> None:
        await operator.send("run", program="tend")

        def note(status: object) -> bool:
            step = getattr(status, "step", "")
            if step and (not seen or seen[-1] != step):
                seen.append(step)
            return getattr(status, "state", "") in ("DONE", "ERROR")

        assert (await operator.until(note)).done == 13

    outcome = simulate(tmp_path, visit)
    assert (outcome.state, outcome.crashes, outcome.broken) == ("DONE", [], []), outcome
    assert seen == ["move1", "output1", "wait1", "down", "up", "down", "up", "output2", "wait3", "output3", "wait1",
                    "output1", "through1"]
