"""Expand a xacro file in a process of its own, with a request as JSON on stdin and a reply on stdout.

Expressions are restricted before xacro evaluates them: numbers, texts, lists, calls of xacro's own functions, no
attributes but keys and methods of a list. With `trust` they are xacro's own, which can run any Python. In both cases
memory and processor time are limited.
"""

from __future__ import annotations

import ast
import json
import os
import re
import resource
import sys
import sysconfig
from pathlib import Path
from typing import Any

_MEMORY = 1 << 30  # [bytes]
_SECONDS = 10  # of processor time
_MAX_TEXT = 30_000_000  # characters
_NODES = (
    ast.Expression, ast.Name, ast.Load, ast.Store, ast.Constant, ast.BinOp, ast.UnaryOp, ast.BoolOp, ast.Compare,
    ast.operator, ast.unaryop, ast.boolop, ast.cmpop, ast.IfExp, ast.Call, ast.keyword, ast.Attribute, ast.Subscript,
    ast.Slice, ast.List, ast.Tuple, ast.Dict, ast.Set, ast.ListComp, ast.GeneratorExp, ast.comprehension, ast.Starred)
_METHODS: dict[type, str] = {
    str: "split rsplit splitlines strip lstrip rstrip startswith endswith lower upper title capitalize replace join "
         "find rfind count isdigit isalpha",
    dict: "get keys values items", list: "index count", tuple: "index count"}
_SUFFIXES = (".yaml", ".yml", ".json", ".xacro", ".urdf", ".xml", ".srdf", ".gazebo", ".trans")
_FORBIDDEN = ("subprocess.", "socket.", "ctypes.", "shutil.", "os.")
_HIDDEN = {"type", "vars"}  # functions of xacro's expressions that reach objects of the interpreter
_GET = "__attribute"


class _Refused(Exception):
    """Something that a file of a stranger may not do."""


class _Missing(_Refused):
    """A package that was not found."""


def _attribute(value: Any, name: str) -> Any:
    """Return `value.name`: a key of a mapping or namespace, or a harmless method."""
    if isinstance(value, dict) and name in value:
        return value[name]
    if any(isinstance(value, kind) and name in methods.split() for kind, methods in _METHODS.items()):
        return getattr(value, name)
    raise _Refused(f"uses .{name} in an expression, which is no key and no supported method")


class _Restrict(ast.NodeTransformer):
    """Reject what is no plain expression; let attributes go through `_attribute`."""

    def visit(self, node: ast.AST) -> Any:
        if not isinstance(node, _NODES):
            raise _Refused(f"uses {type(node).__name__} in an expression")
        name = getattr(node, "id", None) or getattr(node, "attr", None) or ""
        if name.startswith("_"):
            raise _Refused(f"uses the name {name} in an expression")
        node = self.generic_visit(node)
        if isinstance(node, ast.Attribute):
            get = ast.Name(_GET, ast.Load())
            return ast.copy_location(ast.Call(get, [node.value, ast.Constant(node.attr)], []), node)
        return node


def _evaluate(expression: str, names: dict[str, Any], local: dict[str, Any] | None = None) -> Any:
    tree = _Restrict().visit(ast.parse(expression.strip(), "<expression>", "eval"))
    names.update(__builtins__={}, **{_GET: _attribute})
    return eval(compile(ast.fix_missing_locations(tree), "<expression>", "eval"), names, local)


def _restrict(xacro: Any, substitution: Any) -> None:
    """Replace the evaluation of `${...}` and `$(eval ...)`, and hide the environment."""

    def evaluate(text: str, context: dict[str, Any]) -> str:
        values = {key: substitution.convert_value(value, "auto") for key, value in context.get("arg", {}).items()}
        functions = {key: value for key, value in substitution._eval_dict.items() if not key.startswith("_")}
        return str(_evaluate(text, {"arg": values.__getitem__, "dirname": substitution._eval_dirname,
                                    **functions, "find": substitution._eval_find, **values}))

    def environment(name: str) -> str:
        raise _Refused(f"asks for the environment variable {name}")

    for module, name, function in ((xacro, "safe_eval", _evaluate), (substitution, "_eval", evaluate),
                                   (substitution, "_eval_env", environment),
                                   (substitution, "_eval_optenv", lambda name, default="": default)):
        if not hasattr(module, name):
            raise ImportError(f"this version of xacro has no {name}")
        setattr(module, name, function)
    substitution._eval_dict.update(env=environment, optenv=substitution._eval_optenv)


