"""The benchmark suite: the metric contract, timing and floors, and a run from end to end."""

import json
from argparse import Namespace
from dataclasses import replace

import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

import benchmarks.measure as measuring
from benchmarks import steps, suite
from benchmarks.floors import Floors, _project, between, is_calm, rectangle_pairs
from benchmarks.growth import draw_growth
from benchmarks.measure import measure
from benchmarks.metrics import FAILING, Metric, compare, judge, make_record, merged, read_metrics
from benchmarks.programs import FORWARD, make_pool, make_programs
from benchmarks.timing import MIN_CALLS, pose_tangent, sample
from benchmarks.workloads import QUICK, SUITE, Workload, ball, ball_workload, choose, garden
from gsjax.cli import main
from gsjax.rasterize.plan import Plan

FLOORS = Floors(exp_ns=1.0, copy_gb_s=1.0, product_gflop_s=1.0)
TINY = ball_workload(1_000, (48, 32))


def figures(**values: Metric) -> dict:
    return make_record(values.values())


@pytest.mark.parametrize(
    ("direction", "value", "verdict"),
    [
        ("lower", 109, "same"),
        ("lower", 111, "worse"),
        ("lower", 89, "better"),
        ("higher", 111, "better"),
        ("higher", 89, "worse"),
        ("same", 111, "worse"),
        ("same", 89, "worse"),
        ("same", 100, "same"),
    ],
)
def test_direction_and_tolerance(direction, value, verdict):
    before = Metric("a/b", 100.0, "ms", direction, 0.1)
    assert judge(Metric("a/b", float(value), "ms", direction, 0.1), before) == verdict


@pytest.mark.parametrize(("direction", "tolerance"), [("up", 0.1), ("lower", -0.1)])
def test_a_metric_refuses_nonsense(direction, tolerance):
    with pytest.raises(ValueError, match="a/b"):
        Metric("a/b", 1.0, "ms", direction, tolerance)


def test_missing_metrics_fail_only_where_their_workload_ran():
    one, other = Metric("a/x", 1.0, "ms", "lower", 0.1), Metric("b/x", 1.0, "ms", "lower", 0.1)
    gone = Metric("a/gone", 1.0, "ms", "lower", 0.1)
    rows = compare(make_record([one]), make_record([one, other, gone]))
    assert {row.key: row.verdict for row in rows} == {"a/x": "same", "a/gone": "missing"}
    assert "missing" in FAILING
    assert [row.verdict for row in compare(make_record([one]), make_record([]))] == ["new"]


def test_on_another_machine_only_what_travels_is_judged():
    slow = [Metric("a/ms", 9.0, "ms", "lower", 0.1), Metric("a/pairs", 9.0, "pairs", "lower", 0.1, True)]
    fast = [Metric("a/ms", 1.0, "ms", "lower", 0.1), Metric("a/pairs", 1.0, "pairs", "lower", 0.1, True)]
    there = make_record(fast) | {"machine_name": "another"}
    assert [r.verdict for r in compare(make_record(slow), there)] == ["elsewhere", "worse"]
    assert [r.verdict for r in compare(make_record(slow), make_record(fast))] == ["worse", "worse"]


def test_noise_is_neither_judged_nor_kept_as_baseline():
    calm, noisy = Metric("a/x", 1.0, "ms", "lower", 0.1), Metric("a/x", 9.0, "ms", "lower", 0.1, noisy=True)
    assert compare(make_record([noisy]), make_record([calm]))[0].verdict == "noisy"
    assert merged(make_record([noisy]), make_record([calm]))["metrics"]["a/x"]["value"] == 1.0
    assert merged(make_record([noisy]), None)["metrics"] == {}


def test_a_part_of_the_suite_updates_its_part_of_the_baseline():
    def metric(key, value):
        return Metric(key, value, "ms", "lower", 0.1)

    old = make_record([metric("a/x", 1.0), metric("a/gone", 1.0), metric("b/x", 1.0)])
    new = merged(make_record([metric("a/x", 2.0)]), old)
    assert {key: m.value for key, m in read_metrics(new).items()} == {"a/x": 2.0, "b/x": 1.0}
    with pytest.raises(ValueError, match="found one from another; run the whole suite"):
        merged(make_record([metric("a/x", 2.0)]), old | {"machine_name": "another"})


def test_records_have_six_digits():
    record = make_record([Metric("a/x", 1 / 3, "ms", "lower", 0.1)], rows=[{"ms": 2 / 3, "n": 10**9}])
    assert record["metrics"]["a/x"]["value"] == 0.333333
    assert record["rows"] == [{"ms": 0.666667, "n": 10**9}]


