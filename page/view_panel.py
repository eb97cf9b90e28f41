"""The panel that says what the scene shows: a tick for each layer that the cell has, what colours mean, shadows."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from functools import partial

import viser

from page.console import Desk
from page.layers import Layers, has_something
from page.markup import block, span, swatch, text


class ViewPanel:
    """Ticks and a legend.

    Attributes:
        shown: whether each layer is ticked.
        shadows: whether things throw shadows.
    """

    def __init__(
        self, gui: viser.GuiApi, desk: Desk, kinds: Layers, shown: Mapping[str, bool], *, shadows: bool,
        on_layer: Callable[[str, bool], None], on_shadows: Callable[[bool], None],
    ) -> None:
        """Lay the panel out where the GUI stands.

        Args:
            gui: of the server.
            desk: takes changes of the ticks.
            kinds: layers of the scene by name, in the order of their ticks.
            shown: whether each is ticked at first.
            shadows: whether things throw shadows at first.
            on_layer: called with a layer and whether it is ticked now.
            on_shadows: called with whether there are to be shadows.
        """
        self._kinds, self._on_layer, self._on_shadows = kinds, on_layer, on_shadows
        self.shown, self.shadows = dict(shown), shadows
        self._ticks = {name: gui.add_checkbox(kind.LABEL or name, self.shown[name]) for name, kind in kinds.items()}
        for name, tick in self._ticks.items():
            desk.on_change(tick, partial(self._set, name), "look")
        tick = gui.add_checkbox("Shadows", shadows, hint="slow in a browser without a graphics card")
        desk.on_change(tick, self._set_shadows, "look")
        self._legend = gui.add_html("")
        self._show_legend()

    def offer(self, written: Collection[str]) -> None:
        """Have ticks for those layers only that there is something for, where these keys are written."""
        for name, kind in self._kinds.items():
            if self._ticks[name].visible is not (has := has_something(kind, written)):
                self._ticks[name].visible = has
        self._show_legend()

    def _set(self, name: str, on: bool) -> None:
        self.shown[name] = on
        self._show_legend()
        self._on_layer(name, on)

    def _set_shadows(self, on: bool) -> None:
        self.shadows = on
        self._on_shadows(on)

    def _show_legend(self) -> None:
        """What colours mean, of the layers that are shown."""
        said = {words: color for name, kind in self._kinds.items() for words, color in kind.LEGEND
                if self.shown[name] and self._ticks[name].visible}
        lines = "".join(f"<div>{swatch(color)} {text(words)}</div>" for words, color in said.items())
        content = block(span("Colours", "dim") + lines, "legend", colors=len(said)) if lines else ""
        if content != self._legend.content:
            self._legend.content = content
