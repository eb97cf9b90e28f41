"""An ONNX file and its card give the same actions with both runtimes; what does not fit is one line."""

import importlib.util
import json
import random

import numpy as np
import pytest

from applications.policy.decoding import decode
from applications.policy.interface import PolicyFailed
from applications.policy.sources import onnx_file, source
from applications.policy.sources.card import Card
from applications.policy.sources.settings import SourceConfig
from common.errors import ConfigError
from tests.applications.policy.onnx_model import linear_policy
from tests.applications.policy.panda import READY, observation, panda, panda_cell

ROWS = 4
RNG = np.random.default_rng(1)
WEIGHTS, BIAS = RNG.normal(size=(8, 32)) * 0.1, RNG.normal(size=32) * 0.1
NETWORK = linear_policy(WEIGHTS, BIAS, ROWS, cameras=["image"])
CARD = {"format": 1, "joints": panda().joint_names, "kind": "joint_steps", "rate": 20.0, "rows": ROWS, "gripper": True,
        "state": ["positions", "gripper"], "images": {"top": "image"}, "image_size": [32, 24]}
RUNTIMES = [
    "opencv",
    pytest.param("onnxruntime", marks=pytest.mark.skipif(
        importlib.util.find_spec("onnxruntime") is None, reason="needs the extra policy")),
]


def written(folder, network=NETWORK, **changes):
    path = folder / "policy.onnx"
    path.write_bytes(network)
    card = {key: value for key, value in {**CARD, **changes}.items() if value is not None}
    path.with_suffix(".json").write_text(json.dumps(card), encoding="utf-8")
    return path


def made(path, cell=None, runtime="opencv", **settings):
    return source(SourceConfig(onnx=str(path), runtime=runtime, **settings), cell or panda_cell("top"))


@pytest.mark.parametrize("runtime", RUNTIMES)
async def test_network_gets_the_normalised_observation_and_its_output_is_scaled_back(tmp_path, runtime):
    mean, std = RNG.normal(size=8), RNG.uniform(0.5, 2, 8)
    path = written(tmp_path, state_mean=mean.tolist(), state_std=std.tolist(), image_mean=[0.1, 0.2, 0.3],
                   image_std=[0.5, 0.5, 0.5], action_mean=[0.01] * 8, action_std=[0.1] * 8, training={"episodes": 3})
    seen = observation("top")
    chunk = await made(path, runtime=runtime).infer(seen)
    state = (np.array([*seen.positions, seen.gripper]) - mean) / std
    image = ((seen.images["top"] / 255 - [0.1, 0.2, 0.3]) / 0.5).mean()
    expected = (state @ WEIGHTS + BIAS + image).reshape(ROWS, 8) * 0.1 + 0.01
    rows, widths = decode(chunk, seen, panda())
    np.testing.assert_allclose(rows, READY + expected[:, :7], atol=1e-5)
    np.testing.assert_allclose(widths, expected[:, 7], atol=1e-5)
    assert chunk.rate == 20.0


@pytest.mark.parametrize("runtime", RUNTIMES)
async def test_state_may_have_all_parts_and_no_image(tmp_path, runtime):
    weights = np.zeros((22, 7))
    weights[21, 0] = 1.0  # w of the quaternion
    path = written(tmp_path, linear_policy(weights, np.zeros(7), 1), images=None, image_size=None, rows=1,
                   gripper=False, state=["positions", "velocities", "gripper", "tcp"])
    chunk = await made(path, panda_cell(), runtime).infer(observation())
    assert chunk.gripper is None
    turned = observation().tcp[:3, :3]
    assert chunk.values[0, 0] == pytest.approx(np.sqrt(max(0, 1 + np.trace(turned))) / 2, abs=1e-4)


async def test_relative_path_is_searched_in_the_working_directory(tmp_path, monkeypatch):
    written(tmp_path)
    monkeypatch.chdir(tmp_path)
    await made("policy.onnx").infer(observation("top"))


