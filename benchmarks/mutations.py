"""Mutations of files for benchmarks/fuzz_files.py: bytes, lines, JSON, and what gzip, zip and PNG contain.

Checksums are recomputed, so that readers do not stop at them.
"""

import copy
import gzip
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

PNG = b"\x89PNG\r\n\x1a\n"
_EXTREMES = (0, 1, 2**15, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, -1, -(2**31))
_BLOCK = 64  # bytes that are inserted, doubled or taken from another file, at most
_MOST_CHANGES = 4
_DEEP = 100_000
_WORDS = (
    *("nan", "inf", "-inf", "1e400", "-1", "0", "1099511627776", "9" * 5000, "1e-320", "0x10", "true"),
    *(
        "",
        "\0",
        "\ufeff",
        "x" * 20_000,
        "[" * _DEEP,
        "{" * 1000,
        '"',
        "../../x",
        "/etc/hostname",
        "a\\b",
        "é",
    ),
)
_VALUES = (
    *(None, True, 0, -1, 0.5, 2**31, 2**40, 2**70, -(2**63), 1e308, float("nan"), float("inf")),
    *("", "x", "nan", "../x", "/", ".", "\0", "a" * 20_000, [], {}, [[]], [None], {"x": {}}, [0] * 10_000),
    *([[1, 2], [3]], 10**4000),
)
_LARGEST = 1 << 22  # of a file after a mutation

Rng = np.random.Generator


def mutated(content: bytes, others: Sequence[bytes], rng: Rng) -> bytes:
    """A file after one to four changes.

    Args:
        content: the file.
        others: other files, from which blocks are taken.
        rng: makes all random choices.
    """
    if rng.random() < 0.02:
        return b"" if rng.random() < 0.5 else _any(others, rng)
    if rng.random() < 0.7 and (inside := _unpacked(content)) is not None:
        changed = inside(lambda part: _changed(part, others, rng), rng)
    else:
        changed = _changed(content, others, rng)
    return changed[:_LARGEST]


def _changed(content: bytes, others: Sequence[bytes], rng: Rng) -> bytes:
    if rng.random() < 0.6 and (tree := _json_of(content)) is not None:
        return _changed_json(tree, rng)
    if rng.random() < 0.5 and _is_text(content):
        return _changed_lines(content, rng)
    for _ in range(rng.integers(1, _MOST_CHANGES + 1)):
        content = _any(_CHANGES, rng)(content, others, rng)
    return content


def _any(options: Sequence[Any], rng: Rng) -> Any:
    return options[rng.integers(len(options))]


def _place(content: bytes, rng: Rng) -> int:
    """A random position: half of the time in the header, which matters more than the rest."""
    return int(rng.integers(min(len(content), 256 if rng.random() < 0.5 else len(content)) + 1))


def _put(content: bytes, at: int, raw: bytes) -> bytes:
    return content[:at] + raw + content[at + len(raw) :]


def _flip(content: bytes, _: Sequence[bytes], rng: Rng) -> bytes:
    at = _place(content, rng)
    return content[:at] + bytes(b ^ 1 << rng.integers(8) for b in content[at : at + 1]) + content[at + 1 :]


def _overwrite(content: bytes, _: Sequence[bytes], rng: Rng) -> bytes:
    size = int(rng.integers(1, 9))
    return _put(content, _place(content, rng), _any((bytes(size), b"\xff" * size, rng.bytes(size)), rng))


def _truncate(content: bytes, _: Sequence[bytes], rng: Rng) -> bytes:
    return content[: _place(content, rng)]


def _insert(content: bytes, _: Sequence[bytes], rng: Rng) -> bytes:
    at = _place(content, rng)
    return content[:at] + rng.bytes(int(rng.integers(1, _BLOCK))) + content[at:]


def _double(content: bytes, _: Sequence[bytes], rng: Rng) -> bytes:
    at = _place(content, rng)
    return content[:at] + content[at : at + int(rng.integers(1, _BLOCK))] * 2 + content[at:]


def _splice(content: bytes, others: Sequence[bytes], rng: Rng) -> bytes:
    other = _any(others, rng)
    start = _place(other, rng)
    return _put(content, _place(content, rng), other[start : start + int(rng.integers(1, _BLOCK))])


def _extreme(content: bytes, _: Sequence[bytes], rng: Rng) -> bytes:
    size, order = _any((2, 4, 8), rng), _any(("little", "big"), rng)
    value = _any(_EXTREMES, rng) % (1 << 8 * size)
    return _put(content, _place(content, rng), value.to_bytes(size, order))


_CHANGES = (_flip, _overwrite, _truncate, _insert, _double, _splice, _extreme, _extreme)


# Text.


def _is_text(content: bytes) -> bool:
    try:
        return "\0" not in content.decode("utf-8")
    except UnicodeDecodeError:
        return False


