"""Perceptual similarity of images: LPIPS (Zhang, Isola, Efros, Shechtman, Wang 2018), version 0.1.

The network runs in JAX; the user provides its weights as local files. These hold arrays under the names that
torchvision and the `lpips` package use: `features.N.weight` and `features.N.bias` of AlexNet or VGG16, and
`linN.model.1.weight` of the heads. Formats that can run code when read are refused.
"""

import hashlib
import io
import json
import os
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Num

CONVERT = (
    'In an environment with torch: python -c "import sys, numpy, torch; '
    "w = torch.load(sys.argv[1], map_location='cpu', weights_only=True); "
    'numpy.savez(sys.argv[2], **{k: v.numpy() for k, v in w.items()})" OLD.pth NEW.npz'
)
"""How to convert a file of torch into one that can be read."""
_ADVICE = (
    "Provide torchvision's features of AlexNet or VGG16 and the heads of lpips, under their original names, "
    "in one file or in a folder of files; docs/scores.md says how to make them"
)
_PICKLES = (".pth", ".pt", ".bin", ".ckpt", ".pkl", ".pickle")
_DTYPES = {"F64": "<f8", "F32": "<f4", "F16": "<f2"}
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # per channel, for colours -1 to 1


class _Layer(NamedTuple):
    """A convolution followed by a ReLU, and optionally preceded by max pooling of stride 2."""

    index: int  # in torchvision's `features`
    channels: int
    size: int = 3
    stride: int = 1
    padding: int = 1
    pool: int = 0  # window of the max pooling; 0 for none
    compared: bool = False


