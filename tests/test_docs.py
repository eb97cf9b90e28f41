"""The documents say what the code says."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from docs import generate
from docs.seed_parameters import CONTROLLER

ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.parametrize("name", ["docs/parameters.md", "README.md"])
def test_generated_text_is_current(name: str) -> None:
    text = (ROOT / name).read_text(encoding="utf-8")
    made = generate.parameters() if name.startswith("docs") else generate.readme(text)
    assert text == made, "run `make docs`"


def test_every_controller_parameter_of_the_seed_document_has_a_row() -> None:
    names = {part.strip() for row in CONTROLLER for part in row.name.split(",") if not part.startswith("(text)")}
    assert names == {
        "planning_attempts", "planning_time_s", "velocity_scaling", "acceleration_scaling", "cartesian_eef_step",
        "cartesian_min_fraction", "cartesian_speed_scale", "grasp_pos_tol", "place_pos_tol", "orient_tol_rad",
        "orient_yaw_tol_rad", "ball_x", "ball_y", "ball_radius", "ball_z", "approach_clearance", "grasp_clearance",
        "min_grasp_z", "lift_height", "box_x", "box_y", "box_drop_z", "home_x", "home_y", "home_z",
    }


@pytest.mark.parametrize("page", sorted(p.relative_to(ROOT).as_posix() for p in [
    *ROOT.glob("*.md"), *ROOT.glob("docs/*.md")]))
def test_links_within_the_project_lead_somewhere(page: str) -> None:
    path = ROOT / page
    for link in re.findall(r"\]\(([^)#]+)[^)]*\)", path.read_text(encoding="utf-8")):
        if "://" not in link:
            assert (path.parent / link).exists(), link
