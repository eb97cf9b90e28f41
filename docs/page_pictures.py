"""Write the screenshots of the page for docs, each during a real run: `python -m docs.page_pictures [CELL ...]`.

Needs Chromium (apt install chromium).
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import threading
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

HERE = Path(__file__).resolve().parent
ARGUMENTS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
TIMEOUT = 240_000  # [ms]
SPEED = "0.3"  # of the cell: a browser without a GPU draws slowly
# State of the task in which the screenshot of each cell is taken.
STATES = {"panda": "Placing", "ur5": "Tracing", "sorting": "Grasping", "programs": "Running wave: approach1"}
FILES = {"programs": "examples/programs/wave.yaml"}
ZOOM = 6  # turns of the wheel towards the tray
DONE = {"panda": 3, "sorting": 2}  # objects in containers


def take(cell: str, page: Page) -> None:
    """Start the task, wait for its state and write the screenshot."""
    page.locator("canvas").first.wait_for()
    page.get_by_text("STOP", exact=True).wait_for()
    if cell == "programs":
        choose_program(page)
    page.get_by_role("button", name="Run" if cell == "programs" else "Start", exact=True).click()
    if cell in DONE:
        page.wait_for_function(
            f"[...document.querySelectorAll('*')].some(e => e.textContent.startsWith('{DONE[cell]} of'))")
    if cell == "sorting":  # the tray is a small part of the scene
        page.mouse.move(620, 560)
        for _ in range(ZOOM):
            page.mouse.wheel(0, -240)
    page.get_by_text(STATES[cell]).first.wait_for()
    page.wait_for_timeout(1500 if cell == "programs" else 4000)
    page.screenshot(path=HERE / f"page_{cell}.jpg", type="jpeg", quality=80)


def choose_program(page: Page) -> None:
    """Open the example, dry-run it, and choose a step with a breakpoint."""
    page.get_by_role("tab", name="Programs").click()
    page.get_by_label("Program", exact=True).click()
    page.get_by_role("option", name="wave", exact=True).click()
    page.get_by_role("button", name="Dry run").click()
    page.get_by_text("cycle time").last.wait_for()
    page.locator('[data-press="program:choose:move2"]').click()
    page.get_by_role("button", name="Breakpoint", exact=True).click()
    page.locator('[data-press="program:choose:through1"]').click()
    page.get_by_role("button", name="Remove point", exact=True).or_(page.get_by_text("Points", exact=True)).first.wait_for()


def main() -> None:
    """Start each cell and take its screenshot."""
    program = shutil.which("chromium")
    if program is None:
        sys.exit("Chromium is not installed: apt install chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=ARGUMENTS)
        for number, cell in enumerate(sys.argv[1:] or STATES):
            command = [sys.executable, "-m", "cli.main", "up", FILES.get(cell, cell), "--speed", SPEED, "--domain", str(200 + number),
                       "--set", "autostart=false"]
            with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
                assert process.stdout is not None
                address = next(found[1] for line in process.stdout if (found := re.match(r"Open (http\S+)", line)))
                threading.Thread(target=process.stdout.read, daemon=True).start()  # a full pipe would block the cell
                page = browser.new_page(viewport={"width": 1600, "height": 900})
                page.set_default_timeout(TIMEOUT)
                page.goto(address)
                take(cell, page)
                page.close()
                process.terminate()
        browser.close()


if __name__ == "__main__":
    main()
