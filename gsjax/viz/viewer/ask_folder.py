"""Questions on the page: what a text means, as heat on the Gaussians, and what is done with those found."""

import math
import threading
from collections.abc import Callable
from typing import Any, get_args

import numpy as np
from jaxtyping import Bool, Float, Int

from gsjax.geometry.spherical_harmonics import SH_C0
from gsjax.scene.gaussians import Gaussians
from gsjax.viz.colors import heat
from gsjax.viz.viewer import words
from gsjax.viz.viewer.drawing import recolored
from gsjax.viz.viewer.newest import Newest
from gsjax.viz.viewer.viewable import Asking, Found, Showing, Viewable, redone

_TYPED_S = 0.7  # without a key pressed
_SETTLE_S, _PATIENCE_S = 0.05, 0.3  # of the threshold, while it slides
_SHADE = 0.35  # of the brightness of what is not meant
_RED, _GREEN = "#ff6b6b", "#51cf66"
_HEAT, _ONLY, _WITHOUT, _SCENE = get_args(Showing)
_PICK_FIRST = "pick something first: click on it in the view"
_ASK_FIRST = "ask something first"


class AskFolder:
    """The part of a page that asks a field, as soon as nobody types.

    Args:
        gui: viser's, of one browser.
        scene: that is asked about.
        asking: who answers.
        show: called with what is to be shown in place of the scene, or None: the scene itself.
        picked: which Gaussian of what is shown was clicked on last, or None.
        frame: that is looked at.
        in_colour: has Gaussians shown in their colours, which heat is one of.
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
        self._lock, self._asked = threading.Lock(), 0  # questions so far
        self._found: Found | None = None
        self._rows: Int[np.ndarray, "shown"] | None = None  # of the scene, that are shown; None: all
        with gui.add_folder("Ask"):
            self._text = gui.add_text("What", "", hint=asking.hint)
            like = gui.add_button(
                "Ask for what is picked", color="gray", hint="Click on it in the view first"
            )
            self._told = gui.add_html(words.lines([asking.hint]))
            self._threshold = gui.add_slider("Threshold", 0.0, 1.0, 0.01, 0.5)
            self._showing = gui.add_dropdown("Shows", get_args(Showing))
            self._count = gui.add_html("")
            keep = gui.add_button("Save it (PLY)", color="gray", hint="What was found; none is written over")
            rest = gui.add_button("Save the rest (PLY)", color="gray", hint="The scene without it")
            self._kept = gui.add_html("")
        self._worker = Newest(self._bring, _SETTLE_S, _PATIENCE_S)
        self._listener = Newest(self._ask, _TYPED_S, math.inf)
        self._text.on_update(lambda _: self._listener.ask())
        like.on_click(lambda _: self._like())
        self._threshold.on_update(lambda _: self._worker.ask())
        self._showing.on_update(lambda _: self._worker.ask())
        keep.on_click(lambda _: self._keep("object"))
        rest.on_click(lambda _: self._keep("rest"))

    def close(self) -> None:
        """Show nothing any more."""
        self._listener.close()
        self._worker.close()

    def _ask(self) -> None:
        text = self._text.value.strip()
        self._answer((lambda: self._asking.ask(text, self._frame())) if text else None, self._asking.hint)

    def _like(self) -> None:
        shown = self._picked()
        row = shown if shown is None or self._rows is None else int(self._rows[shown])
        like = None if row is None else (lambda: self._asking.like(row, self._frame()))
        self._answer(like, _PICK_FIRST)

    def _answer(self, ask: Callable[[], Found] | None, otherwise: str) -> None:
        """Ask, and show the heat of the answer, unless another question came meanwhile; runs in a thread of
        its own or of viser's."""
        if ask is None:
            self._told.content = words.lines([otherwise], _RED)
            return
        with self._lock:
            self._asked += 1
            number = self._asked
            self._told.content = words.lines(["asking ..."])
        try:
            found = ask()
        except Exception as error:  # nobody else would hear of it
            with self._lock:
                if number == self._asked:
                    self._told.content = words.lines([f"{error}"], _RED)
            return
        with self._lock:
            if number == self._asked:
                self._take(found)

    def _take(self, found: Found) -> None:
        """An answer takes the place of the one before."""
        low, high = (
            float(np.floor(100 * found.scores.min()) / 100),
            float(np.ceil(100 * found.scores.max()) / 100),
        )
        self._threshold.min, self._threshold.max = low, max(high, low + 0.01)
        self._found = found
        self._threshold.value = float(np.clip(found.threshold, low, max(high, low + 0.01)))
        self._told.content = words.lines(
            [f"{found.what}, in {1e3 * found.seconds:.0f} ms ({found.rule})"], _GREEN
        )
        if self._showing.value == _SCENE:
            self._showing.value = _HEAT
        if self._showing.value == _HEAT:
            self._in_colour()
        self._worker.ask()

    def _selected(self, found: Found) -> Bool[np.ndarray, "n"]:
        return found.scores > self._threshold.value

    def _bring(self) -> None:
        """Show what is wanted now."""
        found, showing = self._found, self._showing.value
        if found is None:
            return
        try:
            selected = self._selected(found)
            self._count.content = words.lines([f"{selected.sum():,} of {len(selected):,} Gaussians"])
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
                    self._count.content = words.lines(["nothing is left to be shown"], _RED)
                    return
                self._rows = np.flatnonzero(kept)
                self._show(redone(self._scene, lambda gaussians: gaussians, kept))
        except Exception as error:  # in a thread of its own nobody else would hear of it
            self._count.content = words.lines([f"{error}"], _RED)

    def _keep(self, which: str) -> None:
        """Save a part of the scene; runs in a thread of viser's."""
        if self._found is None:
            self._kept.content = words.lines([_ASK_FIRST], _RED)
            return
        try:
            selected = self._selected(self._found)
            selected = selected if which == "object" else ~selected
            if not selected.any():
                raise ValueError("nothing is left to be saved")
            path = self._asking.save(selected, f"{self._found.what} {which}", self._frame())
            self._kept.content = words.lines([f"kept as {path}"], _GREEN)
        except Exception as error:  # nobody else would hear of it
            self._kept.content = words.lines([f"{error}"], _RED)


def heat_of(gaussians: Gaussians, found: Found, selected: Bool[np.ndarray, "n"]) -> Float[np.ndarray, "n 3"]:
    """A colour for each Gaussian by its score, RGB 0 to 1: bright above the threshold; below it dark, over a
    grey shade of what is there.

    Args:
        gaussians: the scene.
        found: their scores.
        selected: which are above the threshold.
    """
    low, high = float(found.scores.min()), float(found.scores.max())
    shares = (found.scores - low) / max(high - low, 1e-9)
    colors = heat(np.where(selected, 0.55 + 0.45 * shares, 0.4 * shares)[None])[0].astype(np.float32) / 255
    grey = np.clip(0.5 + SH_C0 * np.asarray(gaussians.sh0, np.float32)[:, 0], 0, 1).mean(-1, keepdims=True)
    return np.where(selected[:, None], colors, np.clip(_SHADE * grey + colors, 0, 1))