WRONG = [  # name, changes of the card, text
    ("no rate", {"rate": None}, "policy.json.rate: is missing"),
    ("no such kind", {"kind": "speeds"}, "kind: 'speeds' must be"),
    ("other field", {"chunk": 5}, "chunk: 5 is not a parameter; choices: action_mean"),
    ("new format", {"format": 2}, "format: 2 must be 1"),
    ("other joints", {"joints": ["a", "b"]}, "is for joints a, b; the arm has panda_joint1"),
    ("other camera", {"images": {"wrist": "image"}}, "needs camera wrist; the observation has top"),
    ("other size", {"image_size": [96, 96]}, "needs images of 96 x 96; image_size is 32 x 24"),
    ("no size", {"image_size": None}, "image_size must be two numbers"),
    ("short mean", {"state_mean": [0.0]}, "state_mean has 1 values; it must have 8 or none"),
    ("zero std", {"image_std": [0.5, 0.5, 0]}, "image_std.2: 0 must be greater than 0"),
    ("nothing seen", {"state": [], "images": {}}, "needs a state or images"),
    ("other state", {"state": ["positions"]}, "does not run as its card says"),
    ("other input", {"images": {"top": "picture"}}, "does not run as its card says"),
    ("other output", {"output": "action"}, "does not run as its card says"),
    ("other rows", {"rows": 5}, r"must be of shape \(1, 5, 8\), not \(1, 4, 8\)"),
    ("other columns", {"gripper": False}, r"must be of shape \(1, 4, 7\), not"),
]


@pytest.mark.parametrize("runtime", RUNTIMES)
@pytest.mark.parametrize("changes,text", [row[1:] for row in WRONG], ids=[row[0] for row in WRONG])
def test_card_that_does_not_fit_is_one_line(tmp_path, runtime, changes, text):
    with pytest.raises(ConfigError, match=text) as raised:
        made(written(tmp_path, **changes), runtime=runtime)
    assert str(raised.value).startswith("source.onnx: ") and "\n" not in str(raised.value)


def test_cell_without_a_gripper_is_named(tmp_path):
    cell = panda_cell("top")
    with pytest.raises(ConfigError, match="moves a gripper; the cell has none"):
        made(written(tmp_path), type(cell)(cell.joints, cell.cameras, cell.image_size, 0.0))


def test_missing_files_are_named(tmp_path):
    with pytest.raises(ConfigError, match=r"none.onnx' cannot be read: No such file"):
        made(tmp_path / "none.onnx")
    path = written(tmp_path)
    path.with_suffix(".json").write_text("[1, 2", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"policy.json' is no JSON of a card"):
        made(path)
    path.with_suffix(".json").unlink()
    with pytest.raises(ConfigError, match=r"policy.json' cannot be read: No such file"):
        made(path)


@pytest.mark.parametrize("runtime", RUNTIMES)
def test_damaged_file_is_one_line(tmp_path, runtime):
    random.seed(3)
    damaged = [b"no network", NETWORK[:100], NETWORK[:-40], random.randbytes(300),
               NETWORK.replace(b"GlobalAverage", b"Glo\xffalAverage")]  # which crashes OpenCV 5.0
    for data in damaged:
        with pytest.raises(ConfigError, match=r"policy.onnx' (is|does)") as raised:
            made(written(tmp_path, data), runtime=runtime)
        assert "\n" not in str(raised.value) and len(str(raised.value)) < 500


def test_missing_package_is_one_line_with_the_extra(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"source\.runtime: 'onnxruntime' needs the extra `policy`"):
        made(written(tmp_path), runtime="onnxruntime")
    made(written(tmp_path), runtime="auto")


async def test_network_that_fails_or_returns_another_shape_later_is_one_line(tmp_path, monkeypatch):
    policy = made(written(tmp_path))

    def fails(inputs):
        raise RuntimeError("no\nmemory")

    monkeypatch.setattr(policy, "_network", type("", (), {"run": staticmethod(fails)}))
    with pytest.raises(PolicyFailed, match=r"network policy.onnx failed: RuntimeError: no memory"):
        await policy.infer(observation("top"))
    monkeypatch.setattr(policy, "_network", type("", (), {"run": staticmethod(lambda inputs: np.zeros((2, 2)))}))
    with pytest.raises(PolicyFailed, match=r"must be of shape \(1, 4, 8\), not \(2, 2\)"):
        await policy.infer(observation("top"))


def test_card_knows_its_columns():
    assert Card.model_validate({**CARD, "kind": "tcp_steps"}).columns == 7
    assert onnx_file.EXTRA.endswith("'zencell[policy]'")
