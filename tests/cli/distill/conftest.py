"""A scene to distil into, an empty cache of features, and how to distil within seconds."""

import json

import pytest

from gsjax.io.ply import write_ply
from tests.cli.conftest import first_picture

SMALL = ("--field.encoding", "table", "--field.channels", 8, "--field.contrast-patch", 4)


@pytest.fixture(scope="session")
def scene(pristine, tmp_path_factory):
    """A Gaussian for every other pixel of all cameras' first pictures, in a PLY file."""
    path = tmp_path_factory.mktemp("scene") / "scene.ply"
    write_ply(path, first_picture(pristine)[0])
    return path


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """No test finds what another one encoded."""
    monkeypatch.setattr("gsjax.cli.distill.cache.user_cache_dir", lambda *a, **k: str(tmp_path / "cache"))


def metrics(out):
    return json.loads((out / "metrics.json").read_text())
