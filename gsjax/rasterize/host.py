"""Numpy functions as XLA custom calls, for operations that XLA:CPU does one scalar at a time.

The call passes XLA's own buffers to numpy. It implements XLA's foreign function interface
(xla/ffi/api/c_api.h, which jaxlib ships) through ctypes and needs no compiler. Unlike `jax.pure_callback` it
copies nothing, and it cannot hang on a machine with a single core.
"""

import contextlib
import ctypes
import warnings
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

_EXTENSION_METADATA = 1  # XLA asks which version of the interface a handler implements
_VERSION = (0, 1)  # the oldest version with what is used here: newer runtimes accept it for at least a year
_INTERNAL_ERROR = 13


def _struct(name: str, *fields) -> type[ctypes.Structure]:
    """A C structure; every structure of the interface starts with its size and a pointer to extensions."""
    head = [("struct_size", ctypes.c_size_t), ("extension", ctypes.c_void_p)]
    return type(name, (ctypes.Structure,), {"_fields_": head + list(fields)})


_Version = _struct("Version", ("major", ctypes.c_int), ("minor", ctypes.c_int))
_Buffer = _struct(
    "Buffer",
    ("dtype", ctypes.c_int),
    ("data", ctypes.c_void_p),
    ("rank", ctypes.c_int64),
    ("dims", ctypes.POINTER(ctypes.c_int64)),
)
_Buffers = _struct(
    "Buffers",
    ("size", ctypes.c_int64),
    ("types", ctypes.c_void_p),
    ("items", ctypes.POINTER(ctypes.POINTER(_Buffer))),
)
_Frame = _struct(
    "Frame",
    ("api", ctypes.c_void_p),
    ("context", ctypes.c_void_p),
    ("stage", ctypes.c_int),
    ("args", _Buffers),
    ("rets", _Buffers),
)
_ErrorArgs = _struct("ErrorArgs", ("message", ctypes.c_char_p), ("code", ctypes.c_int))
_Api = _struct("Api", ("version", _Version), ("internal", ctypes.c_void_p), ("create_error", ctypes.c_void_p))


class _Metadata(ctypes.Structure):
    _fields_ = [("struct_size", ctypes.c_size_t), ("version", _Version)]


class _Extension(ctypes.Structure):
    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("type", ctypes.c_int),
        ("next", ctypes.c_void_p),
        ("metadata", ctypes.POINTER(_Metadata)),  # present if the type says so
    ]


_Handler = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_Frame))
_CreateError = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_ErrorArgs))


_DTYPES = {4: np.int32, 8: np.uint32}  # XLA's codes for the types that are passed here


def _views(buffers) -> list[np.ndarray]:
    """Numpy arrays that share the memory of these buffers."""
    views = []
    for i in range(buffers.size):
        buffer = buffers.items[i].contents
        shape = [buffer.dims[axis] for axis in range(buffer.rank)]
        dtype, size = _DTYPES[buffer.dtype], 4 * int(np.prod(shape, dtype=np.int64))
        if size == 0:
            views.append(np.empty(shape, dtype))
        else:
            memory = (ctypes.c_char * size).from_address(buffer.data)
            views.append(np.frombuffer(memory, dtype).reshape(shape))
    return views


def _handler(work: Callable[..., None]) -> ctypes._CFuncPtr:
    """`work(*inputs, *outputs)` on numpy views, as a function that XLA can call."""

    def called_by_xla(pointer):  # exceptions would be lost here, so all are caught, Ctrl-C included
        frame = pointer.contents
        try:
            if frame.extension:
                extension = ctypes.cast(frame.extension, ctypes.POINTER(_Extension)).contents
                if extension.type == _EXTENSION_METADATA:
                    version = extension.metadata.contents.version
                    version.major, version.minor = _VERSION
                    return None
            work(*_views(frame.args), *_views(frame.rets))
        except BaseException as error:
            api = ctypes.cast(frame.api, ctypes.POINTER(_Api)).contents
            message = f"{work.__name__} on the host failed: {type(error).__name__}: {error}".encode()
            args = _ErrorArgs(ctypes.sizeof(_ErrorArgs), None, message, _INTERNAL_ERROR)
            return _CreateError(api.create_error)(ctypes.byref(args))
        return None

    return _Handler(called_by_xla)


_HANDLERS: dict[str, Any] = {}  # kept alive: XLA holds their addresses


def register(name: str, work: Callable[..., None]) -> bool:
    """Register `work(*inputs, *outputs)`, which fills the outputs, with XLA:CPU under this name.

    Returns:
        Whether registration succeeded: another version of the interface may refuse it.
    """
    capsule = ctypes.pythonapi.PyCapsule_New
    capsule.restype, capsule.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    handler = _handler(work)
    try:
        address = ctypes.cast(handler, ctypes.c_void_p)
        jax.ffi.register_ffi_target(name, capsule(address, None, None), platform="cpu")
    except Exception as error:
        warnings.warn(
            f"gsjax sorts without numpy, which is slower: XLA refused {name}: {error}", stacklevel=2
        )
        return False
    _HANDLERS[name] = handler
    return True


def _let_checkpoints_repeat_calls() -> None:
    """Allow our calls under `jax.checkpoint`, which refuses unknown effects. Ours may be repeated; JAX has no
    public way to declare that, and if the private one changes, `jax.checkpoint` raises its own error."""
    with contextlib.suppress(ImportError, AttributeError):
        from jax._src import effects, ffi

        effects.remat_allowed_effects.add_type(ffi.FfiEffect)


_let_checkpoints_repeat_calls()


def call(name: str, result: Any, *arguments: Array) -> Any:
    """Call the function registered under this name on int32 and uint32 arrays; vmap adds leading axes.

    Args:
        name: as registered.
        result: jax.ShapeDtypeStruct of the output, or one for each output.
        *arguments: the inputs.
    """
    # The work needs the interpreter. Effects are awaited before Python exits; otherwise a program that exits
    # during a call would hang. XLA cannot split effects over several devices: there, programs must wait.
    return jax.ffi.ffi_call(
        name, result, vmap_method="broadcast_all", has_side_effect=_num_cpu_devices() == 1
    )(*arguments)


def _num_cpu_devices() -> int:
    try:
        return jax.device_count("cpu")
    except RuntimeError:  # JAX is configured without the CPU
        return 0
