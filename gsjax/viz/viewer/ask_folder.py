"""Queries on the page: scores of a text or a click as heat on the Gaussians, and saving what was found."""

import math
import threading
from collections.abc import Callable
from functools import partial
from typing import Any, get_args

import numpy as np
from jaxtyping import Bool, Float, Int

from gsjax.geometry.spherical_harmonics import SH_C0
from gsjax.scene.gaussians import Gaussians
from gsjax.viz.colors import heat
from gsjax.viz.viewer import markup
from gsjax.viz.viewer.debounce import Debouncer
from gsjax.viz.viewer.drawing import recolored
from gsjax.viz.viewer.viewable import Answer, Asking, Showing, Viewable, redone

_TYPED_S = 0.7  # since the last key press
_SETTLE_S, _PATIENCE_S = 0.05, 0.3  # delays while the threshold slides
_SHADE = 0.35  # brightness of Gaussians below the threshold
_HEAT, _ONLY, _WITHOUT, _SCENE = get_args(Showing)
_PICK_FIRST = "pick something first: click on it in the view"
_ASK_FIRST = "enter a query first"
_BEST_LEVEL = "the best fit"


class AskFolder:
    """The part of a page that queries a field, as soon as typing stops.

    Args:
        gui: viser's GUI handle of one browser.
        scene: the scene that is queried.
        asking: answers the queries.
        show: called with the scene to show instead, or with None for the scene itself.
        picked: returns the Gaussian of the displayed scene that was clicked last, or None.
        frame: returns the current frame.
        in_colour: switches the view to the Gaussians' own colours, which heat overrides.
    """

    def __init__(
        self,
        gui: Any,
        scene: Viewable,
        asking: Asking,
        show: Callable[[Viewable | None], None],
        picked: Callable[[], int | None],
        frame: Callable[[], int],
        in_colour: Callable[[], None],
    ):
        self._scene, self._asking, self._show, self._picked = scene, asking, show, picked
        self._frame, self._in_colour = frame, in_colour
        self._lock, self._num_queries = threading.Lock(), 0  # queries so far
        self._found: Answer | None = None
        self._rows: Int[np.ndarray, "shown"] | None = None  # rows of the scene that are shown; None: all
        with gui.add_folder("Ask"):
            self._text = gui.add_text("What", "", hint=asking.hint)
            like = gui.add_button(
                "Find similar to the pick", color="gray", hint="Click on something in the view first"
            )
            self._level = None
            if asking.levels:
                self._level = gui.add_dropdown(
                    "Level", (_BEST_LEVEL, *asking.levels), hint="Parts of things, or things as a whole"
                )
            self._status = gui.add_html(markup.as_lines(asking.hint))
            self._threshold = gui.add_slider("Threshold", 0.0, 1.0, 0.01, 0.5)
            self._showing = gui.add_dropdown("Shows", get_args(Showing))
            self._count = gui.add_html("")
            keep = gui.add_button("Save it (PLY)", color="gray", hint="The selection; nothing is overwritten")
            rest = gui.add_button("Save the rest (PLY)", color="gray", hint="The scene without it")
            self._save_status = gui.add_html("")
        self._display_worker = Debouncer(self._update_view, _SETTLE_S, _PATIENCE_S)
        self._query_worker = Debouncer(self._ask, _TYPED_S, math.inf)
        self._latest: Callable[[], None] = lambda: None  # asks the latest query again
        self._text.on_update(lambda _: self._query_worker.request())
        like.on_click(lambda _: self._ask_similar())
        if self._level is not None:
            self._level.on_update(lambda _: self._latest())
        self._threshold.on_update(lambda _: self._display_worker.request())
        self._showing.on_update(lambda _: self._display_worker.request())
        keep.on_click(lambda _: self._save_part("object"))
        rest.on_click(lambda _: self._save_part("rest"))

    def close(self) -> None:
        """Stop the threads."""
        self._query_worker.close()
        self._display_worker.close()

    def _ask(self) -> None:
        text, ask = self._text.value.strip(), None
        if text:
            self._latest = self._query_worker.request
            ask = lambda: self._asking.ask(text, self._frame(), self._on_level)  # noqa: E731
        self._answer(ask, self._asking.hint)

    def _ask_similar(self) -> None:
        shown = self._picked()
        row = shown if shown is None or self._rows is None else int(self._rows[shown])
        like = None if row is None else (lambda: self._asking.like(row, self._frame(), self._on_level))
        if like is not None:
            self._latest = partial(self._answer, like, _PICK_FIRST)
        self._answer(like, _PICK_FIRST)

    @property
    def _on_level(self) -> str | None:
        """The level to ask on; None for the best."""
        return None if self._level is None or self._level.value == _BEST_LEVEL else self._level.value

    def _answer(self, ask: Callable[[], Answer] | None, otherwise: str) -> None:
        """Ask and show the heat of the answer, unless a newer query arrived meanwhile; runs in its own thread
        or in one of viser's."""
        if ask is None:
            self._status.content = markup.as_lines(otherwise, color=markup.RED)
            return
        with self._lock:
            self._num_queries += 1
            number = self._num_queries
            self._status.content = markup.as_lines("asking ...")
        try:
            found = ask()
        except Exception as error:  # would otherwise go unnoticed
            with self._lock:
                if number == self._num_queries:
                    self._status.content = markup.as_lines(f"{error}", color=markup.RED)
            return
        with self._lock:
            if number == self._num_queries:
                self._accept(found)

    def _accept(self, found: Answer) -> None:
        """Replace the previous answer."""
        low = float(np.floor(100 * found.scores.min()) / 100)
        high = max(float(np.ceil(100 * found.scores.max()) / 100), low + 0.01)
        self._threshold.min, self._threshold.max, self._found = low, high, found
        self._threshold.value = float(np.clip(found.threshold, low, high))
        self._status.content = markup.as_lines(
            f"{found.what}, in {1e3 * found.seconds:.0f} ms ({found.rule})", color=markup.GREEN
        )
        if self._showing.value == _SCENE:
            self._showing.value = _HEAT
        if self._showing.value == _HEAT:
            self._in_colour()
        self._display_worker.request()

    def _selected(self, found: Answer) -> Bool[np.ndarray, "n"]:
        return found.scores > self._threshold.value

    def _update_view(self) -> None:
        """Show the answer as the controls request it."""
        found, showing = self._found, self._showing.value
        if found is None:
            return
        try:
            selected = self._selected(found)
            self._count.content = markup.as_lines(f"{selected.sum():,} of {len(selected):,} Gaussians")
            if showing == _SCENE:
                self._rows = None
                self._show(None)
            elif showing == _HEAT:
                self._rows = None
                colors = heat_of(self._scene.gaussians, found, selected)
                self._show(redone(self._scene, lambda gaussians: recolored(gaussians, colors)))
            else:
                kept = selected if showing == _ONLY else ~selected
                if not kept.any():
                    self._count.content = markup.as_lines("nothing is left to show", color=markup.RED)
                    return
                self._rows = np.flatnonzero(kept)
                self._show(redone(self._scene, lambda gaussians: gaussians, kept))
        except Exception as error:  # runs in its own thread, where an exception would go unnoticed
            self._count.content = markup.as_lines(f"{error}", color=markup.RED)

    def _save_part(self, which: str) -> None:
        """Save a part of the scene; runs in one of viser's threads."""
        if self._found is None:
            self._save_status.content = markup.as_lines(_ASK_FIRST, color=markup.RED)
            return
        try:
            selected = self._selected(self._found)
            selected = selected if which == "object" else ~selected
            if not selected.any():
                raise ValueError("nothing is left to save")
            path = self._asking.save(selected, f"{self._found.what} {which}", self._frame())
            self._save_status.content = markup.as_lines(f"saved as {path}", color=markup.GREEN)
        except Exception as error:  # would otherwise go unnoticed
            self._save_status.content = markup.as_lines(f"{error}", color=markup.RED)


def heat_of(gaussians: Gaussians, found: Answer, selected: Bool[np.ndarray, "n"]) -> Float[np.ndarray, "n 3"]:
    """A colour for each Gaussian by its score, RGB 0 to 1: bright above the threshold; below it dark, over
    dimmed grey scene colours.

    Args:
        gaussians: the scene.
        found: the answer, with the scores.
        selected: which Gaussians are above the threshold.
    """
    low, high = float(found.scores.min()), float(found.scores.max())
    shares = (found.scores - low) / max(high - low, 1e-9)
    colors = heat(np.where(selected, 0.55 + 0.45 * shares, 0.4 * shares)[None])[0].astype(np.float32) / 255
    grey = np.clip(0.5 + SH_C0 * np.asarray(gaussians.sh0, np.float32)[:, 0], 0, 1).mean(-1, keepdims=True)
    return np.where(selected[:, None], colors, np.clip(_SHADE * grey + colors, 0, 1))
