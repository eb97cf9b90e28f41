"""Objects that a module adds to the simulated world.

`world.generator.module` names a module (a dotted one, or an entry point `zencell.generators`) with

    class Options(Parameters): ...

    def generate(world: World, options: Options, seed: int) -> list[ObjectConfig]

The other fields of `world.generator` are its options. The same world, options and seed must give the same objects,
also after a restart. Only the process of the simulated hardware calls it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, cast

from common.config import ObjectConfig, Parameters, World
from common.config.basics import check
from common.errors import ConfigError
from common.plugins import find_plugin

GROUP = "zencell.generators"
FIELD = "world.generator"


class ObjectGenerator(Protocol):
    """A module that generates objects."""

    Options: type[Parameters]

    def generate(self, world: World, options: Any, seed: int, /) -> Sequence[ObjectConfig]:
        """Return objects, by the seed."""


def with_generated(world: World, seed: int) -> World:
    """Return the world with the objects of its generator after its own.

    Raises:
        ConfigError: the module is no generator, an option is invalid, or an id is used twice.
    """
    if world.generator is None:
        return world
    module, options = _loaded(world)
    objects = [*world.objects, *module.generate(world, options, seed)]
    ids = [obj.id for obj in objects]
    if twice := {name for name in ids if ids.count(name) > 1}:
        raise ConfigError(f"{FIELD}.module", world.generator.module, f"gives two objects one id: {min(twice)}")
    return world.model_copy(update={"objects": objects})


def require_generator(world: World) -> None:
    """Check that the generator of the world, if any, can be imported and that its options are valid.

    Raises:
        ConfigError, UnknownName: it cannot, or they are not; names the field, the value and the choices.
    """
    if world.generator is not None:
        _loaded(world)


def _loaded(world: World) -> tuple[ObjectGenerator, Parameters]:
    assert world.generator is not None
    name = world.generator.module
    module = find_plugin(GROUP, name, field=f"{FIELD}.module", noun="generator of objects", marker="generate")
    if not hasattr(module, "generate") or not hasattr(module, "Options"):
        raise ConfigError(f"{FIELD}.module", name, "is no generator: it needs Options and generate")
    generator = cast(ObjectGenerator, module)
    return generator, check(generator.Options, world.generator.model_extra or {}, FIELD)
