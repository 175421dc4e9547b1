"""A web server that shows a scene: one page for each browser that comes."""

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
_TRIED = 50  # ports after the first, where it may be another
_BRAND = (88, 120, 255)


class Viewer:
    """A scene that browsers can look at; from `open_viewer`. As a context it closes itself.

    Attributes:
        url: where.
        port: of it.
    """

    def __init__(self, server: Any, shared: Shared, host: str):
        self._server, self._pages, self._lock = server, {}, threading.Lock()
        self._shared = shared
        self._closed = shared.closing
        self.port: int = server.get_port()
        shown = f"[{host}]" if ":" in host else host
        self.url: str = f"http://{shown}:{self.port}"
        server.on_client_connect(self._come)
        server.on_client_disconnect(self._gone)

    def wait(self) -> None:
        """Until it is closed, or Ctrl-C."""
        while not self._closed.wait(0.5):  # with a limit: without one, Ctrl-C would not be heard everywhere
            pass

    def close(self) -> None:
        """Let all browsers go, free the port, and end a film that is being kept after its present frame."""
        if self._closed.is_set():
            return
        self._closed.set()
        with self._lock:
            pages = [*self._pages.values()]
            self._pages.clear()
        for page in pages:
            page.close()
        with _hushed():
            self._server.stop()
        with self._shared.filming:
            pass

    def _come(self, client: Any) -> None:
        page = Page(client, self._shared)
        with self._lock:
            self._pages[client.client_id] = page
        if client.client_id not in self._server.get_clients():  # it left while its page was made
            self._gone(client)

    def _gone(self, client: Any) -> None:
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
        scene: what to show.
        host: address to listen on. Only this machine can look unless it is another than the default.
        port: 8080, or the next one that is free, unless given.
        max_gaussians: a browser gets so many, the most opaque ones; our render has all.
        save: (kind, picture [H,W,3] uint8) -> path: keeps a screenshot; they are only offered for download
            unless given.
        compiler_options: of the program that draws; `gsjax.optim.compiler.host_options()` makes it faster.

    Raises:
        MissingExtra: viser is not installed.
        ValueError: `max_gaussians` is below 1, or there is no such port.
        OSError: nothing can listen there.
    """
    viser = load_viser()
    if max_gaussians < 1:
        raise ValueError(f"max_gaussians: expected 1 or more, found {max_gaussians}")
    port = free_port(host, port)
    with _hushed():
        server = viser.ViserServer(host=host, port=port, label=scene.title, verbose=False)
    # Any page could ask viser to open a tunnel through which the whole internet can look.
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
    """viser, which is optional.

    Raises:
        MissingExtra: it is not installed.
    """
    return extras.load("viser", "viewer", "the viewer")


def is_loopback(host: str) -> bool:
    """Whether only programs of this machine reach an address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def free_port(host: str, port: int | None) -> int:
    """A port that can be listened on: that one, or without one the first free one from 8080 on.

    Raises:
        ValueError: there is no port of that number.
        OSError: it is in use; or nothing can listen on that address.
    """
    if port is not None and not 0 <= port < 2**16:
        raise ValueError(f"port: expected 0 (any that is free) to {2**16 - 1}, found {port}")
    asked = range(PORT, PORT + _TRIED) if port is None else [port]
    try:
        family, _, _, _, _ = socket.getaddrinfo(host, asked[0], type=socket.SOCK_STREAM)[0]
    except socket.gaierror as error:
        raise OSError(f"host: {host!r} is no address of this machine") from error
    refused = OSError()
    for number in asked:
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            # As servers do, or a port that was in use a minute ago would count as taken.
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
def _hushed() -> Iterator[None]:
    """viser prints a panel of its own when it starts and when it stops."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield
