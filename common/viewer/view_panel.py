"""The panel that says what of the scene is shown, and saves how the page is laid out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import viser

from common.viewer.desk import Desk
from common.viewer.layers import LAYERS
from common.viewer.markup import block, span


class ViewPanel:
    """Ticks for the layers, one for editing the simulated world, and a button that saves the layout."""

    def __init__(
        self, gui: viser.GuiApi, desk: Desk, layers: Mapping[str, bool], editing: bool, *,
        on_layer: Callable[[str, bool], None], on_editing: Callable[[bool], None],
        on_save: Callable[[viser.ClientHandle | None], None],
    ) -> None:
        """Lay the panel out where the GUI stands.

        Args:
            gui: of the server.
            desk: takes the orders.
            layers: whether each is shown.
            editing: whether the world can be edited.
            on_layer: shows or hides a layer.
            on_editing: lets objects be dragged, or not.
            on_save: saves the layout as that browser sees the scene.
        """
        for name, layer in LAYERS.items():
            tick = gui.add_checkbox(layer.label, layers[name])
            desk.on_change(tick, partial(on_layer, name))
        gui.add_divider()
        desk.on_change(
            gui.add_checkbox("Edit the simulated world", editing, hint="drag objects to other places"), on_editing)
        button = gui.add_button("Save layout", icon=viser.Icon.DEVICE_FLOPPY,
                                hint="what is on now, and this view of the scene, is how the page opens")

        async def clicked(event: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
            client = event.client
            desk.put(lambda: on_save(client))

        button.on_click(clicked)
        self._note = gui.add_html("")

    def tell(self, line: str, kind: str) -> None:
        """Say how saving went."""
        self._note.content = block(span(line, kind), "layout", kind=kind)