def test_the_pool_moves_means_and_camera_a_little():
    scene = ball(500, 48, 32)
    pool = make_pool(scene, relative=1e-4)
    assert len({np.asarray(p["means"]).tobytes() for p in pool}) == len(pool)
    for inputs in pool:
        np.testing.assert_allclose(inputs["means"], scene.means, rtol=1e-3)
        viewmat = np.asarray(inputs["viewmats"][0], np.float64)
        np.testing.assert_allclose(viewmat[:3, :3] @ viewmat[:3, :3].T, np.eye(3), atol=1e-6)
        moved = np.abs(viewmat - np.asarray(scene.viewmat)).max()
        assert 1e-6 < moved < 2e-3
        assert inputs["colors"] is scene.colors  # unchanged arrays are shared, not copied


def test_tangents_of_a_pose_are_its_derivatives():
    viewmat = np.asarray(ball(10, 48, 32).viewmat, np.float64)
    for axis in range(6):
        step = 1e-3
        ends = [jaxlie.SE3.exp(jnp.zeros(6).at[axis].set(s)).as_matrix() @ viewmat for s in (step, -step)]
        numeric = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(pose_tangent(viewmat, axis), numeric, atol=1e-3)


def test_rectangle_pairs_against_counting_tile_by_tile():
    scene, (width, height) = ball(200, 70, 45), (70, 45)
    gaussians = scene[:4]
    projected = _project(*gaussians, scene.viewmat, scene.K, Plan(width, height, capacity=0))
    means2d, extents, visible = map(np.asarray, projected)
    count = 0
    for x in range(0, width, 16):
        for y in range(0, height, 16):
            low, high = np.array([x, y]), np.array([x, y]) + 16
            inside = (means2d + extents > low) & (means2d - extents < high)
            count += int((inside.all(axis=1) & visible).sum())
    found = rectangle_pairs(gaussians, scene.viewmat, scene.K, width, height)
    assert found == count > 200


def test_calls_are_warmed_up_and_cut_short_when_they_take_long():
    seen = []
    assert len(sample(seen.append, 4)) == 4
    assert seen == [-2, -1, 0, 1, 2, 3]
    assert len(sample(seen.append, 50, max_seconds=0.0)) == MIN_CALLS


def test_floors():
    assert FLOORS.exp_ms(10) == pytest.approx(1e-6 * 10 * 256)
    assert FLOORS.copy_ms(10**6) == pytest.approx(1.0)
    assert FLOORS.product_ms(10**6, 5, 1) == pytest.approx(10.0)
    assert between(Floors(1.0, 1.0, 1.0), Floors(4.0, 4.0, 4.0)) == Floors(2.0, 2.0, 2.0)
    assert is_calm(Floors(1.0, 1.0, 1.0), Floors(1.2, 9.0, 9.0))
    assert not is_calm(Floors(1.3, 1.0, 1.0), Floors(1.0, 1.0, 1.0))


def test_names_are_told_apart():
    names = [w.name for w in SUITE]
    assert len(set(names)) == len(names)
    assert choose(names, ["garden"]) == ["garden-0", "garden-1", "garden-2"]
    assert choose(names, ["ball-1e6*"]) == ["ball-1e6-640x480", "ball-1e6-1920x1080"]
    assert choose(names, []) == names
    assert {w.channels for w in SUITE} == {3, 16, 64, 512}
    assert all(max(w.width, w.height) <= 320 for w in QUICK)
    with pytest.raises(ValueError, match="--only: expected a workload, found 'gardn'; choose from garden-0"):
        choose(names, ["gardn"])


def test_the_garden_follows_the_recipe(shared_data, monkeypatch):
    monkeypatch.setenv("GSJAX_DATA", str(shared_data))
    scene = garden(0)
    assert scene.means.shape == (111_785, 3)
    pairs = rectangle_pairs(scene[:4], scene.viewmat, scene.K, 648, 420)
    assert pairs == pytest.approx(421_628, rel=2e-3)  # ../shared/RASTERIZER.md


@pytest.fixture(scope="module")
def measured():
    """A tiny workload on a machine that is calm only at the second attempt."""
    sequence = iter(
        [Floors(1.0, 1.0, 1.0), Floors(2.0, 1.0, 1.0), Floors(1.0, 1.0, 1.0), Floors(1.1, 1.0, 1.0)]
    )
    workload = ball_workload(1_000, (48, 32), channels=5)
    return measure(workload, 2, floors=lambda: next(sequence))


