"""Digests of a run's files for records of `benchmarks.yardstick`, and differences between two records.

Digests show whether values are identical to the bit. A mean, quantiles and sums under random signs are kept
beside them, so that the size of a difference is known without the arrays.
"""

import hashlib
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from plyfile import PlyData

FORMAT = 2

_VOLATILE_KEYS = {"seconds", "machine", "fps", "from_cache"}
_VOLATILE_ENDINGS = ("_seconds", "_s", "_ms", "_hz", "_mb")
_VOLATILE_ARRAYS = {"update_s"}
_OPTION_KEYS = {"photographs"}
"""Keys in the JSON text of NPZ files whose values hold names of options: how a dataset was chosen."""
_TIME = re.compile(r"\d[\d.,]*\s*(?:ms|s|seconds?|min|minutes?|hz|mb|gib|times a second)\b", re.IGNORECASE)
_NUMBER = re.compile(r"\d+(?:[.,]\d+)*")
_QUANTILES = (0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 1.0)
_SKETCH = 32  # random sums of an array, from which the size of a difference is estimated to about an eighth


def describe_array(array: np.ndarray) -> dict[str, Any]:
    """The digest of an array, and for numbers also statistics that give the size of a difference.

    Returns:
        "sha256" over dtype, shape and bytes, "dtype" and "shape"; for numbers also "mean", "quantiles" and
        "sketch" (sums under random signs, which depend on shape and seed alone), all of finite values, and
        "not_finite", the number of other values.
    """
    array = np.ascontiguousarray(array)
    digest = hashlib.sha256(f"{array.dtype.str}|{array.shape}|".encode())
    digest.update(array.tobytes())
    found = {"sha256": digest.hexdigest(), "dtype": array.dtype.str, "shape": list(array.shape)}
    if array.size and array.dtype.kind in "fiub":
        values = array.astype(np.float64).ravel()
        finite = np.isfinite(values)
        found["not_finite"] = int((~finite).sum())
        if finite.any():
            found["mean"] = float(values[finite].mean())
            found["quantiles"] = [float(q) for q in np.quantile(values[finite], _QUANTILES)]
            found["sketch"] = _sketch(np.where(finite, values, 0.0))
    return found


def _sketch(values: np.ndarray) -> list[float]:
    rng = np.random.default_rng(0)
    signs = (rng.integers(0, 2, len(values), dtype=np.int8) * 2 - 1 for _ in range(_SKETCH))
    return [float(values @ one) for one in signs]


def describe_text(text: str) -> dict[str, Any]:
    """The value of JSON text without volatile entries and names of options; the length of any other text."""
    try:
        value = json.loads(text)
    except ValueError:
        return {"text": len(text)}
    return {"text": without_volatile(value, left_out=_OPTION_KEYS)}


def without_volatile(value: Any, left_out: Iterable[str] = ()) -> Any:
    """A value from JSON without times, rates, machines and paths; of sentences only the numbers remain, since
    wording is not a result."""
    if isinstance(value, Mapping):
        return {
            key: without_volatile(item, left_out)
            for key, item in value.items()
            if not (key in left_out or key in _VOLATILE_KEYS or key.endswith(_VOLATILE_ENDINGS))
        }
    if isinstance(value, list):
        return [without_volatile(item, left_out) for item in value if not _is_after_a_time(item)]
    if not isinstance(value, str):
        return value
    if value.startswith("/"):
        return "a path"
    if value.count(" ") < 3:
        return value
    return "a sentence with " + (" ".join(_NUMBER.findall(_TIME.sub("", value))) or "no number")


def _is_after_a_time(row: Any) -> bool:
    """Whether it is a row of a fit's curve at a fraction of its time, whose step depends on the machine."""
    return isinstance(row, Mapping) and "part" in row and row.get("sh_degree", 0) is None


def _arrays(path: Path) -> Iterator[tuple[str, np.ndarray]]:
    if path.suffix == ".png":
        pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if pixels is None:
            raise ValueError(f"{path}: expected a picture, found something else; look at what wrote it")
        yield "pixels", pixels
    elif path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as arrays:
            yield from ((name, arrays[name]) for name in sorted(arrays.files))
    else:
        for element in PlyData.read(str(path)).elements:
            for name in element.data.dtype.names:
                yield f"{element.name}.{name}", np.asarray(element.data[name])


