"""A web server that shows a scene, with a page for each browser that connects."""

import contextlib
import io
import ipaddress
import socket
import threading
from collections.abc import Iterator
from types import ModuleType
from typing import Any

from gsjax import extras
from gsjax.viz.viewer.cameras import far_plane, first_pose, scene_up
from gsjax.viz.viewer.drawing import Drawer
from gsjax.viz.viewer.page import Page, Save, Shared
from gsjax.viz.viewer.viewable import Viewable

PORT = 8080
_TRIED = 50  # ports that are tried if none is given
_BRAND = (88, 120, 255)


class Viewer:
    """A running viewer, from `open_viewer`; as a context manager it closes itself.

    Attributes:
        url: address of the page.
        port: port of the server.
    """

    def __init__(self, server: Any, shared: Shared, host: str):
        self._server, self._pages, self._lock = server, {}, threading.Lock()
        self._shared = shared
        self._closed = shared.closing
        self.port: int = server.get_port()
        shown = f"[{host}]" if ":" in host else host
        self.url: str = f"http://{shown}:{self.port}"
        server.on_client_connect(self._on_connect)
        server.on_client_disconnect(self._on_disconnect)

    def wait(self) -> None:
        """Block until the viewer is closed or interrupted with Ctrl-C."""
        while not self._closed.wait(0.5):  # without a timeout, some platforms would not deliver Ctrl-C
            pass

    def close(self) -> None:
        """Disconnect all browsers, free the port, and end any film being saved after its current frame."""
        if self._closed.is_set():
            return
        self._closed.set()
        with self._lock:
            pages = [*self._pages.values()]
            self._pages.clear()
        for page in pages:
            page.close()
        with _silenced():
            self._server.stop()
        with self._shared.filming:
            pass

    def _on_connect(self, client: Any) -> None:
        page = Page(client, self._shared)
        with self._lock:
            self._pages[client.client_id] = page
        if client.client_id not in self._server.get_clients():  # it left while its page was built
            self._on_disconnect(client)

    def _on_disconnect(self, client: Any) -> None:
        with self._lock:
            page = self._pages.pop(client.client_id, None)
        if page is not None:
            page.close()

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *exception) -> None:
        self.close()


def open_viewer(
    scene: Viewable,
    *,
    host: str = "127.0.0.1",
    port: int | None = None,
    max_gaussians: int = 500_000,
    save: Save | None = None,
    compiler_options: dict[str, Any] | None = None,
) -> Viewer:
    """Show a scene in web browsers, until the viewer is closed.

    Args:
        scene: the scene to show.
        host: address to listen on. With the default, only this machine can connect.
        port: port to listen on (default: 8080, or the next free one).
        max_gaussians: a browser receives at most this many Gaussians, the most opaque ones; our render draws
            all of them.
        save: (kind, picture [H,W,3] uint8) -> path: saves a screenshot (default: screenshots are only offered
            for download).
        compiler_options: XLA options of the program that draws; `gsjax.optim.compiler.host_options()` makes
            it faster.

    Raises:
        MissingExtra: viser is not installed.
        ValueError: `max_gaussians` is below 1, or there is no such port.
        OSError: nothing can listen there.
    """
    viser = load_viser()
    if max_gaussians < 1:
        raise ValueError(f"max_gaussians: expected 1 or more, found {max_gaussians}")
    port = free_port(host, port)
    with _silenced():
        server = viser.ViserServer(host=host, port=port, label=scene.title, verbose=False)
    # Otherwise any page could make viser open a public tunnel to the internet.
    server.request_share_url = lambda verbose=True: None
    server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, brand_color=_BRAND)
    server.gui.main_panel.dock_right()
    server.gui.main_panel.set_width(330 if scene.editing is None else 400)
    server.scene.set_up_direction(scene_up(scene))
    server.scene.world_axes.visible = False
    pose = first_pose(scene)
    camera = server.initial_camera
    camera.position, camera.look_at, camera.up, camera.fov = pose.position, pose.target, pose.up, pose.fov
    camera.far = far_plane(scene.gaussians, pose)
    drawer = Drawer(scene.background, scene.antialiased, compiler_options)
    return Viewer(server, Shared(scene, drawer, max_gaussians, save), host)


def load_viser() -> ModuleType:
    """The module viser, which is optional.

    Raises:
        MissingExtra: it is not installed.
    """
    return extras.load("viser", "viewer", "the viewer")


def is_loopback(host: str) -> bool:
    """Whether an address can be reached from this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def free_port(host: str, port: int | None) -> int:
    """A port that can be listened on: the given one, or (None) the first free one from 8080 on.

    Raises:
        ValueError: the number is not a valid port.
        OSError: the port is in use, or the address is not available.
    """
    if port is not None and not 0 <= port < 2**16:
        raise ValueError(f"port: expected 0 (any that is free) to {2**16 - 1}, found {port}")
    asked = range(PORT, PORT + _TRIED) if port is None else [port]
    try:
        family, _, _, _, _ = socket.getaddrinfo(host, asked[0], type=socket.SOCK_STREAM)[0]
    except socket.gaierror as error:
        raise OSError(f"host: expected an address of this machine, found {host!r}") from error
    refused = OSError()
    for number in asked:
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            # As servers do; otherwise a port that was in use a minute ago would count as taken.
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, number))
            except OSError as error:
                refused = error
                continue
            return probe.getsockname()[1]
    where = f"{asked[0]}" if len(asked) == 1 else f"{asked[0]} to {asked[-1]}"
    raise OSError(
        f"port {where}: cannot listen there on {host} ({refused.strerror}); name another, or none"
    ) from refused


@contextlib.contextmanager
def _silenced() -> Iterator[None]:
    """Suppress the panel that viser prints when it starts and stops."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield
