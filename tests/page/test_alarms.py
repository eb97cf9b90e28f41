"""The list of alarms."""

import viser

from common.messages import LogLine
from page.alarms import MAX_ALARMS, AlarmPanel, Alarms
from page.console import ActionQueue


async def test_alarms_stay_until_they_are_over_and_acknowledged(gui: viser.GuiApi) -> None:
    alarms = Alarms()
    panel = AlarmPanel(gui, ActionQueue(), alarms)
    for _ in range(3):
        alarms.update(["Protective stop"])
    alarms.add_line(LogLine(service="planner", level="info", message="fine"))
    for _ in range(2):
        alarms.add_line(LogLine(service="planner", level="error", message="<b>died"))
    alarms.update([])
    assert [(each.message, each.count, each.active) for each in alarms.alarms] == [
        ("Protective stop", 1, False), ("planner: <b>died", 2, False)]
    panel.show()
    assert "&lt;b&gt;died (2 times)" in panel._html.content and alarms.unacknowledged == 2
    panel._acknowledge()
    assert alarms.unacknowledged == 0 and "there is no new alarm" in panel._html.content
    alarms.update(["Protective stop"])
    assert alarms.unacknowledged == 1, "it came again"
    alarms.update(map(str, range(2 * MAX_ALARMS)))
    assert len(alarms.alarms) == MAX_ALARMS