def describe_file(path: Path) -> dict[str, Any]:
    """The digest of one file: {"arrays": ...} or {"says": ...}; for other files, such as videos, reports and
    settings, only their existence is recorded."""
    if path.suffix in (".npz", ".ply", ".png"):
        arrays = {name: array for name, array in _arrays(path) if name not in _VOLATILE_ARRAYS}
        return {
            "arrays": {
                name: describe_text(str(array))
                if array.dtype.kind == "U" and not array.ndim
                else describe_array(array)
                for name, array in arrays.items()
            }
        }
    if path.suffix == ".json":
        return {"says": without_volatile(json.loads(path.read_text(encoding="utf-8")))}
    if path.suffix == ".jsonl":
        return {
            "says": [
                without_volatile(json.loads(line)) for line in path.read_text(encoding="utf-8").splitlines()
            ]
        }
    return {}


def describe_run(folder: Path) -> dict[str, Any]:
    """Digests of all files of a run, by their paths within it."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): describe_file(path) for path in files}


def compare(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, list[str]]:
    """Differences between two records by case, one line each; no lines for a case that is bitwise identical.

    Raises:
        ValueError: the records are of different formats.
    """
    if before["format"] != after["format"]:
        raise ValueError(
            f"expected records of one format, found {before['format']} and {after['format']}; make both anew"
        )
    names = dict.fromkeys([*before["cases"], *after["cases"]])
    return {name: _compare_cases(before["cases"].get(name), after["cases"].get(name)) for name in names}


def _compare_cases(before: Mapping[str, Any] | None, after: Mapping[str, Any] | None) -> list[str]:
    if before is None or after is None:
        return [f"only the {'second' if before is None else 'first'} record has this case"]
    lines = []
    if before["exit_code"] != after["exit_code"]:
        lines.append(f"exit code: {before['exit_code']} -> {after['exit_code']}")
    for path in sorted({*before["files"], *after["files"]}):
        lines += _compare_files(path, before["files"].get(path), after["files"].get(path))
    return lines


def _compare_files(path: str, before: Mapping[str, Any] | None, after: Mapping[str, Any] | None) -> list[str]:
    if before is None or after is None:
        return [f"{path}: " + ("new" if before is None else "missing")]
    lines = [f"{path}: {line}" for line in _compare_values("", before.get("says"), after.get("says"))]
    ours, theirs = before.get("arrays", {}), after.get("arrays", {})
    for name in dict.fromkeys([*ours, *theirs]):
        if name not in ours or name not in theirs:
            lines.append(f"{path}: {name}: array " + ("new" if name not in ours else "missing"))
        elif "text" in ours[name] or "text" in theirs[name]:
            texts = _compare_values(name, ours[name].get("text"), theirs[name].get("text"))
            lines += [f"{path}: {line}" for line in texts]
        elif ours[name]["sha256"] != theirs[name]["sha256"]:
            lines.append(f"{path}: {name}: {array_difference(ours[name], theirs[name])}")
    return lines


def _compare_values(where: str, before: Any, after: Any) -> list[str]:
    """Lines for all differences between two values from JSON, named as in test.psnr or views[2].ssim."""
    if isinstance(before, Mapping) and isinstance(after, Mapping):
        dot, lines = "." if where else "", []
        for key in dict.fromkeys([*before, *after]):
            if key in before and key in after:
                lines += _compare_values(f"{where}{dot}{key}", before[key], after[key])
            else:
                lines.append(f"{where}{dot}{key}: " + ("new" if key not in before else "missing"))
        return lines
    if isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        pairs = enumerate(zip(before, after, strict=True))
        return [line for i, pair in pairs for line in _compare_values(f"{where}[{i}]", *pair)]
    if isinstance(before, list) and isinstance(after, list):
        return [f"{where}: {len(before)} entries -> {len(after)}"]
    if type(before) is type(after) and before == after:
        return []
    numbers = all(isinstance(one, int | float) and not isinstance(one, bool) for one in (before, after))
    return [f"{where}: {before!r} -> {after!r}" + (f" ({after - before:+.3g})" if numbers else "")]


def array_difference(before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    """How two arrays differ, in words; the root mean square is an estimate."""
    for name in ("dtype", "shape"):
        if before[name] != after[name]:
            return f"{name} {before[name]} -> {after[name]}"
    if "sketch" not in before or "sketch" not in after:
        return "other values"
    gaps = np.subtract(after["sketch"], before["sketch"])
    rms = np.sqrt(np.mean(gaps**2) / max(1, np.prod(before["shape"])))
    spread = before["quantiles"][-2] - before["quantiles"][1]
    words = f"differs by about {rms:.2g} (root mean square), where 90 % of the values span {spread:.2g}"
    words += f"; mean {before['mean']:.6g} -> {after['mean']:.6g}"
    if before["not_finite"] != after["not_finite"]:
        words += f"; not finite {before['not_finite']} -> {after['not_finite']}"
    return words
