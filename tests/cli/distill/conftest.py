"""A scene to distil into, a made-up field to query, an empty cache of features, and readers of results."""

import json
import shutil

import numpy as np
import pytest

from gsjax.engine.teaching.source import Source
from gsjax.io.ply import write_ply
from gsjax.perception.codebook import ClassCodebook
from tests.cli.conftest import LABELS, first_picture, write_made_field

CAN = 3
NAMES = {label + 1: name for label, name in LABELS.items()}  # as a distillation numbers them
SMALL = ("--distill.encoding", "table", "--distill.channels", 8, "--distill.contrast-patch", 4)


@pytest.fixture(scope="session")
def scene(pristine, tmp_path_factory):
    """A Gaussian for every other pixel of all cameras' first pictures, in a PLY file."""
    path = tmp_path_factory.mktemp("scene") / "scene.ply"
    write_ply(path, first_picture(pristine)[0])
    return path


@pytest.fixture(scope="session")
def labelled(pristine, tmp_path_factory):
    """A PLY file of the same Gaussians with labels, and the labels."""
    path = tmp_path_factory.mktemp("scene") / "scene.ply"
    gaussians, labels = first_picture(pristine)
    write_ply(path, gaussians, labels=labels)
    return path, labels


@pytest.fixture(scope="session")
def made(pristine, labelled, tmp_path_factory):
    """A field of the classes, written without distilling it."""
    book = ClassCodebook(NAMES)
    vectors = np.stack([book.embed_text(name) for name in LABELS.values()])
    return write_made_field(
        tmp_path_factory.mktemp("fields") / "field",
        labelled[0],
        pristine,
        Source("classes", NAMES),
        labelled[1],
        vectors,
    )


@pytest.fixture
def field(made, tmp_path):
    """A copy of `made` to query and to corrupt."""
    return shutil.copytree(made, tmp_path / "field")


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """A new cache for each test, so that none finds what another one encoded."""
    monkeypatch.setattr("gsjax.engine.teaching.cache.user_cache", lambda: tmp_path / "cache")


def metrics(out):
    return json.loads((out / "metrics.json").read_text())


def told_of(field):
    return json.loads((field / "query" / "query.json").read_text())


def found_of(field, answer=None):
    with np.load((answer or field / "query") / "selection.npz") as found:
        return dict(found)