@pytest.mark.slow
def test_a_noisy_workload_is_measured_again(measured):
    assert measured.attempts == 2
    assert not any(row.noisy for row in measured.rows)


@pytest.mark.thorough
def test_every_program_is_measured(measured):
    rows = {row.program: row for row in measured.rows}
    forward, backward = (rows[name] for name in ("forward", "forward+backward"))
    ratio = backward.product_floors / forward.product_floors * forward.median_ms / backward.median_ms
    assert ratio == pytest.approx(1 / 3)  # the backward pass adds the gradients of weights and features
    assert rows["jvp"].product_floors is None
    assert list(rows) == ["forward", "forward+backward", "jvp"]
    for row in rows.values():
        assert row.calls == 2
        assert 0 < row.median_ms <= row.p95_ms
        assert row.pairs == rows["forward"].pairs > 1_000
        assert row.memory_gib > 0
        assert row.exp_floors == pytest.approx(row.median_ms / row.exp_floor_ms)
    keys = [metric.key for metric in measured.metrics()]
    assert len(set(keys)) == len(keys) == 2 + 4 * len(rows)


@pytest.fixture
def forward_only(monkeypatch):
    """Restricts measurements to the program that compiles fastest."""

    def programs(scene, plans):
        return {FORWARD: make_programs(scene, plans)[FORWARD]}

    monkeypatch.setattr(measuring, "make_programs", programs)


@pytest.mark.thorough
@pytest.mark.usefixtures("forward_only")
def test_what_does_not_fit_into_memory_is_not_run(monkeypatch):
    monkeypatch.setattr(measuring, "available_bytes", lambda: 1)
    result = measure(TINY, 1, floors=lambda: FLOORS)
    assert result.rows == [] == result.metrics()
    assert "not run, it needs" in result.notes[0]


def absent() -> None:
    raise FileNotFoundError("no file garden: point GSJAX_DATA at it")


@pytest.fixture
def bench(monkeypatch, tmp_path, capfd, measured):
    """Returns a function that runs the command and returns the exit code and the output.

    Two workloads are already measured, and one has no data.
    """

    def remembered(workload, repeats, say):
        if workload.make is absent:
            workload.make()
        return replace(measured, rows=[replace(r, workload=workload.name, channels=3) for r in measured.rows])

    monkeypatch.setattr(suite, "RESULTS", tmp_path)
    monkeypatch.setattr(suite, "STEPS", {})
    monkeypatch.setattr(suite, "measure", remembered)
    second = ball_workload(1_000, (32, 32))
    monkeypatch.setattr(suite, "SUITE", [TINY, second, Workload("garden-0", absent, 8, 8)])

    def call(**options) -> tuple[int, str]:
        given = {"only": (), "quick": False, "repeats": 1, "check": False, "update_baseline": False}
        code = suite.run(Namespace(**{**given, "out": tmp_path / "out", **options}))
        return code, capfd.readouterr().out

    return call


@pytest.mark.thorough
def test_a_run_from_end_to_end(bench, tmp_path):
    code, output = bench(update_baseline=True)
    assert code == 0
    for text in ("ball-1e3-48x32", "forward+backward", "jvp", "garden-0: skipped, no file garden"):
        assert text in output, output
    record = json.loads((tmp_path / "out" / "bench.json").read_text())
    assert record["complete"]
    assert list(record) == sorted(record)
    assert len(record["rows"]) == 6
    page = (tmp_path / "out" / "results.md").read_text()
    for text in ("# Benchmarks", "## Method", "## Counter-cases", "## Noise", "garden-0: skipped"):
        assert text in page
    baseline = tmp_path / "baseline.json"
    assert "ball-1e3-48x32/forward/memory" in json.loads(baseline.read_text())["metrics"]

    assert bench(only=("ball-1e3-48x32",), check=True)[0] == 0
    stored = json.loads(baseline.read_text())
    stored["metrics"]["ball-1e3-48x32/pairs"]["value"] = 1.0
    baseline.write_text(json.dumps(stored))
    code, output = bench(only=("ball-1e3-48x32",), check=True)
    assert code == 1
    assert "worse  ball-1e3-48x32/pairs: 1.00 -> " in output
    stored["metrics"] = {"another/pairs": stored["metrics"]["ball-1e3-48x32/pairs"]}
    baseline.write_text(json.dumps(stored))
    with pytest.raises(ValueError, match=r"--check: expected the measured figures in .*, found none"):
        bench(only=("ball-1e3-48x32",), check=True)


