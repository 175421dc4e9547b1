"""PlayCanvas's compressed PLY: values are read to within another encoder's quantisation; faults are named."""

import math
import runpy
import struct

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from gsjax.io.ply import PlyError, read_ply

BOUNDS = [f"{end}_{kind}{axis}" for kind in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
COLOR_BOUNDS = [f"{end}_{c}" for end in ("min", "max") for c in "rgb"]
PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
POSITION_STEP = np.array([1 / 2047, 1 / 1023, 1 / 2047])  # of the range of a chunk
QUAT_STEP = math.sqrt(2) / 1023
ROUNDING = 1e-5  # float32, of values up to 10


def make_scene(count, degree=0, seed=0, low=0.02, high=0.98):
    """Values in the form that the format stores: rgb and opacity 0 to 1, log scales, unit quaternions."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4))
    return {
        "means": rng.uniform(-3, 3, (count, 3)),
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "log_scales": rng.uniform(-9, 1, (count, 3)),
        "rgb": rng.uniform(low, high, (count, 3)),
        "opacities": rng.uniform(0, 1, count),
        "rest": rng.uniform(-3.9, 3.9, (count, 3 * (degree * (degree + 2)))),  # channel-major
    }


def code(fraction, bits):
    return round(fraction * (2**bits - 1))


def pack_quat(quat):
    """w x y z: index of the largest in 2 bits, the other three in 10 bits each."""
    largest = max(range(4), key=lambda i: abs(quat[i]))
    word = largest
    for i in range(4):
        if i != largest:
            word = word * 1024 + code(quat[i] * math.copysign(1, quat[largest]) / math.sqrt(2) + 0.5, 10)
    return word


def fractions(values, low, high):
    """Positions of values between low and high; 0 where these are equal, as in PlayCanvas's encoder."""
    return [(v - a) / (b - a) if b > a else 0.0 for v, a, b in zip(values, low, high, strict=True)]


def pack_three(value, low, high):
    x, y, z = fractions(value, low, high)
    return code(x, 11) * 2**21 + code(y, 10) * 2**11 + code(z, 11)


def pack_color(rgb, opacity, low, high):
    word = 0
    for value in [*fractions(rgb, low, high), opacity]:
        word = word * 256 + code(value, 8)
    return word


def pack(scene, chunk_colors=True):
    """Rows of chunk, vertex and sh of a scene, packed number by number, independently of the reader."""
    chunks, vertices = [], []
    for start in range(0, len(scene["means"]), 256):
        part = {name: value[start : start + 256] for name, value in scene.items()}
        means, log_scales, rgb = ([part[n].min(0), part[n].max(0)] for n in ("means", "log_scales", "rgb"))
        if not chunk_colors:
            rgb = [np.zeros(3), np.ones(3)]
        chunks.append(np.concatenate([*means, *log_scales, *(rgb if chunk_colors else ())]))
        vertices += [
            (
                pack_three(part["means"][i], *means),
                pack_quat(part["quats"][i]),
                pack_three(part["log_scales"][i], *log_scales),
                pack_color(part["rgb"][i], part["opacities"][i], *rgb),
            )
            for i in range(len(part["means"]))
        ]
    rest = [[min(255, max(0, math.floor((v / 8 + 0.5) * 256))) for v in row] for row in scene["rest"]]
    return chunks, vertices, rest


def header_lines(name, count, kind, properties):
    return [f"element {name} {count}", *(f"property {kind} {prop}" for prop in properties)]


def write(path, scene, chunk_colors=True):
    """Writes a compressed PLY with the layout of splat-transform."""
    chunks, vertices, rest = pack(scene, chunk_colors)
    rest_names = [f"f_rest_{i}" for i in range(scene["rest"].shape[1])]
    header = ["ply", "format binary_little_endian 1.0", "comment made by a test"]
    header += header_lines("chunk", len(chunks), "float", BOUNDS + (COLOR_BOUNDS if chunk_colors else []))
    header += header_lines("vertex", len(vertices), "uint", PACKED)
    header += header_lines("sh", len(rest), "uchar", rest_names) if rest_names else []
    body = b"".join(struct.pack(f"<{len(row)}f", *row) for row in chunks)
    body += b"".join(struct.pack("<4I", *row) for row in vertices) + b"".join(bytes(row) for row in rest)
    path.write_bytes("\n".join([*header, "end_header\n"]).encode() + body)


def rewrite(path, change, **options):
    """Write the file again with `change` applied to its elements, a dict of structured arrays by name."""
    elements = {element.name: np.array(element.data) for element in PlyData.read(str(path)).elements}
    change(elements)
    described = [PlyElement.describe(rows, name) for name, rows in elements.items()]
    PlyData(described, **options).write(str(path))


def only(rows, names):
    """A copy of a structured array with only these properties."""
    kept = np.empty(len(rows), [(name, rows.dtype[name]) for name in names])
    for name in names:
        kept[name] = rows[name]
    return kept


def with_type(rows, name, dtype):
    """A copy of a structured array with one property cast."""
    return rows.astype([(n, dtype if n == name else rows.dtype[n]) for n in rows.dtype.names])


def chunk_widths(values):
    """max - min of the chunk of each row."""
    parts = [values[i : i + 256] for i in range(0, len(values), 256)]
    return np.concatenate([np.broadcast_to(np.ptp(part, axis=0), part.shape) for part in parts])


def sh0_to_rgb(sh0):
    return np.asarray(sh0)[:, 0] / math.sqrt(4 * math.pi) + 0.5


@pytest.mark.parametrize("chunk_colors", [True, False])
@pytest.mark.parametrize(("count", "degree"), [(1, 0), (255, 3), (256, 1), (257, 2), (700, 3)])
def test_packed_values_come_back_to_within_half_a_step(tmp_path, count, degree, chunk_colors):
    path = tmp_path / "scene.compressed.ply"
    scene = make_scene(count, degree)
    write(path, scene, chunk_colors)
    gaussians, report = read_ply(path)
    assert (report.stored, report.culled, report.extra, report.labels) == (count, 0, (), None)

    def check(found, wanted, tolerance):
        assert np.all(np.abs(np.asarray(found, np.float64) - wanted) <= tolerance)

    for name in ("means", "log_scales"):
        step = chunk_widths(scene[name]) * POSITION_STEP
        check(getattr(gaussians, name), scene[name], 0.5 * step + ROUNDING)
    width = chunk_widths(scene["rgb"]) if chunk_colors else 1.0
    check(sh0_to_rgb(gaussians.sh0), scene["rgb"], 0.5 * width / 255 + ROUNDING)
    check(gaussians.opacities, scene["opacities"], 0.5 / 255 + ROUNDING)

    rows, largest = np.arange(count), np.abs(scene["quats"]).argmax(1)
    sign = np.sign(scene["quats"][rows, largest])
    # The largest is computed from the others: |d largest| <= sum |other| / largest |d other| <= 3 half steps
    # (plus second-order terms, for which 1 % is ample).
    tolerance = np.where(np.arange(4) == largest[:, None], 3.03, 1.0) * 0.5 * QUAT_STEP + ROUNDING
    check(gaussians.quats, sign[:, None] * scene["quats"], tolerance)
    np.testing.assert_allclose(np.linalg.norm(gaussians.quats, axis=1), 1, atol=1e-6)

    if degree == 0:
        assert gaussians.shN is None
    else:
        wanted = scene["rest"].reshape(count, 3, -1).transpose(0, 2, 1)
        check(gaussians.shN, wanted, 8 / 256 / 2 + ROUNDING)


def test_each_byte_of_the_harmonics_is_read_as_splat_transform_does(tmp_path):
    path = tmp_path / "scene.ply"
    scene = make_scene(256, degree=1)
    # From below the first bin to above the last; the writer clips.
    scene["rest"][:, 4] = (np.arange(256) - 128 + 0.7) / 32
    scene["rest"][0, 4], scene["rest"][255, 4] = -77, 77
    write(path, scene)
    channel, coefficient = divmod(4, 3)
    values = np.asarray(read_ply(path)[0].shN)[:, coefficient, channel]
    assert (values[0], values[128], values[255]) == (-4, 1 / 64, 4)
    np.testing.assert_array_equal(values[1:255], (np.arange(1, 255) + 0.5) / 32 - 4)


def test_opacities_of_0_and_1_have_finite_logits(tmp_path):
    path = tmp_path / "scene.ply"
    scene = make_scene(3)
    scene["opacities"][:] = 0, 0.5, 1
    write(path, scene)
    gaussians, report = read_ply(path)
    assert report.culled == 0
    np.testing.assert_allclose(gaussians.opacities, [0, 128 / 255, 1], atol=2e-6)
    assert np.all(np.isfinite(gaussians.logit_opacities))


def test_each_component_may_be_the_largest(tmp_path):
    path = tmp_path / "scene.ply"
    scene = make_scene(8)
    scene["quats"][:] = np.concatenate([np.eye(4), -np.eye(4)])
    write(path, scene)
    quats = np.asarray(read_ply(path)[0].quats)
    np.testing.assert_allclose(quats, np.concatenate([np.eye(4)] * 2), atol=0.51 * QUAT_STEP)


def test_a_quantity_that_does_not_vary_in_its_chunk_is_exact(tmp_path):
    path = tmp_path / "scene.ply"
    scene = make_scene(5)
    scene["means"][:] = 0.1, -20.3, 3e4
    write(path, scene)
    with pytest.warns(UserWarning, match="relative to the origin"):
        _, report = read_ply(path)
    np.testing.assert_array_equal(report.places, scene["means"].astype(np.float32))


def test_chunks_far_from_0_keep_the_fractions_of_their_places(tmp_path):
    path, scene = tmp_path / "scene.ply", make_scene(300)
    scene["means"] += 2.0**20  # float32 has steps of 0.125 there, chunks of 6 have steps of 0.003
    write(path, scene)
    with pytest.warns(UserWarning, match="relative to the origin"):
        gaussians, report = read_ply(path)
    within = 0.5 * chunk_widths(scene["means"]) * POSITION_STEP + 0.0625  # bounds are float32
    assert (np.abs(report.places - scene["means"]) <= within).all()
    assert len(np.unique(np.asarray(gaussians.means)[:, 0])) > 100


def test_an_empty_scene_is_read(tmp_path):
    path = tmp_path / "scene.ply"
    write(path, make_scene(0, degree=2))
    gaussians, report = read_ply(path)
    assert (gaussians.num, gaussians.sh_degree, report.stored) == (0, 2, 0)


@pytest.mark.parametrize("options", [{"text": True}, {"byte_order": ">"}])
def test_ascii_and_the_other_byte_order_give_the_same(tmp_path, options):
    path = tmp_path / "scene.ply"
    write(path, make_scene(300, degree=1))
    wanted, _ = read_ply(path)
    rewrite(path, lambda elements: None, **options)
    found, _ = read_ply(path)
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN"):
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), atol=1e-5, err_msg=name)