def _guard(roots: list[str]) -> None:
    """Let the interpreter open only description files in the given folders and in packages, and write nothing."""
    from common.robot.packages import MANIFEST

    library = sysconfig.get_paths()["stdlib"]

    def readable(path: Path) -> bool:
        above = [each for each in (path, *path.parents) if str(each) in roots or (each / MANIFEST).is_file()]
        hidden = bool(above) and any(part.startswith(".") for part in path.relative_to(above[0]).parts)
        return bool(above) and not hidden and path.suffix in _SUFFIXES

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open" and isinstance(arguments[0], (str, bytes)):
            path = Path(os.path.realpath(os.fsdecode(arguments[0])))
            if set(str(arguments[1])) & set("wax+"):
                raise _Refused(f"writes {path}")
            if path.name != MANIFEST and not path.is_relative_to(library) and not readable(path):
                raise _Refused(f"opens {path}, which is no description file of a package or of --package-dir")
        elif event.startswith(_FORBIDDEN) and event not in ("os.listdir", "os.scandir"):
            raise _Refused(f"uses {event}")

    sys.addaudithook(hook)


class _Arguments(dict[str, str]):
    """Arguments of a xacro file, which notes the ones that it asks for."""

    asked: set[str]

    def __getitem__(self, key: str) -> str:
        self.asked.add(key)
        return super().__getitem__(key)

    def __contains__(self, key: object) -> bool:
        self.asked.add(str(key))
        return super().__contains__(key)


def _expand(request: dict[str, Any]) -> dict[str, Any]:
    import xml.dom.expatbuilder  # noqa: F401  (before files are guarded)

    import xacro
    import yaml  # noqa: F401
    from xacro import substitution_args as substitution

    from common.robot.packages import package_paths

    source, found = Path(request["file"]), dict[str, str]()

    def find(name: str) -> str:
        folder = next((each for each in package_paths(name, request["folders"], source) if each.is_dir()), None)
        if folder is None:
            raise _Missing(f"needs the package {name}: --package-dir DIR names a folder with it")
        return found.setdefault(name, str(folder.resolve()))

    extend = xacro.eval_extension
    xacro.eval_extension = lambda text: extend(re.sub(r"\$\(find-pkg-share\s", "$(find ", text))
    substitution._eval_find = find
    substitution._eval_dirname = lambda _=None: os.path.dirname(os.path.abspath(xacro.filestack[-1]))
    substitution._eval_dict["find"] = find
    arguments = _Arguments(request["arguments"])
    arguments.asked = set()
    if not request["trust"]:
        _restrict(xacro, substitution)
        for name in _HIDDEN:
            dict.pop(xacro._global_symbols["python"], name, None)
        _guard([os.path.realpath(each) for each in request["readable"]])
    try:
        text = xacro.process_file(str(source), mappings=arguments, verbosity=0).documentElement.toxml()
    except (Exception, RecursionError) as error:
        reason, refused = _reason(error)
        return {"error": reason, "refused": refused, "asked": sorted(arguments.asked)}
    if len(text) > _MAX_TEXT:
        return {"error": f"expands to more than {_MAX_TEXT // 10**6} MB"}
    return {"text": text, "packages": found, "asked": sorted(arguments.asked)}


def _reason(error: BaseException) -> tuple[str, bool]:
    """Return the cause of an error in one line, and whether `trust` would allow it."""
    inner: Any = error
    while inner is not None and not isinstance(inner, (_Refused, MemoryError, RecursionError)):
        inner = getattr(inner, "exc", None) or inner.__cause__ or inner.__context__
    if isinstance(inner, _Refused):
        return str(inner), not isinstance(inner, _Missing)
    if isinstance(inner, MemoryError):
        return f"needs more than {_MEMORY >> 20} MB", False
    if isinstance(inner, RecursionError):
        return "is nested too deep, or its macros call themselves", False
    exc = getattr(error, "exc", None)
    if type(exc).__name__ == "ArgException":
        return f"needs the argument {exc}: give {exc}:=VALUE", False
    return f"cannot be expanded: {' '.join(str(error).split()) or type(error).__name__}", False


def _limit(kind: int, value: int) -> None:
    _, hard = resource.getrlimit(kind)
    least = value if hard == resource.RLIM_INFINITY else min(value, hard)
    resource.setrlimit(kind, (least, least))


def _main() -> None:
    reply, sys.stdout = sys.stdout, sys.stderr
    request = json.load(sys.stdin)
    sys.path += [request["root"], *request["python"]]
    os.chdir(Path(request["file"]).parent)
    _limit(resource.RLIMIT_AS, _MEMORY)
    _limit(resource.RLIMIT_CPU, _SECONDS)
    if not request["trust"]:
        _limit(resource.RLIMIT_FSIZE, 0)
    try:
        result = _expand(request)
    except MemoryError:
        result = {"error": f"needs more than {_MEMORY >> 20} MB"}
    json.dump(result, reply)
    reply.flush()


if __name__ == "__main__":
    _main()
