"""Bad settings of belt picking are one line that names the field and the choices."""

from __future__ import annotations

import pytest

from applications.belt_picking.task import Config
from common.config import load_cell, service_config
from common.errors import ConfigError

PATH = "services.belt_picker."


@pytest.mark.parametrize(("overrides", "message"), [
    ([f"{PATH}belt=other"], "belt: 'other' is no conveyor of the world; choices: belt"),
    ([f"{PATH}window=[0.5, 3.0]"], r"window: .*within the belt, 0 to 1.6"),
    (["world.containers={}"], "world.containers"),
])
def test_bad_setting_is_refused_in_one_line(overrides: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as error:
        service_config(load_cell("conveyor", overrides), "belt_picker", Config).require_usable()
    assert "\n" not in str(error.value)
