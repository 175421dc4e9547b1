"""PLY headers that would keep a parser busy."""

import pytest

from gsjax.data.clouds import read_cloud
from gsjax.io.ply import read_ply

HEADER = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float "


@pytest.mark.parametrize("read", [read_ply, read_cloud])
def test_a_header_without_an_end_is_refused_at_once(tmp_path, read):
    path = tmp_path / "points.ply"
    path.write_bytes(HEADER + b"[" * 5_000_000)
    with pytest.raises(ValueError, match=r"points.ply: .*\(no end_header in its first 262,144 bytes\)"):
        read(path)


def test_lines_may_end_as_on_old_machines(tmp_path):
    path = tmp_path / "points.ply"
    path.write_bytes(HEADER.replace(b"\n", b"\r") + b"y\rproperty float z\rend_header\r1 2 3\r")
    assert read_cloud(path).points.tolist() == [[1, 2, 3]]
