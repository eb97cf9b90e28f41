"""HTML of the panels: every value is escaped; one style sheet."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from html import escape
from typing import TYPE_CHECKING

from common.terminal import printable

if TYPE_CHECKING:
    import viser

GOOD, BUSY, BAD, OFF = "good", "busy", "bad", "off"  # kinds of a state; each has a color

_MOVES_ARM = ' data-needs="arm"'  # overlay.js disables these buttons on pages that must not move the arm

STYLE = """<style>
.zc { padding: 0 0.75em 0.4em; font-size: 0.8125em; line-height: 1.5; overflow-wrap: anywhere; }
.zc table { width: 100%; border-collapse: collapse; font-variant-numeric: tabular-nums; }
.zc td, .zc th { padding: 0.12em 0.4em; text-align: left; vertical-align: baseline; }
.zc th { font-weight: 500; opacity: 0.6; white-space: nowrap; }
.zc tr + tr td { border-top: 1px solid rgba(128, 128, 128, 0.18); }
.zc td.number, .zc th.number { text-align: right; white-space: nowrap; }
.zc td:has(button) { width: 1%; white-space: nowrap; }
.zc .dim { opacity: 0.6; }
.zc .big { font-size: 1.3em; font-weight: 600; }
.zc .good { color: #2fb344; } .zc .busy { color: #f59f00; } .zc .bad { color: #fa5252; } .zc .off { color: #868e96; }
.zc .dot { font-size: 1.1em; }
.zc .swatch { display: inline-block; width: 0.8em; height: 0.8em; border-radius: 0.15em; margin-right: 0.2em; }
.zc .small { font-size: 0.875em; }
.zc .small td, .zc .small th { padding: 0.2em 0.3em; }
.zc .tight { white-space: nowrap; }
.zc .steps td { padding: 0 0.2em; } .zc .steps td:has(button) { width: auto; white-space: normal; }
.zc .steps button { width: 100%; min-height: 1.9em; padding: 0.1em 0.4em; text-align: left; border-color: transparent; }
.zc .steps td:first-child, .zc .steps td:nth-child(2), .zc .steps td:last-child { width: 1%; white-space: nowrap; }
.zc .log td { border: none; padding-top: 0; padding-bottom: 0; }
.zc .log td:first-child, .zc .log td:nth-child(2) { white-space: nowrap; opacity: 0.6; }
.zc .fields { display: grid; grid-template-columns: repeat(auto-fit, minmax(4.6em, 1fr)); gap: 0.2em 0.6em; }
.zc .fields b { display: block; font-size: 1.25em; font-weight: 600; font-variant-numeric: tabular-nums; }
.zc .buttons { display: flex; flex-wrap: wrap; gap: 0.35em; align-items: center; margin: 0.3em 0; }
.zc .buttons .what { flex: 0 0 4.5em; }
.zc button { flex: 1 1 4.5em; min-height: 2.2em; padding: 0.2em 0.6em; font: inherit; border-radius: 0.25em;
  border: 1px solid #4dabf7; color: #4dabf7; background: transparent; cursor: pointer; }
.zc button.main:not([aria-disabled]) { background: #1c7ed6; border-color: #1c7ed6; color: #fff; font-weight: 600; }
.zc [data-live="control"] { flex: 1 1 3em; text-align: left; font-weight: 600; }
.zc button:hover { background: rgba(77, 171, 247, 0.15); }
.zc button:focus-visible { outline: 2px solid currentColor; outline-offset: 1px; }
.zc button.hold { touch-action: pan-y; user-select: none; -webkit-user-select: none; flex: 0 0 3.2em;
  min-height: 2.7em; padding: 0; font-size: 1.1em; }
.zc button.held { background: #f59f00; border-color: #f59f00; color: #000; }
.zc button[aria-disabled="true"] { border-color: rgba(128, 128, 128, 0.4); color: rgba(128, 128, 128, 0.8);
  background: transparent; cursor: not-allowed; }
.zc .pad { display: grid; grid-template-columns: 1fr 1fr; gap: 0 1em; }
.zc .pad > div > div { display: flex; gap: 0.3em; align-items: center; margin-top: 0.25em; }
.zc .pad .name { flex: 1; min-width: 0; text-align: center; line-height: 1.2; overflow-wrap: normal; }
.zc .pad .name > * { display: block; } .zc .live { font-variant-numeric: tabular-nums; }
/* A checkbox is placed before its label, which then fits on one line. */
.mantine-Flex-root:has(> div input[type="checkbox"]) { flex-direction: row-reverse; justify-content: flex-end; }
.mantine-Flex-root:has(> div input[type="checkbox"]) > div { flex-grow: 0 !important; }
.mantine-Flex-root:has(> div input[type="checkbox"]) > div:first-child { width: auto !important; padding-left: 0.6em; }
</style>"""

def text(value: object) -> str:
    """Return a value as escaped text without control characters."""
    return escape(printable(value, keep="\n"), quote=True)


def span(value: object, kind: str) -> str:
    """Return text of a kind: dim, big, good, busy, bad or off."""
    return f'<span class="{text(kind)}">{text(value)}</span>'


def line(value: object, kind: str) -> str:
    """Return a line of text of a kind."""
    return f"<div>{span(value, kind)}</div>"


def swatch(color: tuple[int, int, int]) -> str:
    """Return a small square of a color, RGB from 0 to 255."""
    return f'<span class="swatch" style="background: rgb{color}"></span>'


def block(inner: str, name: str, **data: object) -> str:
    """Return a named part of a panel.

    Args:
        inner: HTML, already escaped.
        name: of the part.
        data: its state, as data attributes.
    """
    attributes = "".join(f' data-{key.replace("_", "-")}="{text(value)}"' for key, value in data.items())
    return f'<div class="zc" data-part="{text(name)}"{attributes}>{inner}</div>'


def fields(values: Mapping[str, object], hints: Mapping[str, str] = {}) -> str:
    """Return numbers next to each other, each with its name below, and its meaning where one points at it."""
    cells = (
        f'<div data-field="{text(name)}" title="{text(hints.get(name, ""))}"><b>{text(value)}</b>'
        f'<span class="dim">{text(name)}</span></div>'
        for name, value in values.items()
    )
    return f'<div class="fields">{"".join(cells)}</div>'


def press(label: str, name: str, disabled: str = "", *, arm: bool = False, main: bool = False) -> str:
    """Return a button to click.

    Args:
        label: on the button.
        name: under which `ActionQueue.on_press` has its action.
        disabled: why the button is disabled; empty: it is enabled.
        arm: it moves the arm, so it is also disabled on pages that must not do that.
        main: it is what an operator usually does next.
    """
    return _button(label, f'data-press="{text(name)}"' + arm * _MOVES_ARM, disabled, "main" if main else "")


def hold(label: str, name: str, spoken: str, disabled: str = "") -> str:
    """Return a button that moves the arm while it is held down; `spoken` is its name for screen readers."""
    return _button(label, f'data-hold="{text(name)}"{_MOVES_ARM} aria-label="{text(spoken)}"', disabled, "hold")


def _button(label: str, data: str, disabled: str, kind: str) -> str:
    off = f' aria-disabled="true" title="{text(disabled)}"' if disabled else ""
    return f'<button type="button" class="{text(kind)}" {data}{off}>{text(label)}</button>'


def live(name: str) -> str:
    """Return a number that the status of the control socket updates four times a second."""
    return f'<span class="live" data-live="{text(name)}">–</span>'


def buttons(*items: str, label: str = "") -> str:
    """Return buttons next to each other, after an optional label."""
    return f'<div class="buttons">{span(label, "dim what") if label else ""}{"".join(items)}</div>'


def table(head: Iterable[str], rows: Iterable[str], kind: str = "") -> str:
    """Return a table of rows of `row`; a head that ends in a space belongs to a column of numbers."""
    heads = "".join(
        f'<th class="number">{text(name.strip())}</th>' if name.endswith(" ") else f"<th>{text(name)}</th>"
        for name in head
    )
    shown = f"<tr>{heads}</tr>" if heads else ""
    return f'<table class="{text(kind)}">{shown}{"".join(rows)}</table>'


def row(*cells: str, **data: object) -> str:
    """Return a row of HTML cells; cells that start with a digit or a dash are numbers."""
    attributes = "".join(f' data-{key}="{text(value)}"' for key, value in data.items())
    content = "".join(
        f'<td class="number">{cell}</td>' if cell[:1].isdigit() or cell[:1] == "–" else f"<td>{cell}</td>"
        for cell in cells
    )
    return f"<tr{attributes}>{content}</tr>"


class Html:
    """An HTML element that is sent to browsers only when its content changes."""

    def __init__(self, gui: viser.GuiApi, content: str = "", order: float | None = None) -> None:
        """Add the element at the current position of the GUI, or where viser's `order` puts it."""
        self._handle = gui.add_html(content, order=order)

    @property
    def content(self) -> str:
        """Current content."""
        return self._handle.content

    def remove(self) -> None:
        """Remove the element."""
        self._handle.remove()

    def set(self, content: str) -> None:
        """Replace the content."""
        if content != self._handle.content:
            self._handle.content = content
