"""A program that is made on the page runs step by step."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import pytest_asyncio

from applications.programming.files import load_program
from applications.programming.topics import PROGRAM_STATUS
from tests.harness import until
from tests.page.browser.conftest import IN_BROWSER, PATIENCE, Viewed
from tests.page.browser.test_sizes import ELEMENTS, SIZES, check_stop, tab

if TYPE_CHECKING:
    from playwright.async_api import Locator, Page

pytestmark = IN_BROWSER

FIRST = "cell: panda\nsteps:\n  - {step: wait, id: wait1, seconds: 0.1}\n"


@pytest_asyncio.fixture(scope="module", loop_scope="session")
async def cell(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Viewed]:
    """A panda cell whose task is a program."""
    folder = tmp_path_factory.mktemp("programs")
    (folder / "first.yaml").write_text(FIRST)
    nothing_to_draw = Path(__file__).with_name("nothing_to_draw.yaml")
    with Viewed(folder, "up", "first.yaml", "--set", "autostart=false",
                "--set", f"services.viewer.layout={nothing_to_draw}") as cell:
        cell.name = "panda"  # the cell of the program
        yield await cell.served()


def button(page: Page, name: str) -> Locator:
    return page.get_by_role("button", name=name, exact=True).and_(page.locator(":not([aria-disabled])"))


async def test_program_of_three_steps_is_made_and_run_on_the_page(cell: Viewed, page: Page) -> None:
    await tab(page, "Programs")
    await page.get_by_label("New name", exact=True).fill("third")
    await button(page, "New").click()
    await button(page, "Add here").click()
    await page.locator('[data-step="move1"]').wait_for()
    for kind in ("retreat", "wait"):
        await page.get_by_label("Step to add", exact=True).click()
        await page.get_by_role("option", name=kind, exact=True).click()
        await button(page, f"Add {kind}").click()
        await page.locator(f'[data-step="{kind}1"]').wait_for()
    await page.get_by_label("Seconds [s]", exact=True).fill("3")
    await page.locator('[data-step="wait1"]').get_by_text("wait 3 s").wait_for()
    for step in ("retreat1", "wait1"):  # a busy browser may not show a step while it lasts
        await page.locator(f'[data-press="program:choose:{step}"]').click()
        await page.locator(f'[data-press="program:breakpoint:{step}:True"]').click()
        await page.locator(f'[data-press="program:breakpoint:{step}:False"]').wait_for()
    async with cell.listen() as bus:
        status = bus.reader(PROGRAM_STATUS)
        await button(page, "Run").click()
        for step in ("retreat1", "wait1"):
            await until(status, lambda now, step=step: now.step == step and now.halted != "", PATIENCE)
            await page.locator(f'[data-step="{step}"][data-current="True"]').wait_for()
            await button(page, "Continue").click()
        await until(status, lambda now: now.state == "DONE", PATIENCE)
    steps = load_program(cell.folder / "third.yaml").program.steps
    assert [step.id for step in steps] == ["move1", "retreat1", "wait1"] and steps[2].seconds == 3.0


@pytest.mark.parametrize("size", SIZES)
async def test_tab_of_programs_fits_on_the_page(page: Page, size: str) -> None:
    width, height = SIZES[size]
    await page.set_viewport_size({"width": width, "height": height})
    await page.reload()
    await page.get_by_role("button", name="Start").wait_for()
    await tab(page, "Programs")
    await page.locator('[data-press="program:choose:move1"]').click()
    await page.get_by_text("Use present pose").wait_for()
    await check_stop(page)
    await page.wait_for_function(f"() => {{ const seen = ({ELEMENTS})(); return !seen.nameless.length; }}")
    assert not (await page.evaluate(ELEMENTS))["out"]