@pytest.mark.thorough
def test_ctrl_c_keeps_what_was_measured(bench, tmp_path, monkeypatch):
    def interrupted(workload, repeats, say):
        if workload is not TINY:
            raise KeyboardInterrupt
        return remembered(workload, repeats, say)

    remembered = suite.measure
    monkeypatch.setattr(suite, "measure", interrupted)
    code, output = bench()
    assert code == 130
    assert "the results so far are saved" in output
    record = json.loads((tmp_path / "out" / "bench.json").read_text())
    assert not record["complete"]
    assert {row["workload"] for row in record["rows"]} == {TINY.name}


@pytest.mark.usefixtures("forward_only")
@pytest.mark.slow
def test_the_real_thing_on_one_tiny_workload(monkeypatch, tmp_path, capfd):
    """Only the workload and the programs are replaced; floors, timing and files are the command's own."""
    monkeypatch.setattr(suite, "RESULTS", tmp_path / "none")
    monkeypatch.setattr(suite, "QUICK", [TINY])
    out = tmp_path / "out"
    assert main(["bench", "--quick", "--only", "ball", "--repeats", "2", "--out", str(out)]) == 0
    assert "ball-1e3-48x32" in capfd.readouterr().out
    assert {path.name for path in out.iterdir()} == {
        "bench.json",
        "results.md",
    }  # a single point is not plotted
    (row,) = json.loads((out / "bench.json").read_text())["rows"]
    assert row["exp_floors"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", list(steps.STEPS))
def test_every_step_has_a_rate(name):
    row, _ = steps.measure_step(name, 2, Floors(1.0, 1.0, 1.0))
    assert row.updates == 2
    assert row.steps_per_s == pytest.approx(1e3 / row.median_ms)


def test_growth_has_a_panel_for_each_sweep(measured):
    def row(name, **values):
        return {**measured.as_rows()[0], "workload": name, "program": FORWARD, **values}

    rows = [row("a"), row("b", gaussians=9_000), row("c", channels=512, noisy=True)]
    figure = draw_growth(rows, {"a": ("gaussians", "channels"), "b": ("gaussians",), "c": ("channels",)})
    assert [axes.get_xlabel() for axes in figure.axes] == ["Gaussians", "channels"]
    assert draw_growth(rows[:1], {"a": ("gaussians",)}) is None


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--only", "gardn"], "--only: expected a workload, found 'gardn'; choose from garden-0"),
        (["--check"], "--check: expected a baseline at"),
        (["--repeats", "0"], "--repeats: expected 1 or more, found 0"),
    ],
)
def test_what_cannot_be_done_is_a_sentence(options, says, monkeypatch, tmp_path, capfd):
    monkeypatch.setattr(suite, "RESULTS", tmp_path)
    assert main(["bench", *options]) == 2
    assert says in capfd.readouterr().err


def test_a_broken_baseline_is_named(monkeypatch, tmp_path, capfd):
    monkeypatch.setattr(suite, "RESULTS", tmp_path)
    (tmp_path / "baseline.json").write_text("<<<<<<< HEAD")
    assert main(["bench", "--check"]) == 2
    assert "baseline.json: expected a baseline as JSON" in capfd.readouterr().err


def test_outside_a_checkout_it_says_so(monkeypatch, tmp_path, capfd):
    monkeypatch.chdir(tmp_path)
    assert main(["bench"]) == 2
    assert "run it in a checkout of gsjax" in capfd.readouterr().err


def test_peers_are_compared_with_gsplat():
    from benchmarks.peers import Row, table

    rows = [Row("garden-0", by, "forward", 2.0, 2.5, ms) for by, ms in (("kernels", 0.5), ("gsplat", 1.0))]
    lines = table(rows).splitlines()
    assert lines[2].endswith("| kernels | 2.000 | 2.500 | 0.500 | 0.50 |")
    assert lines[3].endswith("| gsplat | 2.000 | 2.500 | 1.000 | 1.00 |")


def test_a_peer_that_is_not_there_is_named_and_left_out():
    from benchmarks.peers import measure
    from benchmarks.workloads import ball_workload

    rows = []
    notes = measure(ball_workload(100, (32, 24)), ["kernels", "gsplat"], rows.append)
    assert rows == []
    assert [note.split(":")[0] for note in notes] == ["ball-1e2-32x24, kernels", "ball-1e2-32x24, gsplat"]
