"""docs/planners.md knows every planner, every option and every pipeline."""

from pathlib import Path

import pytest

from common.config import Pipeline, check, names_of, read_yaml
from common.planning.planners import load_planner, planner_names

ROOT = Path(__file__).resolve().parent.parent
TEXT = (ROOT / "docs" / "planners.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("planner", planner_names())
def test_planner_and_its_options_are_described(planner: str) -> None:
    assert f"| `{planner}` |" in TEXT
    for option in type(load_planner(planner, {})[1]).model_fields:
        assert f"`{option}`" in TEXT, option


@pytest.mark.parametrize("name", names_of("pipelines"))
def test_pipeline_is_described_and_its_planners_take_its_options(name: str) -> None:
    pipeline = check(Pipeline, read_yaml(ROOT / "config" / "pipelines" / f"{name}.yaml"))
    names = [entry.name for entry in pipeline.planners]
    for entry in pipeline.planners:
        load_planner(entry.name, entry.options)
    assert f"| `{name}` | {', '.join(f'`{n}`' for n in names)} |" in TEXT
