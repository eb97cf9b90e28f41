"""Export a program as a readable Python script over the blocking client, which does the same."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from applications.programming.files import ProgramFile
from applications.programming.model import (
    Approach,
    BaseStep,
    Call,
    Condition,
    Force,
    Grip,
    If,
    Insert,
    Loop,
    Motion,
    Move,
    Output,
    Palletize,
    Pick,
    Place,
    Python,
    Retreat,
    Target,
    Through,
    Until,
    Wait,
    walk,
)
from applications.programming.targets import Cell
from common import messages as m
from common.robot.transforms import matrix_to_rpy

PARTS = "applications.programming.scripted"  # functions that exported scripts use


@dataclass
class Exporter:
    """Writes the lines of one script."""

    cell: Cell
    files: Mapping[str, ProgramFile]
    main: str
    parts: set[str] = field(default_factory=set)  # names that are imported from PARTS
    imports: set[str] = field(default_factory=set)
    file: ProgramFile | None = None
    patterns: list[str] = field(default_factory=list)  # variables of the pallets that are filled around a step

    def script(self, cell: str) -> str:
        """Return the script; `cell` is where it runs if it is given no name of a running cell."""
        bodies = [line for name in reversed(list(self.files)) for line in self._function(self.files[name])]
        own = ["import sys", *(["import time"] if "time." in "\n".join(bodies) else [])]
        first = [*own, "", "from zencell import ZencellError, pose" if "ZencellError" in "\n".join(bodies)
                 else "from zencell import pose", "from zencell.blocking import Cell"]
        parts = [f"from {PARTS} import {', '.join(sorted(self.parts))}"] if self.parts else []
        text = [f'"""{self.main}.yaml as a script: python {self.main}.py [NAME of a running cell]."""', "", *first,
                *sorted(self.imports), *parts, "", *bodies, "",
                f"with Cell(sys.argv[1]) if sys.argv[1:] else Cell.start({cell!r}) as cell:",
                f"    {_name(self.main)}(cell)"]
        return "\n".join(text) + "\n"

    def _function(self, file: ProgramFile) -> Iterator[str]:
        self.file = file
        yield ""
        yield f"def {_name(file.name)}(cell):"
        if file.program.note:
            yield f'    """{file.program.note}"""'
        if any(isinstance(step, If | Loop) and step.condition and step.condition.outcome
               for _, step in walk(file.program.steps)):
            yield '    outcome = "succeeded"'
        yield from self._body(file.program.steps, "    ")
        yield ""

    def _body(self, steps: Sequence[BaseStep], indent: str) -> Iterator[str]:
        for step in steps:
            if step.note:
                yield f"{indent}# {step.note}"
            if step.on_failure == "continue":
                yield f"{indent}try:"
                yield from (f"{indent}    {line}" for line in self._lines(step))
                yield f'{indent}    outcome = "succeeded"'
                yield f"{indent}except ZencellError:"
                yield f'{indent}    outcome = "failed"'
            else:
                yield from (f"{indent}{line}" for line in self._lines(step))

    def _lines(self, step: BaseStep) -> Iterator[str]:
        return WRITERS[type(step)](self, step)

    # --- steps ----------------------------------------------------------------------------------------------------

    def _move(self, step: Move) -> Iterator[str]:
        yield from self._required(step)
        target = self._pose(step.to) if step.straight else self._target(step.to)
        yield self._moves(target, step, straight=step.straight)

    def _through(self, step: Through) -> Iterator[str]:
        yield from self._required(step)
        targets = [self._pose(each) if step.straight else self._target(each) for each in step.points]
        if not step.blend:
            yield from (self._moves(target, step, straight=step.straight) for target in targets)
            return
        self.parts.add("blended")
        goals = ", ".join(targets)
        yield self._moves(f"blended(cell, {goals}, radius={step.blend:g}, straight={step.straight})", step,
                          planner="sequence")

    def _approach(self, step: Approach) -> Iterator[str]:
        self.parts.add("backed")
        yield from self._required(step)
        yield f"target = {self._pose(step.to)}"
        yield self._moves(f"backed(target, {step.distance:g}, {step.axis!r})", step)
        yield self._moves("target", step, straight=True)

    def _retreat(self, step: Retreat) -> Iterator[str]:
        self.parts |= {"backed", "near"}
        yield from self._required(step)
        touch = f"near(cell) + {self._touch(step)}" if step.touch else "near(cell)"
        yield (f"cell.arm.move(backed(cell.arm.pose(), {step.distance:g}, {step.axis!r}), straight=True, touch={touch}"
               f"{self._speed(step)})")

    def _grip(self, step: Grip) -> Iterator[str]:
        how = "".join(f", {name}={value:g}" for name, value in (
            ("force", step.force), ("mass", step.mass)) if value)
        if step.expected_width is not None:
            how += f", expected={step.expected_width:g}, tolerance={step.width_tolerance:g}"
        call = {"open": f"cell.gripper.open({how.removeprefix(', ')})" if not step.mass else ""}.get(
            str(step.width), "") or f"cell.gripper.move({0.0 if step.width == 'close' else step.width}{how})"
        if step.holds is None:
            yield call
        else:
            self.parts.add("require_holding")
            yield f"require_holding({call}, holding={step.holds})"

    def _output(self, step: Output) -> Iterator[str]:
        yield f"cell.io.set({step.signal!r}, {step.value!r})"

    def _wait(self, step: Wait) -> Iterator[str]:
        if step.until is None:
            yield f"time.sleep({step.seconds:g})"
            return
        until = step.until
        how = "".join(f", {name}={value:g}" for name, value in (("above", until.above), ("below", until.below))
                      if value is not None)
        yield f"cell.io.wait({until.signal!r}, {until.value!r}, {step.timeout:g}{how})"

    def _loop(self, step: Loop) -> Iterator[str]:
        if step.condition is not None:
            yield f"while {self._condition(step.condition)}:"
        else:
            yield "while True:" if step.count is None else f"for _ in range({step.count}):"
        yield from self._body(step.steps, "    ")

    def _if(self, step: If) -> Iterator[str]:
        yield f"if {self._condition(step.condition)}:"
        yield from self._body(step.then, "    ")
        if step.otherwise:
            yield "else:"
            yield from self._body(step.otherwise, "    ")

    def _call(self, step: Call) -> Iterator[str]:
        yield f"{_name(step.program)}(cell)"

    def _pick(self, step: Pick) -> Iterator[str]:
        self.parts.add("pick")
        how = "".join(f", {name}={getattr(step, name)!r}" for name in ("kind", "role", "object", "force", "timeout")
                      if getattr(step, name) != type(step).model_fields[name].default)
        how += f", outside=[{', '.join(self.patterns)}]" if self.patterns else ""
        yield (f"pick(cell, closing_axis={self.cell.require_gripper().closing_axis!r}, "
               f"approach={self.cell.grasp.approach_clearance:g}, lowest={self.cell.grasp.min_grasp_z:g}{how}"
               f"{self._speed(step)})")

    def _place(self, step: Place) -> Iterator[str]:
        self.parts.add("place")
        yield f"place(cell, {self._pose(step.at)}, {step.distance:g}{self._speed(step)})"

    def _palletize(self, step: Palletize) -> Iterator[str]:
        self.parts |= {"place", "over_slot"}
        self.imports.add("from common.tasks.palletizing import Pattern, slots")
        pattern = f"pattern_{_name(step.id)}"
        yield f"{pattern} = Pattern(**{step.pattern.model_dump(mode='json', exclude_defaults=True)!r})"
        yield f"for slot in slots({pattern}):"
        self.patterns.append(pattern)
        yield from self._body(step.steps, "    ")
        self.patterns.pop()
        yield f"    place(cell, over_slot(cell, slot.pose, {step.height:g}), {step.distance:g}{self._speed(step)})"

    def _until(self, step: Until) -> Iterator[str]:
        yield (f"cell.arm.move_until({step.force:g}, direction={step.direction}, frame={step.frame!r}, "
               f"max_distance={step.max_distance:g}, speed={step.tool_speed:g}{self._touching(step)})")

    def _insert(self, step: Insert) -> Iterator[str]:
        most = f", max_distance={step.max_distance:g}" if step.max_distance is not None else ""
        yield (f"cell.arm.insert({step.depth:g}, force={step.force:g}, direction={step.direction}, "
               f"frame={step.frame!r}{most}{self._touching(step)})")

    def _touching(self, step: Force) -> str:
        return f", touch={self._touch(step)}" if step.touch else ""

    def _python(self, step: Python) -> Iterator[str]:
        self.parts.add("call")
        module, _, name = step.function.partition(":")
        self.imports.add(f"from {module} import {name}")
        arguments = "".join(f", {key}={value!r}" for key, value in step.arguments.items())
        yield f"outcome = call({name}, {step.timeout:g}{arguments})"

    # --- parts of steps ---------------------------------------------------------------------------------------------

    def _required(self, step: Motion) -> Iterator[str]:
        if step.requires:
            yield "# the program also holds the arm while one of these is not so"
        for name, value in step.requires.items():
            yield f"cell.io.wait({name!r}, {value!r})"

    def _moves(self, target: str, step: Motion, *, straight: bool = False, planner: str = "") -> str:
        how = ", straight=True" if straight else ""
        how += f", touch={self._touch(step)}" if step.touch else ""
        how += f", planner={planner!r}" if planner else ""
        return f"cell.arm.move({target}{how}{self._speed(step)})"

    def _touch(self, step: Motion | Force) -> str:
        self.parts.add("ids")
        return f"ids(cell, {step.touch!r})"

    def _speed(self, step: BaseStep) -> str:
        assert self.file is not None
        speed = getattr(step, "speed", None) or self.file.program.speed or self.files[self.main].program.speed
        return f", speed={speed:g}" if speed is not None else ""

    def _condition(self, condition: Condition) -> str:
        if condition.holding is not None:
            return f"cell.gripper.state().holding is {condition.holding}"
        if condition.outcome:
            return f"outcome == {condition.outcome!r}"
        if condition.above is None and condition.below is None:
            return f"cell.io.read({condition.signal!r}) is {condition.value}"
        limits = [f"{condition.above:g} <= " if condition.above is not None else "",
                  f" <= {condition.below:g}" if condition.below is not None else ""]
        return f"{limits[0]}cell.io.read({condition.signal!r}){limits[1]}"

    def _target(self, target: Target) -> str:
        """Return the expression of a target, as `arm.move` accepts it."""
        assert self.file is not None
        target = self.file.program.poses.get(target.name, target)
        if target.position is not None or target.by is not None:
            return self._pose(target)
        if target.joints is not None:
            return repr(list(target.joints))
        goal, _ = self.cell.resolve(target, self.file.program.poses, None)
        assert isinstance(goal, m.JointGoal)
        return repr(goal.named) if goal.named else repr([round(value, 6) for value in goal.positions])

    def _pose(self, target: Target) -> str:
        """Return the expression of a target as a pose (4, 4)."""
        assert self.file is not None
        target = self.file.program.poses.get(target.name, target)
        if target.by is not None:
            self.parts.add("relative")
            return f"relative(cell.arm.pose(), {target.by}, {target.turn}, {target.frame!r})"
        _, T = self.cell.resolve(target, self.file.program.poses, None)
        rpy = [round(float(value), 6) for value in matrix_to_rpy(T[:3, :3])]
        place = ", ".join(f"{round(float(value), 6):g}" for value in T[:3, 3])
        return f"pose({place})" if np.allclose(np.abs(rpy), [np.pi, 0, 0], atol=1e-5) else f"pose({place}, rpy={rpy})"


WRITERS: dict[type[BaseStep], Callable[[Exporter, Any], Iterator[str]]] = {
    Move: Exporter._move, Through: Exporter._through, Approach: Exporter._approach, Retreat: Exporter._retreat,
    Grip: Exporter._grip, Output: Exporter._output, Wait: Exporter._wait, Loop: Exporter._loop, If: Exporter._if,
    Call: Exporter._call, Pick: Exporter._pick, Place: Exporter._place, Palletize: Exporter._palletize,
    Until: Exporter._until, Insert: Exporter._insert, Python: Exporter._python}


def _name(program: str) -> str:
    name = re.sub(r"\W", "_", program)
    return name if name.isidentifier() else f"program_{name}"
