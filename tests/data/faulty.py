"""Ways to damage the files of a recording, for the fault tables of test_reader_errors."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsjax.data import Photographs, Sequence
from tests.data import dots

WIDTH, HEIGHT = 32, 24
K = (30.0, 30.0, WIDTH / 2, HEIGHT / 2)

Damage = Callable[[Path], None]


class Fault(NamedTuple):
    """One fault of a recording.

    Attributes:
        what: description of the fault.
        damage: introduces the fault into the folder.
        names: names that the message must contain: the file, and the photograph or frame within it.
    """

    what: str
    damage: Damage
    names: tuple[str, ...]


class Layout(NamedTuple):
    """A data layout: how to build an example in a folder, how to read all of it, and its faults."""

    build: Damage
    read: Damage
    faults: tuple[Fault, ...]


def load_all(data: Photographs | Sequence) -> None:
    """Loads every picture, as a run does."""
    if isinstance(data, Photographs):
        for i in range(data.num):
            data.image(i), data.depth(i), data.mask(i)
        return
    for t in range(data.num_frames):
        for c in range(data.num_cameras):
            data.image(t, c), data.depth(t, c), data.mask(t, c)


def picture(seed: int, width=WIDTH, height=HEIGHT) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (height, width, 3), dtype=np.uint8)


def deep(width=WIDTH, height=HEIGHT) -> np.ndarray:
    return np.full((height, width), 1500, np.uint16)


def moved(x: float) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3] = x
    return pose


# Damages to a file.


def cut(name: str, keep: float = 0.6) -> Damage:
    def damage(root: Path) -> None:
        content = (root / name).read_bytes()
        (root / name).write_bytes(content[: int(keep * len(content))])

    return damage


def holds(name: str, content: bytes | str) -> Damage:
    return lambda root: (root / name).write_bytes(content.encode() if isinstance(content, str) else content)


def gone(*names: str) -> Damage:
    return lambda root: [(root / name).unlink() for name in names]


def swap(name: str, old: str, new: str) -> Damage:
    def damage(root: Path) -> None:
        text = (root / name).read_text()
        assert old in text
        (root / name).write_text(text.replace(old, new, 1))

    return damage


def change(name: str, edit: Callable[[dict], object]) -> Damage:
    def damage(root: Path) -> None:
        meta = json.loads((root / name).read_text())
        edit(meta)
        (root / name).write_text(json.dumps(meta))

    return damage


def frame(name: str, number: int, **changes) -> Damage:
    return change(name, lambda meta: meta["frames"][number].update(changes))


def array(name: str, edit: Callable[[np.ndarray], np.ndarray]) -> Damage:
    return lambda root: np.save(root / name, edit(np.load(root / name)), allow_pickle=True)


def patch(name: str, at: int, raw: bytes) -> Damage:
    def damage(root: Path) -> None:
        content = bytearray((root / name).read_bytes())
        content[at : at + len(raw)] = raw
        (root / name).write_bytes(content)

    return damage


def drawn(name: str, image: np.ndarray) -> Damage:
    return lambda root: dots.save(root / name, image)


NAN, SKEW = np.full((4, 4), np.nan).tolist(), np.diag([1.0, 2, 1, 1]).tolist()
