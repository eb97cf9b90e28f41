"""Bad input of `zencell grasp` is one line that names the option, its value and what is expected."""

from pathlib import Path

import pytest

from applications.sorting import verbs
from applications.sorting.learning import train
from common.errors import ConfigError


@pytest.mark.parametrize("kind, values, expected", [
    ("DataOptions", {"out": "a.npz", "tries": "many"}, "--tries: 'many' must be a valid integer"),
    ("DataOptions", {"out": "a.npz", "tries": "0"}, "--tries: 0 must be greater than or equal to 1"),
    ("EvaluateOptions", {"force": "-1"}, "--force: -1"),
    ("EvaluateOptions", {"objects": "1.5"}, "--objects: 1.5"),
])
def test_bad_option_is_one_line(kind: str, values: dict[str, str], expected: str) -> None:
    with pytest.raises(ConfigError) as raised:
        verbs._options(kind, **values)
    assert str(raised.value).startswith(expected) and "\n" not in str(raised.value)


def test_numbers_of_the_command_line_are_converted() -> None:
    options = verbs._options("EvaluateOptions", scenes="12", force="40", error="0.5", seed="3", processes="1")
    assert (options.scenes, options.force, options.error, options.seed) == (12, 40.0, 0.5, 3)


def test_missing_packages_name_their_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(verbs, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"needs the extra `physics`"):
        verbs.evaluate()
    monkeypatch.setattr(train, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"needs the extra `train`"):
        verbs.train(str(tmp_path / "tries.npz"), str(tmp_path / "scorer.onnx"))
