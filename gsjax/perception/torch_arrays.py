"""Read the tensor in a torch file (.pt, .pth) written by `torch.save(tensor, path)`, without torch and
without unpickling.

Such a file is a zip of the raw numbers and of a pickle with their type and shape. Loading a pickle can run
arbitrary code, so it is never loaded: its opcodes are listed (`pickletools.genops`, which runs nothing), and
only the few that rebuild one tensor are accepted.
"""

import math
import pickletools
import zipfile
from pathlib import Path
from typing import Any, cast

import numpy as np

_TYPES = {
    "FloatStorage": np.float32,
    "DoubleStorage": np.float64,
    "HalfStorage": np.float16,
    "LongStorage": np.int64,
    "IntStorage": np.int32,
    "ShortStorage": np.int16,
    "CharStorage": np.int8,
    "ByteStorage": np.uint8,
    "BoolStorage": np.bool_,
}
_CALLS = {"torch._utils _rebuild_tensor_v2", "collections OrderedDict"}
_LONGEST_PICKLE = 4096  # bytes; the pickle of a tensor has about 300
_ADVICE = "Save it again as .npy: numpy.save('features.npy', tensor.cpu().numpy())."


def read_torch_array(path: Path) -> np.ndarray:
    """The array in a file that holds one tensor.

    Raises:
        ValueError: it is not such a file, or holds anything besides one tensor of plain numbers.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            described = [name for name in names if name.endswith("/data.pkl") or name == "data.pkl"]
            if len(described) != 1:
                raise ValueError(f"{path}: expected a torch.save file, found no data.pkl in it. {_ADVICE}")
            kind, key, offset, shape, strides = _tensor(path, _part(path, archive, described[0]))
            root = described[0].removesuffix("data.pkl")
            if f"{root}data/{key}" not in names:
                raise ValueError(f"{path}: expected its numbers in data/{key}, found none there. {_ADVICE}")
            if f"{root}byteorder" in names and _part(path, archive, f"{root}byteorder") != b"little":
                raise ValueError(f"{path}: expected little-endian numbers, found others. {_ADVICE}")
            stored = _part(path, archive, f"{root}data/{key}")
    except (zipfile.BadZipFile, EOFError, OSError, RuntimeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: expected a file of torch.save, found {error}. {_ADVICE}") from error
    dtype = np.dtype(_TYPES[kind])
    if len(stored) % dtype.itemsize:
        raise ValueError(
            f"{path}: expected numbers of {dtype.itemsize} bytes, found {len(stored)} bytes. {_ADVICE}"
        )
    numbers = np.frombuffer(stored, dtype)
    count = math.prod(shape)  # exceeds the stored numbers only if strides repeat some, possibly without bound
    last = offset + sum((size - 1) * stride for size, stride in zip(shape, strides, strict=True))
    if min([0, offset, *shape, *strides]) < 0 or count > len(numbers) or (count and last >= len(numbers)):
        raise ValueError(
            f"{path}: expected numbers for the shape {list(shape)}, found {len(numbers)}. {_ADVICE}"
        )
    try:
        if count == 0:
            return np.zeros(shape, dtype)
        bytes_apart = [stride * dtype.itemsize for stride in strides]
        return np.lib.stride_tricks.as_strided(numbers[offset:], shape, bytes_apart).copy()
    except (ValueError, OverflowError) as error:  # too many axes, or huge ones beside an axis of 0
        raise ValueError(
            f"{path}: expected a shape that numpy supports, found {list(shape)} ({error}). {_ADVICE}"
        ) from error


def _part(path: Path, archive: zipfile.ZipFile, name: str) -> bytes:
    """An entry of the archive. torch.save does not compress, so an entry is never larger than the file."""
    if archive.getinfo(name).compress_type != zipfile.ZIP_STORED:
        raise ValueError(
            f"{path}: expected {name} uncompressed, as torch.save writes it, found it compressed. {_ADVICE}"
        )
    return archive.read(name)


def _tensor(path: Path, pickle: bytes) -> tuple[str, str, int, tuple[int, ...], tuple[int, ...]]:
    """Type, key, offset, shape and strides, by simulating the stack of the pickle machine."""
    stack: list[Any] = []
    memo: dict[int, Any] = {}
    mark = object()

    def refuse(found: str) -> ValueError:
        return ValueError(
            f"{path}: expected one tensor and nothing else, found {found}; gsjax loads no pickles, which can "
            f"run arbitrary code. {_ADVICE}"
        )

    def since_mark() -> list[Any]:
        place = len(stack) - 1 - stack[::-1].index(mark)
        items = stack[place + 1 :]
        del stack[place:]
        return items

    if len(pickle) > _LONGEST_PICKLE:
        raise refuse(f"a pickle of {len(pickle)} bytes")
    try:
        for opcode, operand, _ in pickletools.genops(pickle):
            name, argument = opcode.name, cast(Any, operand)
            if name in ("PROTO", "FRAME"):
                continue
            if name == "STOP":
                break
            if name == "GLOBAL":
                if argument not in _CALLS and not _is_storage(argument):
                    raise refuse(repr(argument.replace(" ", ".")))
                stack.append(argument)
            elif name in ("BINUNICODE", "SHORT_BINUNICODE", "BININT", "BININT1", "BININT2", "LONG1"):
                stack.append(argument)
            elif name in ("NEWTRUE", "NEWFALSE"):
                stack.append(name == "NEWTRUE")
            elif name in ("BINPUT", "LONG_BINPUT"):
                memo[argument] = stack[-1]
            elif name in ("BINGET", "LONG_BINGET"):
                stack.append(memo[argument])
            elif name == "MARK":
                stack.append(mark)
            elif name == "EMPTY_TUPLE":
                stack.append(())
            elif name in ("TUPLE1", "TUPLE2", "TUPLE3"):
                count = int(name[-1])
                stack[-count:] = [tuple(stack[-count:])]
            elif name == "TUPLE":
                stack.append(tuple(since_mark()))
            elif name == "BINPERSID":
                stack.append(("storage", stack.pop()))
            elif name == "REDUCE":
                arguments, function = stack.pop(), stack.pop()
                called = (
                    function if isinstance(function, str) else "no function"
                )  # others may be too deep to hash
                if called not in _CALLS:
                    raise refuse(f"a call of {called!r}")
                stack.append((function, arguments))
            else:
                raise refuse(f"the opcode {name}")
        ((function, (storage, offset, shape, strides, *_)),) = stack
        (tag, (kind_of, storage_type, key, _, _)) = storage
        if (function, tag, kind_of) != ("torch._utils _rebuild_tensor_v2", "storage", "storage"):
            raise refuse("something else")
        numbers = (offset, *shape, *strides)
        if not all(type(n) is int for n in numbers) or len(shape) != len(strides) or not isinstance(key, str):
            raise refuse("a tensor without a shape")
        if not _is_storage(storage_type):
            raise refuse(f"a storage {storage_type!r}")
        return storage_type.split()[1], key, offset, tuple(shape), tuple(strides)
    except (ValueError, TypeError, KeyError, IndexError, AttributeError) as error:
        if str(path) in str(error):
            raise
        raise refuse("something else") from error


def _is_storage(name: str) -> bool:
    module, _, kind = name.partition(" ")
    return module == "torch" and kind in _TYPES
