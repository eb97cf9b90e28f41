"""A policy on the operator's page: its chunks, the newest reason for a refusal, and buttons to take control."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from applications.policy.topics import POLICY_CONTROL, POLICY_STATUS, ControlRequest, PolicyStatus
from common.messages import TaskStatus
from common.topics import Topic
from page.application import ApplicationPage

if TYPE_CHECKING:
    import viser

    from page.console import Console

TAKE, GIVE = "Take over", "Give back"


def counters(status: TaskStatus, rejected: int) -> dict[str, object]:
    """Figures of the task by label."""
    if not isinstance(status, PolicyStatus):
        return {}
    owner = status.operator or "operator" if status.control == "operator" else "policy"
    return {
        "control": owner, "chunks": status.chunks, "proved": status.proved, "slowed": status.slowed,
        "cut short": status.shortened, "refused": status.refused, "late": status.late, "failed": status.failed,
        "inference": f"{status.inference_ms:.0f} ms", "proof": f"{status.proof_ms:.1f} ms",
        "last violation": status.violation or "–"}


class Controls:
    """Buttons to take the arm from the policy and to give it back."""

    TOPICS = (POLICY_STATUS,)
    PERIOD = 0.5  # [s]

    def __init__(self, gui: viser.GuiApi, console: Console) -> None:
        """Create the buttons at the current position in the GUI."""
        self._console = console
        self._buttons = gui.add_button_group("Policy", (TAKE,), hint="take the arm from the policy: it comes to rest")
        console.on_choice(self._buttons, self._choose)

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Offer what is possible now."""
        ours = message.operator in ("", self._console.permissions.client_name)  # from another operator it is taken
        options = (GIVE,) if message.control == "operator" and ours else (TAKE,)
        if options != self._buttons.options:
            self._buttons.options = options

    async def _choose(self, chosen: str) -> None:
        owner = self._console.permissions.client_name
        await self._console.call(POLICY_CONTROL, ControlRequest(take=chosen == TAKE, owner=owner))


PAGE = ApplicationPage(
    controls=Controls, requests=(POLICY_CONTROL,), states={"ACTING": "The policy acts", "ENDING": "Coming to rest"},
    latency="Image to chunk", counters=counters)
