"""The rule names a container by color, size, shape or a function of the user; bad values are one line."""

import threading
import zlib

import pytest

from applications.sorting import rules
from applications.sorting.rules import NoDestination, Rule
from applications.sorting.topics import SeenObject
from common.errors import ConfigError
from common.messages import Vector3

CONTAINERS = ("left", "right")


def thing(color="red", shape="box", length=0.04):
    return SeenObject(id="o1", center=Vector3(), size=Vector3(x=length, y=0.02, z=0.02), color_name=color, shape=shape)


@pytest.mark.parametrize(("by", "where", "seen", "container"), [
    ("color", {}, thing("red"), "left"),
    ("color", {}, thing("blue"), "right"),
    ("color", {"blue": "left"}, thing("blue"), "left"),
    ("color", {"red": "right"}, thing("red"), "right"),
    ("color", {"*": "left"}, thing("blue"), "left"),
    ("color", {"red": "right", "*": "left"}, thing("red"), "right"),
    ("color", {}, thing(""), "right"),
    ("size", {}, thing(length=0.03), "left"),
    ("size", {}, thing(length=0.08), "right"),
    ("size", {"large": "left", "small": "right"}, thing(length=0.08), "left"),
    ("shape", {}, thing(shape="round"), "left"),
    ("shape", {}, thing(shape="long"), "right"),
    ("shape", {"long": "left"}, thing(shape="long"), "left"),
])
def test_rule_names_the_container_of_a_property(by, where, seen, container):
    assert Rule(by, where, CONTAINERS).destination(seen) == container


def test_one_container_gets_everything():
    assert {Rule("color", {}, ("box",)).destination(thing(color)) for color in ("red", "blue")} == {"box"}


@pytest.mark.parametrize(("by", "where", "containers", "text"), [
    ("weight", {}, CONTAINERS, "is no rule; choices: color, size, shape, or module:function"),
    ("color", {"crimson": "left"}, CONTAINERS, "'crimson' is no color; choices: red, orange"),
    ("size", {"red": "left"}, CONTAINERS, "'red' is no size; choices: small, large, or '*'"),
    ("color", {"red": "middle"}, CONTAINERS, "where.red: 'middle' is no destination; choices: left, right"),
    ("color", {}, (), "no container besides the tray"),
    ("my_rules_that_do_not_exist:choose", {}, CONTAINERS, "cannot be imported: ModuleNotFoundError"),
    ("math:choose", {}, CONTAINERS, "is no function: math has no function choose"),
    ("math:pi", {}, CONTAINERS, "is no function"),
    ("math:", {}, CONTAINERS, "must be color, size, shape, or module:function"),
    ("math:floor", {"red": "left"}, CONTAINERS, "has no effect: math:floor names the container itself"),
])
def test_unusable_rule_is_one_line_with_the_choices(by, where, containers, text):
    with pytest.raises(ConfigError) as error:
        Rule(by, where, containers, field="services.sorter.")
    assert text in str(error.value) and "\n" not in str(error.value)


@pytest.fixture
def functions(tmp_path, monkeypatch):
    (tmp_path / "rules_of_a_user.py").write_text(
        "def by_name(thing):\n    return 'right' if thing.id == 'o1' else 'left'\n"
        "def fails(thing):\n    raise ValueError('two\\nlines')\n"
        "def wrong(thing):\n    return 'floor'\n"
        "def number(thing):\n    return 3\n"
        "def exits(thing):\n    raise SystemExit(3)\n"
        "def shows_lines(thing):\n    return type('T', (), {'__repr__': lambda self: 'two\\nlines'})()\n"
        "def changes(thing):\n    thing.id = 'changed'\n    return 'left'\n")
    monkeypatch.chdir(tmp_path)
    return lambda name: Rule(f"rules_of_a_user:{name}", {}, CONTAINERS)


def test_function_of_the_user_names_the_container(functions):
    assert functions("by_name").destination(thing()) == "right"


@pytest.mark.parametrize(("name", "text"), [
    ("fails", "fails: ValueError: two lines"),
    ("wrong", "returns 'floor', which is no destination; choices: left, right"),
    ("number", "returns 3, which is no destination"),
    ("exits", "fails: SystemExit: 3"),
    ("shows_lines", "returns two lines, which is no destination"),
])
def test_failing_function_of_the_user_gives_a_reason_in_one_line(functions, name, text):
    with pytest.raises(NoDestination) as error:
        functions(name).destination(thing())
    assert text in str(error.value) and "\n" not in str(error.value)


def test_function_of_the_user_cannot_change_what_was_seen(functions):
    seen = thing()
    assert functions("changes").destination(seen) == "left"
    assert seen.id == "o1"


@pytest.mark.parametrize(("source", "text"), [
    ("async def rule(thing):\n    return 'left'\n", "is a coroutine function; needs a plain function"),
    ("def rule():\n    return 'left'\n", "must take one argument, the SeenObject"),
    ("def rule(thing, other):\n    return 'left'\n", "must take one argument, the SeenObject"),
    ("raise SystemExit(4)\n", "cannot be imported: SystemExit: 4"),
])
def test_unusable_function_is_reported_before_the_cell_starts(tmp_path, monkeypatch, source, text):
    module = f"unusable_{zlib.crc32(source.encode())}"
    (tmp_path / f"{module}.py").write_text(source)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=text):
        Rule(f"{module}:rule", {}, CONTAINERS)


def test_function_that_does_not_return_blocks_the_task_only_once(monkeypatch):
    monkeypatch.setattr(rules, "LONGEST_CALL", 0.01)
    calls, release = [], threading.Event()

    def waits(thing):
        calls.append(thing.id)
        release.wait(10)
        return "left"

    monkeypatch.setattr(rules, "_imported", lambda *_: waits)
    rule = Rule("mine:waits", {}, CONTAINERS)
    for _ in range(3):
        with pytest.raises(NoDestination, match=r"mine:waits takes longer than 0\.01 s"):
            rule.destination(thing())
    assert calls == ["o1"], "one call waits, no other one starts"
    release.set()
    rule._call.join(10)
    monkeypatch.setattr(rules, "LONGEST_CALL", 10)
    assert rule.destination(thing()) == "left"
