"""Objects that a generator adds to the world."""

from pathlib import Path
from typing import Any

import pytest

from common.config import World
from common.errors import ConfigError, UnknownName
from common.sim.generators import require_generator, with_generated

MODULE = '''
import numpy as np
from pydantic import Field
from common.config import ObjectConfig, Parameters

class Options(Parameters):
    count: int = Field(2, ge=1, le=5)
    name: str = "drawn"

def generate(world, options, seed):
    x = np.random.default_rng(seed).uniform(0.3, 0.6, options.count)
    return [ObjectConfig(id=f"{options.name}_{n}", shape="sphere", radius=0.02, x=float(v), y=0.0)
            for n, v in enumerate(x)]
'''


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    folder = tmp_path / "generators_of_a_user"
    folder.mkdir()
    (folder / "row.py").write_text(MODULE)
    (folder / "empty.py").write_text("")
    monkeypatch.syspath_prepend(str(tmp_path))
    return folder.name


def world(module: str, **options: Any) -> World:
    return World.model_validate({
        "objects": [{"id": "own_0", "shape": "sphere", "radius": 0.03, "x": 0.4, "y": 0.3}],
        "generator": {"module": module, **options}})


def test_generated_objects_follow_those_of_the_world_and_depend_on_the_seed(package: str) -> None:
    config = world(f"{package}.row", count=3)
    first, same, other = (with_generated(config, seed).objects for seed in (1, 1, 2))
    assert [each.id for each in first] == ["own_0", "drawn_0", "drawn_1", "drawn_2"]
    assert first == same != other and len(config.objects) == 1
    assert with_generated(config.model_copy(update={"generator": None}), 1).objects == config.objects


@pytest.mark.parametrize(("module", "options", "error", "text"), [
    ("row", {"count": 9}, ConfigError, "world.generator.count: 9 must be less than or equal to 5"),
    ("row", {"size": 9}, ConfigError, "world.generator.size: 9 is not a parameter; choices: count, name"),
    ("empty", {}, ConfigError, "is no generator: it needs Options and generate"),
    ("missing", {}, ConfigError, "is not a module: there is no missing in"),
    ("", {}, UnknownName, "unknown generator of objects 'generators_of_a_user'"),
])
def test_invalid_generator_is_rejected_before_the_start_with_field_value_and_choices(
    package: str, module: str, options: dict[str, Any], error: type[Exception], text: str
) -> None:
    config = world(f"{package}.{module}".removesuffix("."), **options)
    with pytest.raises(error) as refused:
        require_generator(config)
    assert text in str(refused.value) and "\n" not in str(refused.value)
    with pytest.raises(error):
        with_generated(config, 0)


def test_id_of_two_objects_is_rejected(package: str) -> None:
    with pytest.raises(ConfigError, match="gives two objects one id: own_0"):
        with_generated(world(f"{package}.row", name="own"), 0)
