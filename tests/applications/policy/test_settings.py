"""A policy's parameters name what is wrong with their complete path, before any process starts."""

import asyncio

import pytest

from common.config import load_cell
from common.errors import ConfigError
from common.supervision.wiring import wire_service
from tools.check.cell import require_valid_services

SERVICE = "services.policy_runner"


@pytest.mark.parametrize("setting,expected", [
    ("source={callable: no_such_package.mod:policy}", ".source.callable: 'no_such_package.mod:policy' is not a module"),
    ("source={callable: examples.policy.nothing:policy}", ".source.callable: 'examples.policy.nothing:policy' is not"),
    ("source={callable: examples.policy.scripted}", ".source.callable: 'examples.policy.scripted' must be dotted"),
    ("source={callable: '..scripted:policy'}", ".source.callable: '..scripted:policy' must be dotted.module:name"),
    ("source={onnx: nothing.onnx}", ".source.onnx: 'nothing.onnx' is not a file"),
    ("source={onnx: pyproject.toml}", ".source.onnx: 'pyproject.json' cannot be read"),
    ("source={openpi: 'http://host'}", ".source.openpi: 'http://host' must be ws://host:port"),
    ("source={openpi: 'ws://host:1', keys: {images: {front: x}}}", ".source.keys.images: 'front' is no camera"),
    ("cameras={camera: '**'}", ".cameras.camera: '**' is no key, such as camera/image_raw"),
    ("cameras={camera: ''}", ".cameras.camera: '' is no key"),
    ("cameras={'': camera/image_raw}", ".cameras.[key]: '' "),
    ("points={cameras: [{points: 'a/*'}]}", ".points.cameras.0.points"),
])
def test_bad_value_is_one_line_before_any_process_starts(setting, expected):
    with pytest.raises(ConfigError) as raised:
        require_valid_services(load_cell("policy_panda", [f"{SERVICE}.{setting}"]))
    assert str(raised.value).startswith(f"{SERVICE}{expected}") and "\n" not in str(raised.value)


def test_value_that_shows_only_in_use_has_its_complete_path():
    cell = load_cell("policy_panda", [f"{SERVICE}.source={{callable: 'examples.policy.scripted:nothing'}}"])
    require_valid_services(cell)
    choices = "policy, find_ball"
    with pytest.raises(ConfigError, match=rf"^{SERVICE}\.source\.callable: .* no function nothing; choices: {choices}"):
        asyncio.run(asyncio.to_thread(wire_service, cell, cell.services["policy_runner"]))
