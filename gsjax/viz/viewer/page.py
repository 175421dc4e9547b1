"""The page of one browser: its controls, and what happens when they are used."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from gsjax.viz.viewer import markup
from gsjax.viz.viewer.ask_folder import AskFolder
from gsjax.viz.viewer.cameras import (
    Pose,
    browser_camera,
    distance_along,
    first_pose,
    frustum_size,
    picture_size,
    pose_of,
)
from gsjax.viz.viewer.debounce import Debouncer
from gsjax.viz.viewer.drawing import Drawer, Shown, picture_of, recolored
from gsjax.viz.viewer.edit_folder import EditFolder
from gsjax.viz.viewer.pick import Picked, pick
from gsjax.viz.viewer.player import Player, frame_pause
from gsjax.viz.viewer.shot_nodes import ShotNodes, shrunk
from gsjax.viz.viewer.splat_nodes import Appearance, Displayed, SplatNodes
from gsjax.viz.viewer.splats import Palette, depth_range
from gsjax.viz.viewer.viewable import Shots, Viewable

Save = Callable[[str, np.ndarray], Path]
"""Saves a picture [H,W,3] under a name made from its kind; returns the path."""

WIDTHS = ("160", "240", "320", "480", "640", "960", "1280")
_WIDTH = "320"
_PHOTOGRAPH = 640  # longer side in pixels of a photograph shown beside the render
_SETTLE_S, _PATIENCE_S = 0.12, 0.6  # delays of the render while the camera moves
_TIMEOUT_S = 30.0  # for the browser's own picture
_NUMBERED = "A PNG with the next free number; nothing is overwritten"
_MARK = (255, 70, 160)


@dataclass(frozen=True)
class Shared:
    """State shared by all pages of a viewer.

    Attributes:
        scene: the scene that is shown.
        drawer: our rasterizer, with its compiled programs.
        max_gaussians: the most Gaussians sent to a browser.
        save: saves screenshots; with None they are only offered for download.
        closing: set when the viewer closes, which ends any film that is being saved.
        filming: held while a film is being saved: one at a time across all browsers.
    """

    scene: Viewable
    drawer: Drawer
    max_gaussians: int
    save: Save | None
    closing: threading.Event = field(default_factory=threading.Event)
    filming: threading.Lock = field(default_factory=threading.Lock)


class Page:
    """One browser. Callbacks record what is requested; two threads update the splats and the render.

    Args:
        client: viser's handle of the connected browser.
        shared: state shared by all pages.
    """

    def __init__(self, client: Any, shared: Shared):
        self._client, self._shared, scene = client, shared, shared.scene
        self._frame, self._picture = 0, None
        self._now = Displayed(scene, Palette(scene), 0, scene.at(0))
        self._picked: Picked | None = None
        self._shot: int | None = None
        self._photographed: tuple[Shots, int, int] | None = None
        self._start = first_pose(scene)
        self._player = Player(self._step, lambda: frame_pause(self._now.scene.times), self._label_play)
        self._lock = threading.Lock()
        self._splats = SplatNodes(client.scene, scene, shared.max_gaussians)
        # The controls can be used before the whole page is built.
        self._sender = Debouncer(self._send_splats, 0.0, 0.0, hold=True)
        self._renderer = Debouncer(self._render, _SETTLE_S, _PATIENCE_S, hold=True)
        self._shots = None if scene.shots is None else self._frusta(scene.shots)
        self._build()
        self._send_splats()
        self._sender.start()
        self._renderer.start()
        client.camera.on_update(lambda _: self._moved())
        client.scene.on_click()(self._clicked)
        self._renderer.request()

    def close(self) -> None:
        """Stop the threads of this page."""
        self._player.close()
        self._sender.close()
        self._renderer.close()
        if self._edits is not None:
            self._edits.close()
        if self._questions is not None:
            self._questions.close()
        if self._shots is not None:
            self._shots.close()

    # The controls on the page.

    def _build(self) -> None:
        gui, scene = self._client.gui, self._shared.scene
        gui.add_markdown(markup.heading(scene, min(scene.gaussians.num, self._shared.max_gaussians)))
        if scene.num_frames > 1:
            with gui.add_folder("Time"):
                last = scene.num_frames - 1
                self._slider = gui.add_slider("Frame", min=0, max=last, step=1, initial_value=0)
                self._moment = gui.add_markdown(markup.frame_label(scene, 0))
                self._play = gui.add_button("Play", color="gray")
                self._slider.on_update(lambda _: self._to_frame(int(self._slider.value)))
                self._play.on_click(lambda _: self._player.toggle())
        self._edits = None
        if scene.editing is not None and scene.num_frames > 1:
            shared = self._shared
            self._edits = EditFolder(gui, scene.editing, self._show, shared.closing, shared.filming)
        self._questions = None
        if scene.asking is not None and self._edits is None:
            self._questions = AskFolder(
                gui,
                scene,
                scene.asking,
                show=self._show,
                picked=lambda: None if self._picked is None else self._picked.index,
                frame=lambda: self._frame,
                in_colour=lambda: setattr(self._coloring, "value", "colour"),
            )
        with gui.add_folder("View (splats, drawn by the browser)"):
            self._coloring = gui.add_dropdown("Colour by", scene.colorings)
            self._legend = gui.add_html("", visible=False)
            back = gui.add_button("Reset the camera", color="gray", hint="Back to the initial view")
            self._coloring.on_update(lambda _: self._moved())
            back.on_click(lambda _: self._go(self._start))
        if self._shots is not None:
            self._build_shots(self._shots)
        with gui.add_folder("Picked"):
            self._picked_info = gui.add_markdown(markup.HOW_TO_PICK)
        with gui.add_folder("Screenshot"):
            ours = gui.add_button("Save the render", color="gray", hint=_NUMBERED)
            theirs = gui.add_button("Save the view", color="gray", hint="As the browser draws it")
            ours.on_click(lambda _: self._save_screenshot("render", self._picture))
            theirs.on_click(lambda _: self._save_screenshot("view", self._browser_picture()))
        panel = gui.add_panel()
        with panel.add_tab("Render by gsjax"):
            self._image = gui.add_image(np.full((208, 320, 3), 40, np.uint8), format="png")
            self._status = gui.add_markdown("Compiling ...")
            extra: tuple[Shown, ...] = ("label", "features")
            shows = ("colour", "depth", "alpha", *(name for name in extra if name in scene.colorings))
            self._shown = gui.add_dropdown("Shows", shows)
            self._width = gui.add_dropdown("Width", WIDTHS, initial_value=_WIDTH, hint="In pixels")
            self._photograph = gui.add_image(np.zeros((1, 1, 3), np.uint8), visible=False)
            self._shown.on_update(lambda _: self._renderer.request())
            self._width.on_update(lambda _: self._renderer.request())
        panel.dock_left()
        panel.set_width(350)

    def _build_shots(self, nodes: ShotNodes) -> None:
        gui = self._client.gui
        with gui.add_folder("Photographs"):
            frustums = gui.add_checkbox("Show where they were taken", False)
            self._visited = gui.add_dropdown("Look from", ("...", *self._names))
            frustums.on_update(lambda _: nodes.show(frustums.value, self._frame))
            self._visited.on_update(lambda _: self._visit(self._visited.value))

    def _frusta(self, shots: Shots) -> ShotNodes:
        self._names = unique(shots.names)

        def go(shot: int) -> None:
            self._visited.value = "..."  # viser ignores a value that is already set
            self._visited.value = self._names[shot]  # its callback moves the camera

        return ShotNodes(self._client.scene, shots, frustum_size(self._shared.scene), go)

    # Callbacks of the controls.

    def _moved(self) -> None:
        """The camera or the settings of the view changed."""
        self._renderer.request()
        self._sender.request()

    def _show(self, scene: Viewable | None) -> None:
        """Show another scene, such as a film or a part of the scene; None restores the original scene."""
        scene = self._shared.scene if scene is None else scene
        first, last = scene.at(0), scene.num_frames - 1  # compiles what is needed before anything is shown
        with self._lock:
            self._frame = min(self._frame, last)
            self._now = Displayed(scene, Palette(scene), 0, first)
        if self._shared.scene.num_frames > 1:
            self._slider.value = min(int(self._slider.value), last)
            self._slider.max = max(last, 1)  # a slider cannot have length zero
            self._to_frame(self._frame)
        else:
            self._unpick()
            self._moved()

    def _to_frame(self, frame: int) -> None:
        with self._lock:
            scene = self._now.scene
            self._frame = frame = min(frame, scene.num_frames - 1)
        self._moment.content = markup.frame_label(scene, frame)
        if self._shots is not None and scene.shots is not None:
            self._shots.move(scene.shots, frame)
        self._unpick()
        self._moved()

    def _unpick(self) -> None:
        """Clear the pick: the Gaussian may have moved away from its mark, or no longer exist."""
        if self._picked is not None:
            self._mark(None)
            self._picked_info.content = markup.HOW_TO_PICK

    def _step(self) -> None:
        """Go to the next frame, or from the last to the first."""
        self._slider.value = (int(self._slider.value) + 1) % self._now.scene.num_frames

    def _label_play(self, plays: bool) -> None:
        self._play.label = "Stop" if plays else "Play"

    def _visit(self, name: str) -> None:
        """Move the camera to where a photograph was taken; `_render` then shows the photograph too."""
        now = self._current()
        shots = now.scene.shots
        if shots is None or name not in self._names:
            return
        self._shot = shot = self._names.index(name)
        distance = distance_along(now.gaussians, shots.viewmats[shots.at(now.frame), shot])
        self._go(pose_of(shots, now.frame, shot, distance))
        self._renderer.request()

    def _go(self, pose: Pose) -> None:
        camera = self._client.camera
        with self._client.atomic():
            camera.position = pose.position
            camera.look_at = pose.target
            camera.up_direction = pose.up
            camera.fov = pose.fov

    def _clicked(self, event: Any) -> None:
        now = self._current()
        picked = pick(now.gaussians, np.array(event.ray_origin), np.array(event.ray_direction))
        self._mark(picked)
        self._picked_info.content = markup.describe_pick(now.scene, picked, now.frame)

    def _mark(self, picked: Picked | None) -> None:
        """Show the shape of the picked Gaussian; None removes the mark."""
        for part in ("shape", "name"):
            self._client.scene.remove_by_name(f"/picked/{part}")
        self._picked = picked
        if picked is None:
            return
        (scene, _, _, gaussians), row = self._current(), picked.index
        center = np.asarray(gaussians.means, np.float64)[row]
        quat = np.asarray(gaussians.quats, np.float64)[row]
        self._client.scene.add_icosphere(
            "/picked/shape",
            color=_MARK,
            wireframe=True,
            scale=tuple(2 * np.exp(np.asarray(gaussians.log_scales, np.float64)[row])),
            wxyz=quat / np.linalg.norm(quat),
            position=center,
            cast_shadow=False,
        )
        name = scene.name_of(row)
        text = f"{row}" if name is None else f"{name}, {row}"
        self._client.scene.add_label("/picked/name", text, position=center, anchor="bottom-left")

    # Work of the two threads.

    def _current(self) -> Displayed:
        """What should be displayed now."""
        with self._lock:
            if self._now.frame != self._frame:
                gaussians = self._now.scene.at(self._frame)
                self._now = self._now._replace(frame=self._frame, gaussians=gaussians)
            return self._now

    def _view(self, now: Displayed, width: int) -> tuple[Any, tuple[float, float] | None]:
        """The browser's camera for a picture of this width, and the range of depths it sees."""
        camera = self._client.camera
        width, height = picture_size(width, (camera.image_width, camera.image_height))
        seen = browser_camera(camera.wxyz, camera.position, camera.fov, width, height, now.scene.near)
        means = np.asarray(now.gaussians.means)
        return seen, depth_range(means, np.asarray(seen.viewmat[0]), camera.fov, width / height)

    def _send_splats(self) -> None:
        try:
            self._recolor()
        except Exception as error:  # runs in its own thread, where an exception would go unnoticed
            self._notify("The splats cannot be shown", str(error), color="red")

    def _recolor(self) -> None:
        now, coloring = self._current(), self._coloring.value
        look = Appearance(coloring)
        if coloring == "depth":
            seen, depths = self._view(now, int(_WIDTH))
            look = Appearance(coloring, np.asarray(seen.viewmat[0], np.float64), depths)
        self._splats.show(now, look)
        labels = [] if now.scene.labels is None else np.unique(now.scene.labels).tolist()
        self._legend.content = markup.legend(now.scene, coloring, look.depths, labels)
        self._legend.visible = bool(self._legend.content)

    def _render(self) -> None:
        try:
            now, shown = self._current(), self._shown.value
            camera, depths = self._view(now, int(self._width.value))
            gaussians = now.gaussians
            if shown in ("label", "features"):
                rows = np.arange(gaussians.num)
                colors = now.palette(shown, np.asarray(gaussians.means), rows, None, None)
                gaussians = recolored(gaussians, colors)
            drawn = self._shared.drawer(gaussians, camera)
            picture = picture_of(drawn, shown, depths)
            self._image.image = picture
            info = f"{camera.width} x {camera.height} pixels, all {gaussians.num:,} Gaussians"
            if shown == "depth" and depths is not None:
                near, far = (markup.format_length(value, now.scene.unit) for value in depths)
                info += f"; bright: {near} away, dark: {far}"
            self._status.content = info
            self._picture = picture  # only after its status is set
            self._show_photograph(now)
        except Exception as error:  # runs in its own thread, where an exception would go unnoticed
            self._status.content = f"This cannot be drawn: {error}"

    def _show_photograph(self, now: Displayed) -> None:
        """Show the photograph that was visited last, in the current frame."""
        shots, shot = now.scene.shots, self._shot
        if shots is None or shots.load_image is None or shot is None:
            return
        row = shots.at(now.frame)
        if (shots, row, shot) == self._photographed:
            return
        self._photographed = (shots, row, shot)
        try:
            picture = shots.load_image(row, shot)
        except (ValueError, OSError) as error:
            self._photograph.visible = False
            self._notify("The photograph cannot be shown", str(error), color="red")
            return
        when = f", {markup.frame_label(now.scene, row)}" if len(shots.viewmats) > 1 else ""
        self._photograph.label = f"photograph {self._names[shot]}{when}"
        self._photograph.image = shrunk(picture, _PHOTOGRAPH)
        self._photograph.visible = True

    # Screenshots.

    def _browser_picture(self) -> UInt8[np.ndarray, "h w 3"] | None:
        camera = self._client.camera
        try:
            picture = self._client.get_render(
                camera.image_height, camera.image_width, transport_format="png", timeout=_TIMEOUT_S
            )
        except (RuntimeError, TimeoutError):
            return None
        return over(picture, self._shared.scene.background)

    def _save_screenshot(self, kind: str, picture: np.ndarray | None) -> None:
        if picture is None:
            self._notify("There is no picture yet", "Wait until it is drawn.", color="red")
            return
        name = f"{kind}.png"
        if self._shared.save is not None:
            try:
                path = self._shared.save(kind, picture)
            except OSError as error:
                self._notify("The screenshot could not be saved", str(error), color="red")
            else:
                name = path.name
                self._notify("Screenshot saved", str(path))
        encoded, data = cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))
        self._client.send_file_download(name, data.tobytes() if encoded else b"")

    def _notify(self, title: str, body: str, color: str | None = None) -> None:
        self._client.add_notification(title, body, color=color, auto_close_seconds=8.0)


def unique(names: tuple[str, ...]) -> tuple[str, ...]:
    """The same names, numbered if any two are equal."""
    if len(set(names)) == len(names):
        return names
    return tuple(f"{number}: {name}" for number, name in enumerate(names))


def over(
    picture: UInt8[np.ndarray, "h w channels"], background: tuple[float, float, float]
) -> UInt8[np.ndarray, "h w 3"]:
    """A possibly transparent picture over a background (RGB, 0 to 1)."""
    if picture.shape[2] == 3:
        return picture
    alpha = picture[..., 3:] / 255.0
    return np.round(alpha * picture[..., :3] + (1 - alpha) * 255 * np.array(background)).astype(np.uint8)