def test_labels_are_read_and_other_properties_reported(tmp_path):
    path = tmp_path / "scene.ply"
    write(path, make_scene(4))

    def add(elements):
        old = elements["vertex"]
        new = np.zeros(len(old), [*old.dtype.descr, ("label", "<i4"), ("confidence", "<f4")])
        for name in old.dtype.names:
            new[name] = old[name]
        new["label"] = [3, 1, 4, 1]
        elements["vertex"] = new

    rewrite(path, add)
    _, report = read_ply(path)
    np.testing.assert_array_equal(report.labels, [3, 1, 4, 1])
    assert report.extra == ("confidence",)


@pytest.mark.parametrize("keep", [0.99, 0.6, 0.1])
def test_a_file_cut_off_is_named(tmp_path, keep):
    path = tmp_path / "scene.compressed.ply"
    write(path, make_scene(300, degree=1))
    content = path.read_bytes()
    path.write_bytes(content[: int(keep * len(content))])
    with pytest.raises(
        PlyError, match=r"scene\.compressed\.ply: expected a complete PLY file.*export it again"
    ):
        read_ply(path)


def drop_chunk_row(elements):
    elements["chunk"] = elements["chunk"][:-1]


def drop_sh_row(elements):
    elements["sh"] = elements["sh"][:-1]


