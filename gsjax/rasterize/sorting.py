"""Sorting of 32-bit keys: numpy's vectorised sort where XLA runs on the CPU, XLA's own elsewhere.

XLA:CPU sorts with scalar comparisons: half a million keys take it 17 ms, numpy 1.1 ms, and binning is mostly
sorting. So on the CPU the sort is a custom call that hands XLA's own buffers to numpy. It speaks XLA's
foreign function interface (xla/ffi/api/c_api.h, which jaxlib ships) through ctypes and needs no compiler.
Unlike `jax.pure_callback` it copies nothing, and it cannot hang on a machine with a single core. Both ways
give the same order to the bit. Where the interface is not as expected, XLA's sort is used there too.
"""

import ctypes
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, UInt32

_EXTENSION_METADATA = 1  # XLA asks which version of the interface a handler speaks
_VERSION = (0, 1)  # the oldest that has what is used here: newer runtimes accept it
_INTERNAL_ERROR = 13


def _struct(name: str, *fields) -> type[ctypes.Structure]:
    """A C structure; every one of the interface opens with its size and a pointer to extensions."""
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
        ("metadata", ctypes.POINTER(_Metadata)),  # there if the type says so
    ]


_Handler = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_Frame))
_CreateError = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_ErrorArgs))


def _view(buffers, dtype) -> np.ndarray:
    """The first of these buffers as an array of 4-byte elements, without a copy."""
    buffer = buffers.items[0].contents
    shape = [buffer.dims[i] for i in range(buffer.rank)]
    size = 4 * int(np.prod(shape, dtype=np.int64))
    if size == 0:
        return np.empty(shape, dtype)
    return np.frombuffer((ctypes.c_char * size).from_address(buffer.data), dtype).reshape(shape)


def _handler(work: Callable[[np.ndarray, np.ndarray], None], result_dtype) -> ctypes._CFuncPtr:
    """`work(input, output)` on numpy views, as a function that XLA can call."""

    def call(pointer):
        frame = pointer.contents
        if frame.extension:
            extension = ctypes.cast(frame.extension, ctypes.POINTER(_Extension)).contents
            if extension.type == _EXTENSION_METADATA:
                version = extension.metadata.contents.version
                version.major, version.minor = _VERSION
                return None
        try:
            work(_view(frame.args, np.uint32), _view(frame.rets, result_dtype))
        except Exception as error:
            api = ctypes.cast(frame.api, ctypes.POINTER(_Api)).contents
            message = f"sorting on the host failed: {type(error).__name__}: {error}".encode()
            args = _ErrorArgs(ctypes.sizeof(_ErrorArgs), None, message, _INTERNAL_ERROR)
            return _CreateError(api.create_error)(ctypes.byref(args))
        return None

    return _Handler(call)


def _sort_into(keys: np.ndarray, out: np.ndarray) -> None:
    np.copyto(out, keys)
    out.sort(axis=-1)


def _argsort_into(keys: np.ndarray, out: np.ndarray) -> None:
    # The position below the key makes every key unique, hence the order stable, and 64 bits sort fast.
    paired = keys.astype(np.uint64)
    paired <<= np.uint64(32)
    paired |= np.arange(keys.shape[-1], dtype=np.uint64)
    paired.sort(axis=-1)
    np.copyto(out, paired.astype(np.uint32).view(np.int32))


_HANDLERS = {  # kept alive: XLA holds their addresses
    "gsjax_sort": _handler(_sort_into, np.uint32),
    "gsjax_argsort": _handler(_argsort_into, np.int32),
}


def _register() -> bool:
    capsule = ctypes.pythonapi.PyCapsule_New
    capsule.restype, capsule.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    try:
        for name, handler in _HANDLERS.items():
            address = ctypes.cast(handler, ctypes.c_void_p)
            jax.ffi.register_ffi_target(name, capsule(address, None, None), platform="cpu")
    except Exception:  # another interface: XLA's own sort is slower and just as right
        return False
    return True


_AVAILABLE = _register()


def _on_host(name: str, keys: UInt32[Array, "n"], dtype) -> Array:
    result = jax.ShapeDtypeStruct(keys.shape, dtype)
    return jax.ffi.ffi_call(name, result, vmap_method="broadcast_all")(keys)


def sort_keys(keys: UInt32[Array, "n"], where: str = "host") -> UInt32[Array, "n"]:
    """The keys in ascending order. `where` is a plan's `sort`: "host", or "device" for XLA's own sort."""
    if where == "device" or not _AVAILABLE:
        return jnp.sort(keys)
    return jax.lax.platform_dependent(
        keys, cpu=lambda k: _on_host("gsjax_sort", k, jnp.uint32), default=jnp.sort
    )


def argsort_keys(keys: UInt32[Array, "n"], where: str = "host") -> Int[Array, "n"]:
    """The stable order of the keys. `where` as in `sort_keys`."""

    def on_device(keys):
        return jnp.argsort(keys, stable=True).astype(jnp.int32)

    if where == "device" or not _AVAILABLE:
        return on_device(keys)
    return jax.lax.platform_dependent(
        keys, cpu=lambda k: _on_host("gsjax_argsort", k, jnp.int32), default=on_device
    )
