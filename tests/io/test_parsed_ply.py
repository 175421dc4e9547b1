"""PLY headers that would keep a parser busy, files that are cut off, and values that mean something else."""

import warnings

import equinox as eqx
import jax.numpy as jnp
import pytest
from plyfile import PlyData

from gsjax.data.clouds import read_cloud
from gsjax.io.ply import PlyError, read_ply, write_ply
from tests.io.scenes_to_write import make_scene

HEADER = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float "


@pytest.mark.parametrize("before", [b"", b"y\ncomment end_header\nproperty float "])
@pytest.mark.parametrize("read", [read_ply, read_cloud])
def test_a_header_without_an_end_is_refused_at_once(tmp_path, read, before):
    path = tmp_path / "points.ply"
    path.write_bytes(HEADER + before + b"[" * 5_000_000)
    with pytest.raises(ValueError, match=r"points.ply: .*\(no end_header in its first 1,048,576 bytes\)"):
        read(path)


def test_lines_may_end_as_on_old_machines(tmp_path):
    path = tmp_path / "points.ply"
    path.write_bytes(HEADER.replace(b"\n", b"\r") + b"y\rproperty float z\rend_header\r1 2 3\r")
    assert read_cloud(path).points.tolist() == [[1, 2, 3]]


def test_opacities_and_sizes_as_they_are_instead_of_logits_and_logarithms(tmp_path):
    scene = make_scene(12)
    write_ply(tmp_path / "scene.ply", scene)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_ply(tmp_path / "scene.ply")
    activated = (jnp.exp(scene.log_scales), scene.opacities)
    write_ply(
        tmp_path / "scene.ply", eqx.tree_at(lambda g: (g.log_scales, g.logit_opacities), scene, activated)
    )
    with pytest.warns(UserWarning, match=r"scene.ply: .*they are read as logits and logarithms"):
        read_ply(tmp_path / "scene.ply")


@pytest.mark.parametrize("text", [False, True])
def test_a_file_that_is_cut_off_tells_what_is_missing(tmp_path, text):
    path = tmp_path / "scene.ply"
    write_ply(tmp_path / "other.ply", make_scene(20))
    PlyData(PlyData.read(tmp_path / "other.ply").elements, text=text).write(path)
    read_ply(path)
    whole = path.read_bytes()
    path.write_bytes(whole[:700])
    promised = whole.index(b"end_header\n") + 11 + 20 * 17 * (2 if text else 4) - text
    with pytest.raises(PlyError, match=rf"\(700 bytes, where its header promises {promised:,} or more\)"):
        read_ply(path)


@pytest.mark.parametrize(
    "words", ["Δευ 8 Μαΐ 2023".encode(), "Exporté".encode("latin-1")], ids=("utf", "latin")
)
@pytest.mark.parametrize("text", [False, True])
def test_comments_may_be_in_any_language(tmp_path, text, words):
    path = tmp_path / "scene.ply"
    write_ply(tmp_path / "other.ply", make_scene(20))
    other = PlyData.read(tmp_path / "other.ply")
    PlyData(other.elements, text=text).write(path)
    path.write_bytes(path.read_bytes().replace(b" 1.0\n", b" 1.0\ncomment " + words + b"\n", 1))
    assert read_ply(path)[0].num == 20
    assert read_cloud(path).points[:, 2].tolist() == pytest.approx(other["vertex"]["z"])


@pytest.mark.parametrize("names", [("强度", "高度"), ("Δx", "Σx")])
def test_properties_may_have_names_in_any_language(tmp_path, names):
    header = ["ply", "format ascii 1.0", "element vertex 1"]
    header += [f"property float {name}" for name in ("x", "y", "z", *names)]
    (tmp_path / "scan.ply").write_text("\n".join([*header, "end_header", "1 2 3 4 5", ""]), encoding="utf-8")
    assert read_cloud(tmp_path / "scan.ply").points.tolist() == [[1, 2, 3]]


def test_another_ending_is_refused(tmp_path):
    with pytest.raises(
        ValueError, match=r"scene.spz: expected a name that ends in .ply, found .spz; gsjax.write"
    ):
        write_ply(tmp_path / "scene.spz", make_scene(2))
    with pytest.raises(ValueError, match=r"found .compressed.ply; gsjax.write"):
        write_ply(tmp_path / "scene.compressed.ply", make_scene(2))
