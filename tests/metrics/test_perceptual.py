"""LPIPS against a plain float64 implementation with random weights; unsupported files are refused."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

from gsjax.metrics.perceptual import load_lpips, lpips

# (index, channels, window, stride, padding) of a convolution; a number is max pooling with that window; *
# marks a layer that is compared. Written as in the papers' tables, independently of the package.
ALEXNET = (
    (0, 64, 11, 4, 2),
    "*",
    3,
    (3, 192, 5, 1, 2),
    "*",
    3,
    (6, 384, 3, 1, 1),
    "*",
    (8, 256, 3, 1, 1),
    "*",
)
ALEXNET += ((10, 256, 3, 1, 1), "*")
VGG16 = ((0, 64, 3, 1, 1), (2, 64, 3, 1, 1), "*", 2, (5, 128, 3, 1, 1), (7, 128, 3, 1, 1), "*", 2)
VGG16 += ((10, 256, 3, 1, 1), (12, 256, 3, 1, 1), (14, 256, 3, 1, 1), "*", 2)
VGG16 += ((17, 512, 3, 1, 1), (19, 512, 3, 1, 1), (21, 512, 3, 1, 1), "*", 2)
VGG16 += ((24, 512, 3, 1, 1), (26, 512, 3, 1, 1), (28, 512, 3, 1, 1), "*")


def random_weights(network, seed=0):
    rng, arrays, channels, head = np.random.default_rng(seed), {}, 3, 0
    for entry in network:
        if entry == "*":
            arrays[f"lin{head}.model.1.weight"] = rng.uniform(0, 1, (1, channels, 1, 1)).astype(np.float32)
            head += 1
        elif isinstance(entry, tuple):
            index, outputs, size, *_ = entry
            spread = math.sqrt(2 / (channels * size * size))
            kernel = spread * rng.standard_normal((outputs, channels, size, size), np.float32)
            arrays[f"features.{index}.weight"] = kernel
            arrays[f"features.{index}.bias"] = 0.2 * rng.standard_normal(outputs, np.float32)
            channels = outputs
    return arrays


def reference(network, arrays, image, other):
    """LPIPS and its maps of distances, in float64."""
    x = (2 * np.stack([image, other]) - 1 - [-0.03, -0.088, -0.188]) / [0.458, 0.448, 0.45]
    maps = []
    for entry in network:
        if entry == "*":
            units = x / np.linalg.norm(x, axis=-1, keepdims=True)
            head = arrays[f"lin{len(maps)}.model.1.weight"][0, :, 0, 0].astype(float)
            maps.append((units[0] - units[1]) ** 2 @ head)
        elif isinstance(entry, int):
            x = sliding_window_view(x, (entry, entry), axis=(1, 2))[:, ::2, ::2].max((-1, -2))
        else:
            index, _, size, stride, padding = entry
            x = np.pad(x, [(0, 0), (padding, padding), (padding, padding), (0, 0)])
            patches = sliding_window_view(x, (size, size), axis=(1, 2))[:, ::stride, ::stride]
            kernel = arrays[f"features.{index}.weight"].astype(float)
            x = np.tensordot(patches, kernel, ((3, 4, 5), (1, 2, 3))) + arrays[f"features.{index}.bias"]
            x = np.maximum(x, 0)
    return sum(m.mean() for m in maps), maps


def pictures(shape, seed=1):
    rng = np.random.default_rng(seed)
    image = rng.uniform(0, 1, (*shape, 3))
    return image, np.clip(image + rng.normal(0, 0.2, image.shape), 0, 1)


def write_safetensors(path, arrays):
    """Follows the specification of the format."""
    header, end = {"__metadata__": {"format": "pt"}}, 0
    for name, array in arrays.items():
        begin, end = end, end + array.nbytes
        kind = {"float32": "F32", "float16": "F16", "int64": "I64"}[array.dtype.name]
        header[name] = {"dtype": kind, "shape": array.shape, "data_offsets": [begin, end]}
    text = json.dumps(header).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + b"".join(a.tobytes() for a in arrays.values()))


@pytest.fixture(scope="module")
def alexnet():
    return random_weights(ALEXNET)


@pytest.fixture(scope="module")
def alexnet_file(alexnet, tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "lpips.npz"
    np.savez(path, **alexnet)
    return path


def test_alexnet_agrees_with_a_plain_one(alexnet, alexnet_file):
    weights = load_lpips(alexnet_file)
    assert weights.network == "AlexNet"
    for shape in ((31, 31), (45, 62)):
        image, other = pictures(shape)
        expected, _ = reference(ALEXNET, alexnet, image, other)
        assert lpips(weights, image, other) == pytest.approx(expected, rel=1e-5)
    assert lpips(weights, image, image) == pytest.approx(0, abs=1e-9)
    assert lpips(weights, image, other) == pytest.approx(lpips(weights, other, image), rel=1e-6)


def test_vgg16_agrees_with_a_plain_one_and_may_lie_in_two_files(tmp_path):
    arrays = random_weights(VGG16)
    heads = {name: array for name, array in arrays.items() if name.startswith("lin")}
    rest = {name: array for name, array in arrays.items() if name not in heads}
    write_safetensors(tmp_path / "vgg16.safetensors", rest | {"classifier.6.bias": np.ones(3, np.float32)})
    np.savez(tmp_path / "heads.npz", **heads)
    (tmp_path / "README.txt").write_text("ours")
    weights = load_lpips(tmp_path)
    assert weights.network == "VGG16"
    image, other = pictures((19, 23))
    expected, _ = reference(VGG16, arrays, image, other)
    assert lpips(weights, image, other) == pytest.approx(expected, rel=1e-5)
    with pytest.raises(ValueError, match="expected at least 16 pixels on each side for LPIPS with VGG16"):
        lpips(weights, image[:15], other[:15])


def test_a_mask_weighs_places_by_what_it_covers(alexnet, alexnet_file):
    weights = load_lpips(alexnet_file)
    image, other = pictures((47, 47))
    other[:, 24:] = image[:, 24:]
    left = np.zeros((47, 47), bool)
    left[:, :23] = True
    whole = lpips(weights, image, other)
    assert lpips(weights, image, other, np.ones((47, 47), bool)) == pytest.approx(whole, rel=1e-6)
    _, maps = reference(ALEXNET, alexnet, image, other)
    shares = []
    for layer in maps:  # columns of places, weighted by the fraction left of the edge
        columns = layer.shape[1]
        covered = np.clip(23 / 47 * columns - np.arange(columns), 0, 1)
        shares.append((layer * covered).sum() / (covered.sum() * layer.shape[0]))
    assert lpips(weights, image, other, left) == pytest.approx(sum(shares), rel=1e-4)
    assert lpips(weights, image, other, left) > 1.2 * whole > 2 * lpips(weights, image, other, ~left)
    assert math.isnan(lpips(weights, image, other, np.zeros((47, 47), bool)))


def test_pictures_that_do_not_agree_or_are_too_small(alexnet_file):
    weights = load_lpips(alexnet_file)
    image, other = pictures((31, 40))
    with pytest.raises(ValueError, match=r"reference: expected shape \(31, 40, 3\), found \(30, 40, 3\)"):
        lpips(weights, image, other[1:])
    with pytest.raises(ValueError, match=r"mask: expected shape \(31, 40\) .* found \(3, 3\)"):
        lpips(weights, image, other, np.ones((3, 3), bool))
    with pytest.raises(ValueError, match=r"expected at least 31 pixels on each side .* found \(30, 40\)"):
        lpips(weights, image[1:], other[1:])


@pytest.mark.parametrize("suffix", [".pth", ".pt", ".bin", ".pkl"])
def test_a_pickle_is_not_read_and_how_to_convert_it_is_said(tmp_path, suffix):
    path = tmp_path / f"alex{suffix}"
    path.write_bytes(b"cposix\nsystem\n(S'touch pwned'\ntR.")
    with pytest.raises(ValueError, match=r"expected \.npz or \.safetensors.*weights_only=True.*savez"):
        load_lpips(path)
    with pytest.raises(FileNotFoundError, match=r"expected weights of LPIPS as \.npz .* found alex"):
        load_lpips(tmp_path)


def test_a_pickle_inside_an_npz_is_not_read(tmp_path):
    np.savez(tmp_path / "w.npz", **{"features.0.weight": np.array([{"a": 1}], object)})
    with pytest.raises(ValueError, match=r"w\.npz: expected named arrays, found a file that cannot be read"):
        load_lpips(tmp_path / "w.npz")


def test_what_is_missing_or_of_another_shape_is_named(alexnet, tmp_path):
    file = tmp_path / "w.npz"

    def message(arrays):
        np.savez(file, **arrays)
        with pytest.raises(ValueError, match=r"w\.npz: expected") as error:
            load_lpips(file)
        return str(error.value)

    with pytest.raises(FileNotFoundError, match="found nothing there"):
        load_lpips(file)
    other = {"features.0.weight": np.zeros((96, 3, 7, 7))}
    assert "shape (64, 3, 11, 11) (AlexNet) or (64, 3, 3, 3) (VGG16), found (96, 3, 7, 7)" in message(other)
    assert "found no such array" in message({"conv.weight": np.zeros(3)})
    headless = {name: array for name, array in alexnet.items() if not name.startswith("lin3")}
    assert "lin3.model.1.weight of shape (1, 256, 1, 1), found no such array" in message(headless)
    assert "features.3.bias of shape (192,), found (5,)" in message(
        alexnet | {"features.3.bias": np.zeros(5)}
    )
    broken = alexnet["features.6.bias"].copy()
    broken[7] = np.nan
    assert "finite numbers in features.6.bias" in message(alexnet | {"features.6.bias": broken})


def test_a_damaged_safetensors_file_is_named(alexnet, tmp_path):
    file = tmp_path / "w.safetensors"
    write_safetensors(file, {name: array.astype(np.float16) for name, array in alexnet.items()})
    assert load_lpips(file).network == "AlexNet"
    whole = file.read_bytes()
    deep = (100_000).to_bytes(8, "little") + b"[" * 100_000
    for data in (whole[:-100], whole[:40], b"\xff" * 64, b"", deep):
        file.write_bytes(data)
        with pytest.raises(ValueError, match=r"w\.safetensors: expected named arrays"):
            load_lpips(file)
    write_safetensors(file, {"features.0.weight": np.zeros((64, 3, 3, 3), np.int64)})
    with pytest.raises(ValueError, match=r"features\.0\.weight: expected F64 or F32 or F16, found I64"):
        load_lpips(file)


def test_a_file_that_may_not_be_opened_is_not_called_damaged(tmp_path, monkeypatch):
    def denied(path):
        raise PermissionError(13, "Permission denied", str(path))

    write_safetensors(tmp_path / "w.safetensors", {})
    monkeypatch.setattr(Path, "read_bytes", denied)
    with pytest.raises(PermissionError):
        load_lpips(tmp_path)


def test_other_arrays_may_have_any_type(alexnet, tmp_path):
    file = tmp_path / "w.safetensors"
    write_safetensors(file, alexnet | {"bn.num_batches_tracked": np.zeros(1, np.int64)})
    assert load_lpips(file).network == "AlexNet"
    np.savez(tmp_path / "w.npz", **alexnet, config={"net": "alex"})
    assert load_lpips(tmp_path / "w.npz").network == "AlexNet"


def test_a_damaged_npz_is_named(tmp_path):
    file = tmp_path / "w.npz"
    np.savez_compressed(file, **{"features.0.weight": np.zeros((64, 3, 11, 11), np.float32)})
    whole = file.read_bytes()
    for at in range(0, len(whole), 3):
        file.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        with pytest.raises(ValueError, match=r"w\.npz: expected"):
            load_lpips(file)  # undamaged, too: the heads are missing
