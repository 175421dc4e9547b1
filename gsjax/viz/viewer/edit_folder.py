"""Edits on the page: composing them, previewing the result, and saving it as a film."""

import math
import threading
from collections.abc import Callable
from typing import Any

from gsjax.viz.viewer import markup
from gsjax.viz.viewer.debounce import Debouncer
from gsjax.viz.viewer.viewable import Editing, Viewable

_SETTLE_S = 0.5  # since the last key press
_HOW = "One edit per line, applied in order; a # before a line disables it"


class EditFolder:
    """The part of a page that edits. Its list of edits is previewed as soon as typing stops.

    Args:
        gui: viser's GUI handle of one browser.
        editing: the available edits.
        show: called with the edited scene, or with None if there are no edits.
        closing: set when a film that is being saved should stop.
        filming: held while a film is being saved.
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
            add = gui.add_button("Add", hint="Append the edit to the list")
            self._list = gui.add_text("Edits", "", multiline=True, hint=_HOW)
            self._status = gui.add_html("")
            reset = gui.add_button("Reset", color="gray", hint="Remove all edits: the recorded motion")
            self._name = gui.add_text("Film name", "film")
            self._camera = gui.add_dropdown("Seen by", editing.cameras)
            self._save_button = gui.add_button("Save the film", color="gray", hint="Nothing is overwritten")
            self._progress = gui.add_progress_bar(0, visible=False)
            self._save_status = gui.add_html("")
        self._suggest()
        self._worker = Debouncer(self._preview, _SETTLE_S, math.inf)
        self._operation.on_update(lambda _: self._suggest())
        self._part.on_update(lambda _: self._suggest())
        add.on_click(lambda _: self._add())
        self._list.on_update(lambda _: self._worker.request())
        reset.on_click(lambda _: setattr(self._list, "value", ""))
        self._save_button.on_click(lambda _: self._save_film())

    def close(self) -> None:
        """Stop previewing; a film that is being saved is still finished."""
        self._worker.close()

    def _suggest(self) -> None:
        """Fill in a template line for the selected operation and part."""
        operation, part = self._operation.value, self._editing.parts[self._part.value]
        self._line.value = self._editing.begin(operation, part)
        self._help.content = markup.operation_help(self._editing.operations[operation])

    def _add(self) -> None:
        self._list.value = "\n".join(
            [*self._list.value.rstrip().splitlines(), " ".join(self._line.value.split())]
        )

    def _lines(self) -> list[str]:
        """The enabled edits of the list."""
        lines = (line.strip() for line in self._list.value.splitlines())
        return [line for line in lines if line and not line.startswith("#")]

    def _preview(self) -> None:
        lines = self._lines()
        if lines == self._previewed:
            return
        self._previewed = lines
        self._status.content = markup.as_lines("editing ...")
        try:
            found = self._editing.preview(lines) if lines else None
            self._show(None if found is None else found.scene)
        except Exception as error:  # runs in its own thread, where an exception would go unnoticed
            self._status.content = markup.as_lines(f"{error}", color=markup.RED)
            return
        doubts = [] if found is None else found.doubts
        summary = [] if found is None else [markup.film_summary(found.scene)]
        self._status.content = markup.as_lines(*summary, color=markup.GREEN) + markup.as_lines(
            *doubts, color=markup.AMBER
        )

    def _save_film(self) -> None:
        """Save the film that the list describes; runs in one of viser's threads."""
        if not self._filming.acquire(blocking=False):
            self._save_status.content = markup.as_lines("one film at a time: wait until this one is saved")
            return
        try:
            self._save_button.disabled, self._progress.value, self._progress.visible = True, 0, True
            self._save_status.content = markup.as_lines("filming ...")
            lines = self._lines()
            if not lines:
                raise ValueError("expected edits in the list, found none; add one")
            name, camera = self._name.value.strip(), self._camera.value
            path = self._editing.save(lines, name, camera, self._report_progress)
            self._save_status.content = markup.as_lines(f"saved as {path}", color=markup.GREEN)
        except Exception as error:  # would otherwise go unnoticed
            self._save_status.content = markup.as_lines(f"{error}", color=markup.RED)
        finally:
            self._save_button.disabled = self._progress.visible = False
            self._filming.release()

    def _report_progress(self, done: int, total: int) -> bool:
        """Show the progress of a film; returns whether to continue."""
        self._progress.value = 100 * done / total
        return not self._closing.is_set()
