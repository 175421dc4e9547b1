"""The yardstick: what a record keeps of a run, and what comparing two records reports."""

import copy
import json

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.digests import (
    array_difference,
    compare,
    describe_array,
    describe_file,
    describe_run,
    without_volatile,
)
from benchmarks.yardstick import CASES, main, print_comparison
from gsjax.io.ply import write_ply
from gsjax.scene.gaussians import Gaussians


def gaussians(shift: float) -> Gaussians:
    ones = jnp.ones((5, 3))
    return Gaussians(ones + shift, jnp.ones((5, 4)), ones, jnp.ones(5), jnp.ones((5, 1, 3)))


def write_run(folder, seconds: float = 1.0, shift: float = 0.0, psnr: float = 20.0):
    """Writes a run folder with a file of each kind, and returns it."""
    (folder / "renders").mkdir(parents=True)
    write_ply(folder / "scene.ply", gaussians(shift))
    values = np.linspace(0, 1, 1000, dtype=np.float32) + np.float32(shift)
    about = np.array(json.dumps({"format": 1, "scene": {"file": str(folder), "photographs": {"seed": 0}}}))
    np.savez(folder / "parts.npz", values=values, update_s=np.full(3, seconds), about=about)
    cv2.imwrite(str(folder / "renders" / "0.png"), np.full((4, 4, 3), 100 + round(100 * shift), np.uint8))
    notes = [f"Resumed after 3 steps, which took {seconds:.1f} s of time."]
    metrics = {"test": {"psnr": psnr, "fps": seconds}, "seconds": {"fit": seconds}, "notes": notes}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    (folder / "metrics.jsonl").write_text(json.dumps({"step": 1, "update_ms": seconds}) + "\n")
    (folder / "config.yml").write_text(f"out: {folder}\n")
    return folder


def record_of(folder) -> dict:
    files = json.loads(json.dumps(describe_run(folder)))
    return {"format": 1, "made_with": {"jax": "1"}, "cases": {"fit": {"exit_code": 0, "files": files}}}


@pytest.fixture
def before(tmp_path):
    return record_of(write_run(tmp_path / "before"))


def test_two_runs_that_differ_by_times_and_paths_are_the_same(before, tmp_path, capsys):
    after = record_of(write_run(tmp_path / "after", seconds=9.0))
    assert compare(before, after) == {"fit": []}
    assert print_comparison(before, after) == 0
    assert capsys.readouterr().out == "fit: same to the bit\n"


def test_what_differs_is_named_and_sized(before, tmp_path):
    after = record_of(write_run(tmp_path / "after", shift=0.5, psnr=21.5))
    lines = compare(before, after)["fit"]
    assert len(lines) == 6
    assert "metrics.json: test.psnr: 20.0 -> 21.5 (+1.5)" in lines
    values = next(line for line in lines if line.startswith("parts.npz: values: "))
    rms = float(values.split("about ")[1].split()[0])
    assert rms == pytest.approx(0.5, rel=0.5)  # an estimate from 32 random sums
    assert "span 0.9; mean 0.5 -> 1" in values
    assert any(line.startswith("renders/0.png: pixels: differs by about") for line in lines)
    assert [line.split(":")[1].strip() for line in lines if "scene.ply" in line] == [
        f"vertex.{axis}" for axis in "xyz"
    ]


def test_a_bit_in_one_value_is_a_difference():
    array = np.linspace(0, 1, 100, dtype=np.float32)
    other = array.copy()
    other[7] = np.nextafter(other[7], np.float32(2))
    one, another = describe_array(array), describe_array(other)
    assert one["sha256"] != another["sha256"]
    gap = np.sqrt(np.mean(np.subtract(one["sketch"], another["sketch"]) ** 2))
    assert gap == pytest.approx(float(other[7]) - float(array[7]), rel=1e-3)


def test_names_in_another_order_are_a_difference(tmp_path):
    for name, names in (("a", ["0/0", "1/0"]), ("b", ["1/0", "0/0"])):
        np.savez(tmp_path / f"{name}.npz", names=np.array(names))
    assert describe_file(tmp_path / "a.npz") != describe_file(tmp_path / "b.npz")


def test_missing_files_arrays_and_cases_are_named(before):
    after = copy.deepcopy(before)
    files = after["cases"]["fit"]["files"]
    del files["config.yml"], files["parts.npz"]["arrays"]["values"]
    files["parts.npz"]["arrays"]["more"] = describe_array(np.zeros(3))
    files["field.npz"] = {"arrays": {}}
    files["metrics.json"]["says"]["test"]["psnr"] = None
    after["cases"]["fit"]["exit_code"] = 2
    after["cases"]["track"] = {"exit_code": 0, "files": {}}
    assert compare(before, after) == {
        "fit": [
            "exit code: 0 -> 2",
            "config.yml: missing",
            "field.npz: new",
            "metrics.json: test.psnr: 20.0 -> None",
            "parts.npz: values: array missing",
            "parts.npz: more: array new",
        ],
        "track": ["only the second record has this case"],
    }


def test_shapes_come_before_values():
    one, other = describe_array(np.zeros((2, 3))), describe_array(np.zeros((3, 3)))
    assert array_difference(one, other) == "shape [2, 3] -> [3, 3]"
    nan = describe_array(np.full((2, 3), np.nan))
    assert nan["not_finite"] == 6
    assert array_difference(one, nan) == "other values"


def test_of_sentences_numbers_remain():
    said = ["118 of 679 Gaussians were left out", "118 of 679 were pruned in 3.5 s", "/a/path", "depth"]
    assert without_volatile(said) == ["a sentence with 118 679", "a sentence with 118 679", "a path", "depth"]


def test_rows_about_a_share_of_the_minutes_are_left_out():
    rows = [{"part": "all", "sh_degree": 1}, {"part": "after a quarter", "sh_degree": None}]
    assert without_volatile({"parts": rows}) == {"parts": rows[:1]}
    assert without_volatile([{"part": 1, "range": None}]) == [{"part": 1, "range": None}]  # of `gsjax parts`


def test_records_from_elsewhere_are_announced(before, tmp_path, capsys):
    after = copy.deepcopy(before) | {"made_with": {"jax": "2"}}
    paths = [tmp_path / "a.json", tmp_path / "b.json"]
    for path, one in zip(paths, (before, after), strict=True):
        path.write_text(json.dumps(one))
    assert main(["--compare", *map(str, paths)]) == 0
    assert "made with another jax: '1', then '2'" in capsys.readouterr().out
    after["cases"]["parts"] = {"exit_code": 0, "files": {}}
    assert print_comparison(before, after) == 1
    assert print_comparison(before, after, only=["fit"]) == 0
    with pytest.raises(ValueError, match="expected records of one format, found 1 and 2"):
        compare(before, after | {"format": 2})


def test_cases_have_names_of_their_own_and_run_in_order(tmp_path):
    names = [case.name for case in CASES]
    assert len(set(names)) == len(names)
    for i, case in enumerate(CASES):
        assert case.needs is None or case.needs in names[:i]
    with pytest.raises(ValueError, match=r"--only: expected one of fit-relocate, .* found fitt"):
        main([str(tmp_path), "--only", "fitt"])
    (tmp_path / "runs" / "parts").mkdir(parents=True)
    with pytest.raises(FileExistsError, match="expected no run yet, found one"):
        main([str(tmp_path), "--only", "parts"])
