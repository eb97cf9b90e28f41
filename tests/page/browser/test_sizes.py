"""The page at three sizes: STOP, jogging and gripper in reach, every tab has the same elements, and none overflows."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import pytest

from page.layout import TABS
from tests.page.browser.conftest import IN_BROWSER, PATIENCE

if TYPE_CHECKING:
    from playwright.async_api import Page

pytestmark = IN_BROWSER

SIZES = {"usual": (1600, 900), "tablet": (1024, 768), "phone": (390, 844)}

# What is at the center and the corners of STOP, its size, and whether the bar covers any part of the page; the layout
# follows a taller bar in the next frame.
STOP = """async () => {
  await new Promise(drawn => requestAnimationFrame(() => requestAnimationFrame(drawn)));
  const stop = document.querySelector("#zc-stop"), at = stop.getBoundingClientRect();
  const inside = [[0.5, 0.5], [0.05, 0.1], [0.95, 0.9]].every(([x, y]) =>
    document.elementFromPoint(at.x + x * at.width, at.y + y * at.height) === stop);
  const bar = document.querySelector("#zc-bar").getBoundingClientRect();
  const root = document.querySelector("#root").getBoundingClientRect();
  const wide = [...document.querySelectorAll(".zc button")].filter(each => each.offsetParent).map(each =>
    each.getBoundingClientRect()).filter(each => each.right > innerWidth + 1 || each.left < -1);
  return {inside, width: at.width, height: at.height, apart: root.top >= bar.bottom - 1, sideways:
    document.documentElement.scrollWidth > innerWidth, wide: wide.length, red: getComputedStyle(stop).backgroundColor};
}"""

# Labels of all buttons and fields except events (labeled with their time), elements that overflow sideways, and those
# without an accessible name.
ELEMENTS = r"""() => {
  const seen = [...document.querySelectorAll("#root button, #root input, #root label, #root [role=tab]")]
    .filter(each => each.offsetParent);
  const words = each => (each.getAttribute("aria-label") || each.textContent || "").trim();
  const html = each => each.outerHTML.slice(0, 120);
  const out = seen.filter(each => { const at = each.getBoundingClientRect();
    return at.width > 0 && (at.right > innerWidth + 1 || at.left < -1); });
  const nameless = [...document.querySelectorAll("#zc-bar button, .zc button, #root input, #root select")]
    .filter(each => each.offsetParent && !words(each) && !each.getAttribute("aria-labelledby")
      && !(each.labels && each.labels.length) && each.type !== "hidden");
  return {labels: [...new Set(seen.map(words).filter(each => each && !/\d\d:\d\d:\d\d$/.test(each)))].sort(),
    out: out.map(html), nameless: nameless.map(html)};
}"""


# Buttons that an operator uses without scrolling which are covered or too small, and the size of the visible scene.
REACH = """() => {
  const covered = ['[data-press="start"]', '[data-press="gripper:open"]', '[data-press="gripper:close"]',
    '[data-hold="joint:panda_joint1:+"]', '[data-hold="move:base:x:-"]', '[data-hold="turn:base:z:+"]'].filter(name => {
    const button = document.querySelector(name), at = button.getBoundingClientRect();
    return at.height < 24 || document.elementFromPoint(at.x + at.width / 2, at.y + at.height / 2) !== button; });
  const scene = document.querySelector("#root canvas").getBoundingClientRect();
  const panel = document.querySelector('[data-part="orders"]').getBoundingClientRect();
  return {covered, width: scene.width, height: scene.height,
    apart: panel.left >= scene.right - 1 || panel.top >= scene.bottom - 1};
}"""

# Whether a finger that stays on a button for a while, or moves by some pixels first, holds it down.
TOUCH = """async pixels => {
  const button = document.querySelector('[data-hold="joint:panda_joint1:+"]'), at = button.getBoundingClientRect();
  const send = (type, y) => button.dispatchEvent(new PointerEvent(type, {bubbles: true, button: 0, buttons: 1,
    pointerType: "touch", pointerId: 7, clientX: at.x + at.width / 2, clientY: at.y + at.height / 2 + y}));
  send("pointerdown", 0);
  send("pointermove", pixels);
  await new Promise(later => setTimeout(later, 400));
  const held = button.classList.contains("held");
  send("pointerup", pixels);
  return held;
}"""


async def check_stop(page: Page) -> None:
    """Check that STOP is completely visible, large and red, and that nothing overflows."""
    end, fits = time.monotonic() + PATIENCE, False
    while not fits:  # the bar may grow between two frames: its texts come at any time
        seen = await page.evaluate(STOP)
        fits = seen["inside"] and seen["apart"] and not seen["sideways"] and not seen["wide"]
        assert fits or time.monotonic() < end, seen
    assert seen["width"] >= 100 and seen["height"] >= 44, seen
    red, green, blue = (int(part) for part in seen["red"].strip("rgb()").split(","))
    assert red > 180 and green < 80 and blue < 80


async def tab(page: Page, name: str) -> None:
    """Open a tab by its name."""
    await page.get_by_role("tab", name=name).or_(page.get_by_text(name, exact=True)).first.click()


@pytest.fixture(scope="module")
def labels() -> dict[str, str]:
    """Labels of all elements by tab, as the first size has them."""
    return {}


@pytest.mark.timeout(480)  # many checks of a page without a GPU
@pytest.mark.parametrize("size", SIZES)
async def test_stop_is_visible_and_every_tab_complete(page: Page, size: str, labels: dict[str, str]) -> None:
    width, height = SIZES[size]
    await page.set_viewport_size({"width": width, "height": height})
    await page.reload()
    await page.get_by_role("button", name="Start").wait_for()
    await check_stop(page)
    if size == "phone":
        for _ in range(2):
            await page.get_by_text("zencell · panda").click()  # collapses and expands the panel
            await check_stop(page)
    await page.mouse.move(width - 60, height - 60)
    await page.mouse.wheel(0, 2000)
    await check_stop(page)
    for name in TABS:
        await tab(page, name)
        if name == "Cameras":  # only images and layers with data
            await page.get_by_text("Color mask", exact=True).wait_for()
            await page.get_by_text("Depth image", exact=True).wait_for(state="hidden")
        if name == "View":
            await page.get_by_text("Targets", exact=True).wait_for()
            await page.get_by_text("Point cloud", exact=True).wait_for(state="hidden")
        await check_stop(page)
        if name == "Move":
            await page.locator('[data-hold="joint:panda_joint1:+"]:not([aria-disabled])').wait_for()
            await page.wait_for_function(f"() => {{ const at = ({REACH})(); return !at.covered.length && at.apart; }}")
            seen = await page.evaluate(REACH)
            assert seen["width"] >= 300 and seen["height"] >= 200, seen
            assert [await page.evaluate(TOUCH, pixels) for pixels in (14, 0)] == [False, True]
        if name in labels:  # a page that was just loaded shows other elements until all messages have arrived
            await page.wait_for_function(f"wanted => ({ELEMENTS})().labels.join() === wanted", arg=labels[name])
        await page.wait_for_function(f"() => ({ELEMENTS})().nameless.length === 0")
        seen = await page.evaluate(ELEMENTS)
        assert not seen["out"] and seen["labels"], (size, name, seen["out"])
        labels.setdefault(name, ",".join(seen["labels"]))
    await page.get_by_role("button", name="STOP: stop arm and task").click()
    await page.get_by_role("status").get_by_text("Stopped by page").wait_for()
    await page.wait_for_function("""() => { const bar = document.querySelector("#zc-bar");
        return bar.dataset.kind === "busy" && bar.innerText.split("Stopped by").length === 2; }""")
    await tab(page, "Time")
    await page.get_by_role("button", name="− 1 s").dispatch_event("click")
    await page.get_by_role("status").get_by_text("Not live: the scene shows").wait_for()
    await check_stop(page)
    await page.get_by_role("button", name="Live", exact=True).dispatch_event("click")
    await page.locator("#zc-past:empty").wait_for(state="attached")
    for icon in await page.locator("#root .mantine-ActionIcon-root").all():  # settings and commands of the panel
        if await icon.is_visible():
            await icon.click(force=True)
            await check_stop(page)
            break
