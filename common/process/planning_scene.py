"""Writing the planning scene: what a service perceives, and what persons added to it."""

from __future__ import annotations

import asyncio

from common import topics
from common.atomic_file import AtomicFile, Unreadable, state_folder
from common.errors import ConfigError, Refused
from common.messages import PlanningScene, SceneEdit, SceneEditReply
from common.scene.added import AddedSolids, id_of
from common.transport.bus import Bus


class SceneWriter:
    """The planning scene of one service. What persons add is written down first: it outlives the service."""

    def __init__(self, bus: Bus) -> None:
        """Declare the scene, and the request that edits it."""
        self._bus, self._out = bus, bus.writer(topics.PLANNING_SCENE)
        self._perceived: PlanningScene | None = None
        self._added, self._editing = AddedSolids(), asyncio.Lock()
        self._file: AtomicFile[AddedSolids] | None = None
        bus.serve(topics.SCENE_EDIT, self._edit)

    async def begin(self, perceived: PlanningScene) -> None:
        """Put the first scene, with what was added before; call it ahead of `bus.ready`.

        Raises:
            ConfigError: it cannot be known what was added: motion would be planned through it.
        """
        await self._bus.acquire_keys()  # before, another process of this name may still write the file
        path = state_folder() / f"{self._bus.cell}.{self._bus.service}.added.json"
        self._file = AtomicFile(path, AddedSolids)
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
            changed = self._added.edited(edit, perceived)
            if changed is not self._added:
                try:
                    await asyncio.to_thread(self._file.save, changed)
                except OSError as error:
                    raise Refused("not_kept", f"{self._file.path} cannot be written ({error.strerror or error}): it "
                                              "would not outlive a restart, and nothing was changed") from None
                self._added = changed
                self.put(self._perceived)
                self._bus.log.info("%s %s%s", "added" if edit.op == "add" else "removed", id_of(edit.id),
                                   edit.owner and f", by {edit.owner}")
            return SceneEditReply(id=id_of(edit.id), ids=self._added.ids)