def drop_chunks(elements):
    del elements["chunk"]


def drop(element, *names):
    def change(elements):
        rows = elements[element]
        elements[element] = only(rows, [name for name in rows.dtype.names if name not in names])

    return change


def cast(element, name, dtype):
    def change(elements):
        elements[element] = with_type(elements[element], name, dtype)

    return change


def set_bound(name, value):
    def change(elements):
        elements["chunk"][name][1] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (drop_chunks, r"element 'chunk' for packed vertices, found only elements vertex, sh"),
        (drop_chunk_row, r"2 rows of element 'chunk' \(300 Gaussians, 256 per chunk\), found 1"),
        (drop_sh_row, r"300 rows of element 'sh' \(one per Gaussian\), found 299"),
        (drop("vertex", "packed_scale"), r"packed_color in element 'vertex', found no packed_scale among"),
        (drop("chunk", "max_y", "min_scale_z"), r"element 'chunk', found no max_y, min_scale_z among min_x"),
        (drop("chunk", "max_b"), r"max_b in element 'chunk', found no max_b among"),
        (drop("sh", "f_rest_3"), r"9, 24 or 45 properties f_rest_\* .*found 8"),
        (drop("sh", *(f"f_rest_{i}" for i in range(1, 9))), r"properties f_rest_\* .*found 1"),
        (
            cast("vertex", "packed_rotation", "f4"),
            r"uint32 in element 'vertex', found float32 packed_rot",
        ),
        (cast("chunk", "min_x", "i4"), r"float32 or float64 in element 'chunk', found int32 min_x"),
        (cast("sh", "f_rest_2", "f4"), r"uint8 in element 'sh', found float32 f_rest_2"),
        (
            set_bound("max_scale_y", np.nan),
            r"finite bounds in every chunk, found max_scale_y = nan in chunk",
        ),
        (set_bound("min_r", -np.inf), r"found min_r = -inf in chunk 1 .*before compressing"),
    ],
)
def test_each_fault_names_the_file_what_was_expected_and_found(tmp_path, change, message):
    path = tmp_path / "scene.compressed.ply"
    write(path, make_scene(300, degree=1))
    rewrite(path, change)
    with pytest.raises(PlyError, match=rf"scene\.compressed\.ply: expected .*{message}"):
        read_ply(path)


def test_a_real_file_gives_the_numbers_of_another_decoder(shared_data):
    """The guitar from PlayCanvas's examples against decode.py, which was checked by rendering."""
    folder = shared_data / "guitar"
    path, decoder = folder / "guitar.compressed.ply", folder / "decode.py"
    if not (path.is_file() and decoder.is_file()):
        pytest.skip(f"no guitar.compressed.ply with its decode.py in {folder}")
    wanted = runpy.run_path(str(decoder))["decode"](path)
    gaussians, report = read_ply(path)
    assert (gaussians.num, report.culled, gaussians.shN) == (90854, 0, None)
    # decode.py subtracts the bounds (up to 4 apart) in float32.
    np.testing.assert_allclose(gaussians.means, wanted["means"], atol=1e-6)
    np.testing.assert_allclose(gaussians.quats, wanted["quats_wxyz"], atol=1e-6)
    np.testing.assert_allclose(gaussians.log_scales, wanted["log_scales"], atol=1e-5)
    np.testing.assert_allclose(sh0_to_rgb(gaussians.sh0), wanted["rgb"], atol=1e-6)
    np.testing.assert_allclose(gaussians.opacities, wanted["opacity"], atol=2e-6)
