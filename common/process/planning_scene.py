"""Publishing the planning scene: perceived objects, and solids that operators added."""

from __future__ import annotations

import asyncio

from common import topics
from common.atomic_file import AtomicFile, Unreadable, state_folder
from common.errors import ConfigError, Refused
from common.messages import PlanningScene, SceneEdit, SceneEditReply
from common.scene.fixtures import AddedSolids, added_id
from common.transport.bus import Bus


class SceneWriter:
    """The planning scene of one service. Added solids are persisted before they are published."""

    def __init__(self, bus: Bus) -> None:
        """Declare the scene and the request that edits it."""
        self._bus, self._out = bus, bus.writer(topics.PLANNING_SCENE)
        self._perceived: PlanningScene | None = None
        self._added, self._editing = AddedSolids(), asyncio.Lock()
        self._file: AtomicFile[AddedSolids] | None = None
        bus.serve(topics.SCENE_EDIT, self._edit)

    async def begin(self, perceived: PlanningScene) -> None:
        """Read the added solids from their file and publish the first scene; call it before `bus.ready`.

        Raises:
            ConfigError: the file cannot be read; without its solids motions could be planned through them.
        """
        await self._bus.acquire_keys()  # before, another process of this name may still write the file
        path = state_folder() / f"{self._bus.cell}.{self._bus.service}.added.json"
        self._file = AtomicFile(path, AddedSolids)
        try:
            self._added = self._file.read()
        except Unreadable as error:
            raise ConfigError("planning_scene", str(path), f"cannot be read: {error.why}. It holds the solids that "
                              "operators added; move it away to start without them") from None
        if self._added.ids:
            self._bus.log.warning("solids from an earlier session: %s; `zencell scene remove` removes them",
                                  ", ".join(self._added.ids))
        self.put(perceived)

    def put(self, perceived: PlanningScene) -> None:
        """Publish the perceived scene together with the added solids."""
        self._perceived = perceived
        self._out.put(perceived.model_copy(update={"objects": [*perceived.objects, *self._added.solids]}))

    async def _edit(self, edit: SceneEdit) -> SceneEditReply:
        async with self._editing:
            assert self._file is not None and self._perceived is not None
            perceived = [each.id for each in self._perceived.objects]
            changed = self._added.apply(edit, perceived)
            if changed is not self._added:
                try:
                    await asyncio.to_thread(self._file.save, changed)
                except OSError as error:
                    raise Refused("not_kept", f"{self._file.path} cannot be written ({error.strerror or error}): the "
                                              "change would be lost at a restart and was not made") from None
                self._added = changed
                self.put(self._perceived)
                self._bus.log.info("%s %s%s", "added" if edit.op == "add" else "removed", added_id(edit.id),
                                   edit.owner and f", by {edit.owner}")
            return SceneEditReply(id=added_id(edit.id), ids=self._added.ids)