def _changed_lines(content: bytes, rng: Rng) -> bytes:
    text = content.decode("utf-8")
    between = max(" ,;", key=text.count)
    lines = [line.split(between) for line in text.split("\n")]
    for _ in range(rng.integers(1, _MOST_CHANGES + 1)):
        at, kind = int(rng.integers(len(lines))), rng.integers(8)
        if kind == 0:
            lines.insert(at, lines[int(rng.integers(len(lines)))])
        elif kind == 1 and len(lines) > 1:
            del lines[at]
        elif kind == 2:
            lines[at : at + 1] = [lines[at]] * 200
        elif kind == 3:
            lines[at] = [_any(_WORDS, rng)]
        else:
            words = [*lines[at]]
            word = int(rng.integers(len(words)))
            words[word : word + 1] = [_any(_WORDS, rng)] if kind < 7 else []
            lines[at] = words or [""]
    return "\n".join(between.join(line) for line in lines).encode("utf-8", "surrogatepass")


def _json_of(content: bytes) -> Any:
    """The tree of a JSON file; None if it is not JSON."""
    if content[:1] not in (b"{", b"["):
        return None
    try:
        return json.loads(content)
    except (ValueError, RecursionError):
        return None


def _changed_json(tree: Any, rng: Rng) -> bytes:
    tree = copy.deepcopy(tree)
    for _ in range(rng.integers(1, _MOST_CHANGES + 1)):
        if places := _places(tree):
            node, key = _any(places, rng)
            if rng.random() < 0.25:
                del node[key]
            elif rng.random() < 0.2 and isinstance(node, dict):
                node[_any(("", "x", "a" * 20_000, *node), rng)] = node.pop(key)
            elif rng.random() < 0.2:
                node[key] = [node[key]]
            else:
                node[key] = copy.deepcopy(_any(_VALUES, rng))  # the next change may be within it
    if rng.random() < 0.05:
        return b'{"frames": ' + b"[" * _DEEP + b"]" * _DEEP + b"}"
    return _dumped(tree).encode("utf-8", "surrogatepass")


def _dumped(tree: Any) -> str:
    """JSON with integers of any length, which `json` refuses to write."""
    mark = "a number of many digits"

    def small(node: Any) -> Any:
        if isinstance(node, dict):
            return {key: small(value) for key, value in node.items()}
        if isinstance(node, list):
            return [small(value) for value in node]
        return mark if isinstance(node, int) and abs(node) > 1 << 80 else node

    return json.dumps(small(tree)).replace(f'"{mark}"', "9" * 5000)


def _places(node: Any) -> list[tuple[Any, Any]]:
    """Every (container, key) of a tree; of long lists, the first few."""
    keys = list(node) if isinstance(node, dict) else list(range(min(len(node), 8)))
    places = [(node, key) for key in keys]
    for key in keys:
        if isinstance(node[key], dict | list):
            places += _places(node[key])
    return places


# Packed content.

Change = Callable[[bytes], bytes]


def _unpacked(content: bytes) -> Callable[[Change, Rng], bytes] | None:
    """How to change the packed content of a file; None if it has none."""
    if content.startswith(b"\x1f\x8b"):
        return lambda change, _: gzip.compress(change(gzip.decompress(content)), 1, mtime=0)
    if content.startswith(b"PK\x03\x04"):
        return lambda change, rng: _changed_zip(content, change, rng)
    if content.startswith(PNG):
        return lambda change, _: _with_checksums(change(content))
    return None


def _changed_zip(content: bytes, change: Change, rng: Rng) -> bytes:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        parts = [[name, archive.read(name)] for name in archive.namelist()]
    part, kind = _any(parts, rng), rng.random()
    if kind < 0.1:
        parts.remove(part)
    elif kind < 0.2:
        part[0] = _any(("../x", "/x", "x" * 3000, *(name for name, _ in parts)), rng)
    else:
        part[1] = _changed_array(part[1], change)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", _any((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED), rng)) as archive:
        for name, data in dict(parts).items():
            archive.writestr(name, data)
    return stream.getvalue()


def _changed_array(content: bytes, change: Change) -> bytes:
    """An array of text that is JSON is changed as such, everything else as bytes."""
    if content.startswith(b"\x93NUMPY"):
        array = np.load(io.BytesIO(content))
        if array.dtype.kind == "U" and array.ndim == 0:
            text = change(str(array).encode()).decode("utf-8", "replace")
            stream = io.BytesIO()
            np.save(stream, np.array(text))
            return stream.getvalue()
    return change(content)


def _with_checksums(content: bytes) -> bytes:
    """A PNG with correct checksums for all chunks that can still be located."""
    raw, at = bytearray(content), len(PNG)
    while at + 12 <= len(raw):
        end = at + 8 + struct.unpack_from(">I", raw, at)[0]
        if end + 4 > len(raw):
            break
        struct.pack_into(">I", raw, end, zlib.crc32(raw[at + 4 : end]))
        at = end + 4
    return bytes(raw)
