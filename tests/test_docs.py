"""The documents match the code."""

import re
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml

from cli.main import app
from common.config import Pipeline, check, names_of, read_yaml
from common.planning.planners import load_planner, planner_names
from docs import generate, reference
from docs.seed_parameters import CONTROLLER
from tests import pages

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted(path.relative_to(ROOT).as_posix() for path in [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"),
                                                              *ROOT.glob("examples/*.md")])


@pytest.mark.parametrize("page", [*generate.PAGES, *generate.TABLES])
def test_generated_text_is_current(page: str) -> None:
    assert (generate.DOCS / page).read_text(encoding="utf-8") == generate.generated(page), "run `make docs`"


def test_every_controller_parameter_of_the_seed_document_has_a_row() -> None:
    names = {part.strip() for row in CONTROLLER for part in row.name.split(",") if not part.startswith("(text)")}
    assert names == {
        "planning_attempts", "planning_time_s", "velocity_scaling", "acceleration_scaling", "cartesian_eef_step",
        "cartesian_min_fraction", "cartesian_speed_scale", "grasp_pos_tol", "place_pos_tol", "orient_tol_rad",
        "orient_yaw_tol_rad", "ball_x", "ball_y", "ball_radius", "ball_z", "approach_clearance", "grasp_clearance",
        "min_grasp_z", "lift_height", "box_x", "box_y", "box_drop_z", "home_x", "home_y", "home_z",
    }


@pytest.mark.parametrize("page", PAGES)
def test_links_within_the_project_resolve(page: str) -> None:
    path = ROOT / page
    for link in re.findall(r"\]\(([^)\s]+)\)", pages.prose(pages.text_of(page))):
        if "://" not in link:
            target, _, anchor = link.partition("#")
            found = (path.parent / target).resolve() if target else path
            assert found.exists() and found.is_relative_to(ROOT), link
            assert not anchor or anchor in pages.anchors(found.read_text(encoding="utf-8")), link


@pytest.mark.parametrize("planner", planner_names())
def test_planner_and_its_options_are_described(planner: str) -> None:
    text = pages.text_of("docs/planners.md")
    assert f"| `{planner}` |" in text
    for option in type(load_planner(planner, {})[1]).model_fields:
        assert f"`{option}`" in text, option


@pytest.mark.parametrize("name", names_of("pipelines"))
def test_pipeline_is_described_and_its_planners_take_its_options(name: str) -> None:
    pipeline = check(Pipeline, read_yaml(ROOT / "config" / "pipelines" / f"{name}.yaml"))
    for entry in pipeline.planners:
        load_planner(entry.name, entry.options)
    names = ", ".join(f"`{entry.name}`" for entry in pipeline.planners)
    assert f"| `{name}` | {names} |" in pages.text_of("docs/planners.md")


NOT_COMMANDS = {"polish", "VERB"}  # of a reader's application; a placeholder


@pytest.fixture(scope="module")
def verbs() -> set[str]:
    return {name.removeprefix("zencell ") for name, _ in reference.verbs_of(typer.main.get_command(app), "zencell")}


@pytest.mark.parametrize("page", [page for page in PAGES if page != "CHANGELOG.md"])
def test_commands_of_a_page_exist(page: str, verbs: set[str]) -> None:
    text = pages.text_of(page)
    code = "".join(block for _, block in pages.blocks(text))
    for words in [*re.findall(r"`zencell\s+([^`]+)`", pages.prose(text)),
                 *re.findall(r"^(?:\.venv/bin/)?zencell (.*)$", code, re.MULTILINE)]:
        verb, *more = words.replace(",", " ").split()
        group = {name.partition(" ")[2] for name in verbs if name.startswith(f"{verb} ")}
        names_one = verb in verbs or (group and (not more or more[0] in group))
        assert names_one or verb in NOT_COMMANDS or verb.startswith("--"), words


def pages_of(nav: Any) -> list[str]:
    """Return the pages of a navigation in order."""
    if isinstance(nav, str):
        return [nav]
    return [page for part in (nav.values() if isinstance(nav, dict) else nav) for page in pages_of(part)]


def test_navigation_of_the_site_lists_every_page_once() -> None:
    site = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    assert sorted(pages_of(site["nav"])) == [page.removeprefix("docs/") for page in PAGES if page.startswith("docs/")]
    tutorials = [page for page in pages_of(site["nav"]) if page.startswith("tutorials/")]
    for number, (page, following) in enumerate(zip(tutorials, [*tutorials[1:], None], strict=True), 1):
        text = pages.text_of(f"docs/{page}")
        assert text.startswith(f"# {number}. ")
        assert following is None or f"]({Path(following).name})" in text.rpartition("\nNext: ")[2], page


def test_site_loads_nothing_from_other_hosts() -> None:
    site = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    assert site["theme"]["font"] is False and site["plugins"] == ["search"]
    assert "repo_url" not in site, "the theme would load its stars"
    assert all((ROOT / "docs" / name).exists() for name in [*site["extra_css"], *site.get("extra_javascript", [])])
    for page in PAGES:
        assert "```mermaid" not in pages.text_of(page), "a script of another host would draw it"
        assert not re.search(r"!\[[^]]*\]\(\w+://|<(?:img|script|iframe)\b", pages.prose(pages.text_of(page))), page
