"""Writing the planning scene: what a service perceives, and what persons added to it."""

from __future__ import annotations

import asyncio

from common import topics
from common.errors import ConfigError, Refused
from common.kept_file import KeptFile, Unreadable, lasting_folder
from common.messages import PlanningScene, SceneEdit, SceneEditReply
from common.scene.added_solids import AddedSolids, added_id
from common.transport.bus import Bus


class SceneWriter:
    """The planning scene of one service. What persons add is written down first: it outlives the service."""

    def __init__(self, bus: Bus) -> None:
        """Declare the scene, and the request that edits it."""
        self._bus, self._out = bus, bus.writer(topics.PLANNING_SCENE)
        self._perceived: PlanningScene | None = None
        self._added, self._editing = AddedSolids(), asyncio.Lock()
        self._file: KeptFile[AddedSolids] | None = None
        bus.serve(topics.SCENE_EDIT, self._edit)

    async def begin(self, perceived: PlanningScene) -> None:
        """Put the first scene, with what was added before; call it ahead of `bus.ready`.

        Raises:
            ConfigError: it cannot be known what was added: motion would be planned through it.
        """
        await self._bus.owned()  # until then another one of this name may still write
        if not self._bus.declares_only:
            path = lasting_folder() / f"{self._bus.cell}.{self._bus.service}.added.json"
            self._file = KeptFile(path, AddedSolids)
            try:
                self._added = self._file.read()
            except Unreadable as error:
                raise ConfigError("planning_scene", str(path), f"cannot be read: {error.why}. It says which solids "
                                  "were added by persons; move it away to begin with none") from None
            if self._added.ids:
                self._bus.log.warning("added by persons before: %s; `zencell scene remove` takes them out",
                                      ", ".join(self._added.ids))
        self.put(perceived)

    def put(self, perceived: PlanningScene) -> None:
        """Write what is perceived now, with what was added."""
        self._perceived = perceived
        self._out.put(perceived.model_copy(update={"objects": [*perceived.objects, *self._added.solids]}))

    async def _edit(self, edit: SceneEdit) -> SceneEditReply:
        async with self._editing:
            assert self._file is not None and self._perceived is not None
            perceived = [thing.id for thing in self._perceived.objects]
            changed = self._added.apply(edit, perceived)
            if changed is not self._added:
                try:
                    await asyncio.to_thread(self._file.save, changed)
                except OSError as error:
                    raise Refused("not_kept", f"{self._file.path} cannot be written ({error.strerror or error}): it "
                                              "would not outlive a restart, and nothing was changed") from None
                self._added = changed
                self.put(self._perceived)
                self._bus.log.info("%s %s%s", "added" if edit.op == "add" else "removed", added_id(edit.id),
                                   edit.owner and f", by {edit.owner}")
            return SceneEditReply(id=added_id(edit.id), ids=self._added.ids)