class _Network(NamedTuple):
    name: str
    layers: tuple[_Layer, ...]
    least_side: int  # pixels; the last layer of a smaller image would be empty

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Expected shapes of the arrays in a file, by name."""
        shapes: dict[str, tuple[int, ...]] = {}
        before = 3
        for i, channels, size, *_ in self.layers:
            shapes[f"features.{i}.weight"] = (channels, before, size, size)
            shapes[f"features.{i}.bias"] = (channels,)
            before = channels
        heads = [layer.channels for layer in self.layers if layer.compared]
        return shapes | {f"lin{i}.model.1.weight": (1, n, 1, 1) for i, n in enumerate(heads)}


_ALEXNET = _Network(
    "AlexNet",
    (
        _Layer(0, 64, size=11, stride=4, padding=2, compared=True),
        _Layer(3, 192, size=5, padding=2, pool=3, compared=True),
        _Layer(6, 384, pool=3, compared=True),
        _Layer(8, 256, compared=True),
        _Layer(10, 256, compared=True),
    ),
    least_side=31,
)
_VGG16 = _Network(
    "VGG16",
    (
        *(_Layer(0, 64), _Layer(2, 64, compared=True)),
        *(_Layer(5, 128, pool=2), _Layer(7, 128, compared=True)),
        *(_Layer(10, 256, pool=2), _Layer(12, 256), _Layer(14, 256, compared=True)),
        *(_Layer(17, 512, pool=2), _Layer(19, 512), _Layer(21, 512, compared=True)),
        *(_Layer(24, 512, pool=2), _Layer(26, 512), _Layer(28, 512, compared=True)),
    ),
    least_side=16,
)
_NETWORKS = {network.name: network for network in (_ALEXNET, _VGG16)}
_USED = {name for network in _NETWORKS.values() for name in network.shapes}


class LpipsWeights(NamedTuple):
    """Weights of the image network and of the heads that compare its features.

    Attributes:
        network: AlexNet or VGG16.
        convolutions: (kernel [out, in, kh, kw], bias [out]) of each convolution.
        heads: weight of each channel, for each of the five layers that are compared.
    """

    network: Literal["AlexNet", "VGG16"]
    convolutions: tuple[tuple[Float[Array, "o i kh kw"], Float[Array, "o"]], ...]
    heads: tuple[Float[Array, "..."], ...]

    @property
    def least_side(self) -> int:
        """Smallest side of an image, pixels."""
        return _NETWORKS[self.network].least_side


def fingerprint(weights: LpipsWeights) -> str:
    """A hash that identifies the weights; only scores with the same weights are comparable."""
    found = hashlib.sha256(weights.network.encode())
    for array in jax.tree.leaves((weights.convolutions, weights.heads)):
        found.update(np.asarray(array).tobytes())
    return found.hexdigest()[:16]


def lpips(
    weights: LpipsWeights,
    image: Num[np.ndarray, "..."],
    reference: Num[np.ndarray, "..."],
    mask: Bool[np.ndarray, "..."] | None = None,
) -> float:
    """Learned perceptual image patch similarity; 0 for equal images, lower is more similar.

        sum over layers of mean over places of sum over channels of w (a / |a| - b / |b|)^2

    where a and b are the features of the two images at a place, and w the weights of the head.

    With a mask, the mean over places is weighted by the fraction of each that the mask covers; the network
    still sees the surroundings.

    Args:
        weights: network and heads, from `load_lpips`.
        image, reference: [H, W, 3], RGB, 0 to 1.
        mask: [H, W], True where to compare.

    Returns:
        NaN if the mask is empty.

    Raises:
        ValueError: the shapes do not agree, or the image is too small for the network.
    """
    if np.shape(image) != np.shape(reference):
        raise ValueError(f"reference: expected shape {np.shape(image)}, found {np.shape(reference)}")
    if np.ndim(image) != 3 or np.shape(image)[2] != 3:
        raise ValueError(f"image: expected shape [H, W, 3], RGB, found {np.shape(image)}")
    height, width = np.shape(image)[:2]
    if min(height, width) < weights.least_side:
        raise ValueError(
            f"image: expected at least {weights.least_side} pixels on each side for LPIPS with "
            f"{weights.network}, found {(height, width)}"
        )
    if mask is not None:
        mask = np.asarray(mask)
        if mask.shape != (height, width):
            raise ValueError(f"mask: expected shape {(height, width)} to match image, found {mask.shape}")
        if not mask.any():
            return float("nan")
    both = np.stack([image, reference]).astype(np.float32)
    maps = jax.device_get(_distances(weights.network, weights.convolutions, weights.heads, both))
    return float(sum(_mean(distance, mask) for distance in maps))


def _mean(distance: np.ndarray, mask: np.ndarray | None) -> float:
    if mask is None:
        return float(distance.mean(dtype=np.float64))
    covered = cv2.resize(mask.astype(np.float32), distance.shape[::-1], interpolation=cv2.INTER_AREA)
    return float(np.average(distance.astype(np.float64), weights=covered))


@partial(jax.jit, static_argnums=0)
def _distances(
    network: str,
    convolutions: tuple[tuple[Array, Array], ...],
    heads: tuple[Array, ...],
    pictures: Float[Array, "two h w c"],
) -> list[Float[Array, "places_y places_x"]]:
    """Distance between the two images at each place of each layer."""
    shift, scale = jnp.array(_SHIFT, pictures.dtype), jnp.array(_SCALE, pictures.dtype)
    x = jnp.moveaxis((2 * pictures - 1 - shift) / scale, -1, 1)
    maps = []
    for layer, (kernel, bias) in zip(_NETWORKS[network].layers, convolutions, strict=True):
        if layer.pool:
            window, strides = (1, 1, layer.pool, layer.pool), (1, 1, 2, 2)
            x = jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, window, strides, "VALID")
        strides, padding = (layer.stride,) * 2, [(layer.padding,) * 2] * 2
        x = jax.lax.conv_general_dilated(x, kernel, strides, padding, precision=jax.lax.Precision.HIGHEST)
        x = jax.nn.relu(x + bias[:, None, None])
        if layer.compared:
            units = x / (jnp.sqrt(jnp.sum(x**2, axis=1, keepdims=True)) + 1e-10)
            maps.append(jnp.einsum("c,chw->hw", heads[len(maps)], (units[0] - units[1]) ** 2))
    return maps


def load_lpips(path: str | os.PathLike) -> LpipsWeights:
    """Read the weights of LPIPS; the network is recognised by their shapes.

    Args:
        path: a .npz or .safetensors file, or a folder of such files that together hold the weights. Other
            arrays in them, such as torchvision's classifier, are ignored.

    Raises:
        FileNotFoundError: there is no such file or folder, or the folder holds none.
        OSError: a file cannot be opened, as without permission.
        ValueError: the format is not supported (a pickle of torch), a file is damaged, or an array is missing
            or has a wrong shape.
    """
    path = Path(path)
    arrays: dict[str, np.ndarray] = {}
    for file in _files(path):
        arrays |= _read(file)
    first = arrays.get("features.0.weight")
    found = "no such array" if first is None else str(first.shape)
    network = next(
        (n for n in _NETWORKS.values() if first is not None and n.shapes["features.0.weight"] == first.shape),
        None,
    )
    if network is None:
        wanted = " or ".join(f"{n.shapes['features.0.weight']} ({n.name})" for n in _NETWORKS.values())
        raise ValueError(f"{path}: expected features.0.weight of shape {wanted}, found {found}. {_ADVICE}")
    for name, shape in network.shapes.items():
        if name not in arrays or arrays[name].shape != shape:
            found = str(arrays[name].shape) if name in arrays else "no such array"
            raise ValueError(f"{path}: expected {name} of shape {shape}, found {found}. {_ADVICE}")
        if not np.isfinite(arrays[name]).all():
            raise ValueError(f"{path}: expected finite numbers in {name}, found NaN or infinity")
    parts = {name: jnp.asarray(arrays[name], jnp.float32) for name in network.shapes}
    convolutions = tuple(
        (parts[f"features.{layer.index}.weight"], parts[f"features.{layer.index}.bias"])
        for layer in network.layers
    )
    heads = tuple(part[0, :, 0, 0] for name, part in parts.items() if name.startswith("lin"))
    return LpipsWeights(network.name, convolutions, heads)


def _files(path: Path) -> list[Path]:
    """The files that hold the weights; pickles are refused."""
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix.lower() in _READERS)
        if files:
            return files
        names = ", ".join(sorted(entry.name for entry in path.iterdir())[:8]) or "an empty folder"
        raise FileNotFoundError(
            f"{path}: expected weights of LPIPS as .npz or .safetensors, found {names}. {CONVERT}"
        )
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected weights of LPIPS, found nothing there. {_ADVICE}")
    if path.suffix.lower() not in _READERS:
        why = " A pickle of torch can run code when it is read, so gsjax reads none."
        why = why if path.suffix.lower() in _PICKLES else ""
        raise ValueError(f"{path}: expected .npz or .safetensors, found {path.suffix!r}.{why} {CONVERT}")
    return [path]


# Arrays that are not used may have types that numpy lacks or that take pickles, and are not decoded.


def _read_npz(data: bytes) -> dict[str, np.ndarray]:
    with np.load(io.BytesIO(data), allow_pickle=False) as saved:
        return {name: saved[name] for name in _USED.intersection(saved.files)}


def _read_safetensors(data: bytes) -> dict[str, np.ndarray]:
    """The format: the length of the header (8 bytes), the header as JSON, and the bytes of the arrays."""
    start = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:start])
    arrays = {}
    for name, entry in header.items():
        if name not in _USED:
            continue
        if entry["dtype"] not in _DTYPES:
            raise ValueError(f"{name}: expected {' or '.join(_DTYPES)}, found {entry['dtype']}")
        begin, end = (start + offset for offset in entry["data_offsets"])
        arrays[name] = np.frombuffer(data[begin:end], _DTYPES[entry["dtype"]]).reshape(entry["shape"])
    return arrays


_READERS = {".npz": _read_npz, ".safetensors": _read_safetensors}


def _read(file: Path) -> dict[str, np.ndarray]:
    data = file.read_bytes()
    try:
        return _READERS[file.suffix.lower()](data)
    except Exception as error:  # of numpy, zipfile, zlib and json, for damaged files
        raise ValueError(
            f"{file}: expected named arrays, found a file that cannot be read ({error}); convert the "
            f"weights again. {CONVERT}"
        ) from error
