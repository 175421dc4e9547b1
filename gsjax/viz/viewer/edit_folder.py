"""Edits on the page: how they are put together, what they come to, and how their film is kept."""

import math
import threading
from collections.abc import Callable
from typing import Any

from gsjax.viz.viewer import words
from gsjax.viz.viewer.newest import Newest
from gsjax.viz.viewer.viewable import Editing, Viewable

_SETTLE_S = 0.5  # without a key pressed
_RED, _AMBER, _GREEN = "#ff6b6b", "#f5b041", "#51cf66"
_HOW = "An edit a line, done one after the other; # before a line leaves it out"


class EditFolder:
    """The part of a page that edits. What its list says is previewed as soon as nobody types.

    Args:
        gui: viser's, of one browser.
        editing: what can be done.
        show: called with the film that edits make, or None: there are none.
        closing: set when a film that is being kept is to end.
        filming: held while one is.
    """

    def __init__(
        self,
        gui: Any,
        editing: Editing,
        show: Callable[[Viewable | None], None],
        closing: threading.Event,
        filming: threading.Lock,
    ):
        self._editing, self._show = editing, show
        self._closing, self._filming = closing, filming
        self._previewed: list[str] = []
        with gui.add_folder("Edit"):
            self._operation = gui.add_dropdown("Operation", tuple(editing.operations))
            self._part = gui.add_dropdown("Part", tuple(editing.parts))
            self._line = gui.add_text("Edit", "", multiline=True)
            self._help = gui.add_html("")
            add = gui.add_button("Add", hint="As the last of the list")
            self._list = gui.add_text("Edits", "", multiline=True, hint=_HOW)
            self._told = gui.add_html("")
            reset = gui.add_button("Reset", color="gray", hint="No edits: the recorded motion")
            self._name = gui.add_text("Film name", "film")
            self._camera = gui.add_dropdown("Seen by", editing.cameras)
            self._save = gui.add_button("Save the film", color="gray", hint="None is written over")
            self._progress = gui.add_progress_bar(0, visible=False)
            self._kept = gui.add_html("")
        self._begin()
        self._worker = Newest(self._preview, _SETTLE_S, math.inf)
        self._operation.on_update(lambda _: self._begin())
        self._part.on_update(lambda _: self._begin())
        add.on_click(lambda _: self._add())
        self._list.on_update(lambda _: self._worker.ask())
        reset.on_click(lambda _: setattr(self._list, "value", ""))
        self._save.on_click(lambda _: self._keep())

    def close(self) -> None:
        """Preview no more; a film that is being kept is kept."""
        self._worker.close()

    def _begin(self) -> None:
        """A line to begin an edit with."""
        operation, part = self._operation.value, self._editing.parts[self._part.value]
        self._line.value = self._editing.begin(operation, part)
        self._help.content = words.explained(self._editing.operations[operation])

    def _add(self) -> None:
        self._list.value = "\n".join(
            [*self._list.value.rstrip().splitlines(), " ".join(self._line.value.split())]
        )

    def _lines(self) -> list[str]:
        """The edits of the list."""
        lines = (line.strip() for line in self._list.value.splitlines())
        return [line for line in lines if line and not line.startswith("#")]

    def _preview(self) -> None:
        lines = self._lines()
        if lines == self._previewed:
            return
        self._previewed = lines
        self._told.content = words.lines(["editing ..."])
        try:
            found = self._editing.preview(lines) if lines else None
            self._show(None if found is None else found.scene)
        except Exception as error:  # in a thread of its own nobody else would hear of it
            self._told.content = words.lines([f"{error}"], _RED)
            return
        doubts = [] if found is None else found.doubts
        told = [] if found is None else [words.length_of(found.scene)]
        self._told.content = words.lines(told, _GREEN) + words.lines(doubts, _AMBER)

    def _keep(self) -> None:
        """Save the film that the list describes; runs in a thread of viser's."""
        if not self._filming.acquire(blocking=False):
            self._kept.content = words.lines(["one film at a time: wait until that which is made is kept"])
            return
        try:
            self._save.disabled, self._progress.value, self._progress.visible = True, 0, True
            self._kept.content = words.lines(["filming ..."])
            lines = self._lines()
            if not lines:
                raise ValueError("expected edits in the list, found none; add one")
            path = self._editing.save(lines, self._name.value.strip(), self._camera.value, self._filmed)
            self._kept.content = words.lines([f"kept as {path}"], _GREEN)
        except Exception as error:  # nobody else would hear of it
            self._kept.content = words.lines([f"{error}"], _RED)
        finally:
            self._save.disabled = self._progress.visible = False
            self._filming.release()

    def _filmed(self, done: int, asked: int) -> bool:
        """Told how far a film is; whether it goes on."""
        self._progress.value = 100 * done / asked
        return not self._closing.is_set()
