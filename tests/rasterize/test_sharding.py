"""Several devices give the same as one: four virtual ones, and two real processes over `jax.distributed`.

The number of devices of a process is fixed when JAX starts, so this file is also the program that the tests
start: it draws and trains with and without a mesh and prints the differences.
"""

import functools
import inspect
import json
import os
import re
import socket
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.experimental import multihost_utils
from jax.sharding import AxisType, NamedSharding

import gsjax
from gsjax.geometry.cameras import intrinsics, look_at
from gsjax.rasterize import sharding
from gsjax.rasterize.plan import OPTION_NAMES

ROOT = Path(__file__).resolve().parents[2]
WIDTH, HEIGHT, N = 40, 24, 60
TIMEOUT = 600  # seconds; on two idle cores the programs take some 40


# The program.


def a_scene(lead: tuple[int, ...], cameras: int, extras: bool) -> dict[str, np.ndarray]:
    """Gaussians in a ball and cameras around it; `extras` adds the rarely used inputs."""
    rng = np.random.default_rng(0)
    angles = rng.uniform(0, 2 * np.pi, (*lead, cameras))
    eyes = 1.5 * np.stack([np.cos(angles), np.sin(angles), 0.5 + 0 * angles], -1)
    views = [look_at(eye, np.zeros(3)) for eye in eyes.reshape(-1, 3)]
    scene = {
        "means": rng.uniform(-0.5, 0.5, (*lead, N, 3)),
        "quats": rng.normal(size=(*lead, N, 4)),
        "scales": np.exp(rng.uniform(-4, -2, (*lead, N, 3))),
        "opacities": rng.uniform(0.3, 0.95, (*lead, N)),
        "colors": rng.uniform(0, 1, (*lead, *([cameras] if extras else []), N, 3)),
        "viewmats": np.reshape(views, (*lead, cameras, 4, 4)),
        "Ks": np.broadcast_to(intrinsics(40.0, WIDTH, HEIGHT), (*lead, cameras, 3, 3)),
    }
    if extras:
        scene["backgrounds"] = rng.uniform(0, 1, (*lead, cameras, 3))
        scene["features"] = rng.uniform(0, 1, (*lead, N, 2))
        scene["means2d_offset"] = np.zeros((*lead, cameras, N, 2))
    scene = {name: a.astype(np.float32) for name, a in scene.items()}
    if extras:
        scene["roi"] = rng.uniform(size=(*lead, cameras, HEIGHT, WIDTH)) < 0.02
    return scene


def place(scene: dict, mesh, **axes) -> dict:
    """The scene placed on the mesh; every process holds only its own shards."""
    plan = gsjax.Plan(WIDTH, HEIGHT, 0)
    axes = {
        name: (axis,) if axis else () for name, axis in ({"cameras": None, "scenes": None} | axes).items()
    }
    specs, _ = sharding._specs(scene, plan, **axes)

    def put(array, spec):
        return jax.make_array_from_callback(array.shape, NamedSharding(mesh, spec), array.__getitem__)

    return {name: put(array, specs[name]) for name, array in scene.items()}


def train(draw, scene: dict, plan):
    """One step of Adam: (parameters, their gradients, images, alphas, meta), and the compiled program."""
    constants = {name: a for name, a in scene.items() if a.dtype == bool}
    params = {name: a for name, a in scene.items() if name not in constants}
    adam = optax.adam(1e-2, eps=1e-3)

    def loss(params, constants):
        images = draw(**params, **constants, width=WIDTH, height=HEIGHT, plan=plan)
        colors, alphas, meta = images
        total = (colors**2).mean() + jnp.sin(5 * alphas).mean()
        return total if meta.features is None else total + (meta.features**2).mean(), images

    @jax.jit
    def step(params, constants):
        grads, images = jax.grad(loss, has_aux=True)(params, constants)
        updates, _ = adam.update(grads, adam.init(params), params)
        return optax.apply_updates(params, updates), grads, *images

    compiled = step.lower(params, constants).compile()
    return compiled(params, constants), compiled.as_text()


def whole(tree):
    """The global arrays of all processes, as numpy arrays."""
    return jax.tree.map(lambda a: np.asarray(multihost_utils.process_allgather(a, tiled=True)), tree)


def difference(many, one, relative: bool = False) -> float:
    """The largest difference over all arrays; infinite if shapes or types differ or a value is not finite."""

    def apart(a, b):
        b = np.asarray(b)
        if a.shape != b.shape or a.dtype != b.dtype:
            return np.inf
        a, b = a.astype(float), b.astype(float)
        worst = abs(a - b).max() / (abs(b).max() if relative else 1.0)
        return float(worst) if np.isfinite(worst) else np.inf

    return max(jax.tree.leaves(jax.tree.map(apart, many, one)))


def compare_training(mesh, scene: dict, **axes) -> dict:
    geometry = (scene[name] for name in ("means", "quats", "scales", "opacities", "viewmats", "Ks"))
    plan = gsjax.plan(*geometry, WIDTH, HEIGHT, render_mode="RGB+ED")
    draw = gsjax.sharded_rasterization(mesh, **axes)
    outcome, program = train(draw, place(scene, mesh, **axes), plan)
    part = [list(shard.data.shape) for shard in outcome[2].addressable_shards]
    names = ("params", "grads", "images", "alphas", "meta")
    many = dict(zip(names, map(whole, outcome), strict=True))
    if jax.process_index() > 0:  # one process is enough to compare
        return {"part": part}
    expected, _ = train(gsjax.rasterization, jax.tree.map(jnp.asarray, scene), plan)
    one = dict(zip(names, expected, strict=True))
    floats = {name: many["meta"]._asdict().pop(name) for name in ("means2d", "depths")}
    counts = ("radii", "reads", "pairs", "culled", "overflow", "needed")
    return {
        "images": difference((many["images"], many["alphas"]), (one["images"], one["alphas"])),
        "features": 0.0
        if one["meta"].features is None
        else difference(many["meta"].features, one["meta"].features),
        "projected": difference(floats, {name: getattr(one["meta"], name) for name in floats}, True),
        "counts": difference(
            [getattr(many["meta"], c) for c in counts], [getattr(one["meta"], c) for c in counts]
        ),
        "grads": difference(many["grads"], one["grads"], True),
        "least_gradient": min(float(abs(g).max()) for g in many["grads"].values()),
        "params": difference(many["params"], one["params"]),
        "part": part,
        "sent": sent(program),
    }


def sent(program: str) -> dict[str, int]:
    """Number of values passed between devices by each kind of collective of a compiled program."""
    total: dict[str, int] = {}
    kinds = r"= ([^=\n]*?) (all-reduce|all-gather|all-to-all|reduce-scatter|collective-[a-z]+)(?:-start)?\("
    for shapes, kind in re.findall(kinds, program):
        sizes = [
            np.prod([int(d) for d in dims.split(",") if d]) for dims in re.findall(r"\[([\d,]*)\]", shapes)
        ]
        total[kind] = total.get(kind, 0) + int(sum(sizes))
    return total


def compare_overflow(mesh) -> dict:
    """A plan that is too small for two cameras and large enough for two that look away."""
    scene = a_scene((), 4, extras=False)
    scene["viewmats"][1::2, 2, 3] = -9.0
    plan = gsjax.Plan(WIDTH, HEIGHT, 16)
    many = gsjax.sharded_rasterization(mesh, cameras="cameras")(
        **scene, width=WIDTH, height=HEIGHT, plan=plan
    )
    one = gsjax.rasterization(**jax.tree.map(jnp.asarray, scene), width=WIDTH, height=HEIGHT, plan=plan)
    return {
        "flags": whole(many[2].overflow).tolist(),
        "counts": difference(whole((many[2].overflow, many[2].needed)), (one[2].overflow, one[2].needed)),
    }


def compare_forward(mesh) -> float:
    """Forward derivatives, with a plan that the sharded call makes by itself."""
    scene = jax.tree.map(jnp.asarray, a_scene((), 4, extras=False))
    moved = ("means", "viewmats")
    tangents = {name: jnp.cos(jnp.arange(scene[name].size)).reshape(scene[name].shape) for name in moved}

    def push(draw, plan=None):
        def images(some):
            return draw(**scene | some, width=WIDTH, height=HEIGHT, plan=plan, derivative="forward")[:2]

        return jax.jvp(images, ({name: scene[name] for name in moved},), (tangents,))

    return difference(
        whole(push(gsjax.sharded_rasterization(mesh, cameras="cameras"))), push(gsjax.rasterization), True
    )


def four_devices(*names: str) -> dict:
    jax.config.update("jax_num_cpu_devices", 4)
    row = jax.make_mesh((4,), ("cameras",))  # explicit axes
    square = jax.make_mesh((2, 2), ("scenes", "cameras"), axis_types=(AxisType.Auto,) * 2)
    both = {"cameras": "cameras", "scenes": "scenes"}
    comparisons = {
        "cameras": lambda: compare_training(row, a_scene((), 4, extras=True), cameras="cameras"),
        "scenes": lambda: compare_training(square, a_scene((2,), 2, extras=False), **both),
        "overflow": lambda: compare_overflow(row),
        "forward": lambda: compare_forward(row),
    }
    return {name: comparisons[name]() for name in names}


def two_processes(process: int, port: int) -> dict:
    jax.config.update("jax_num_cpu_devices", 1)
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(f"localhost:{port}", 2, process, initialization_timeout=TIMEOUT // 2)
    mesh = jax.make_mesh((2,), ("cameras",))
    return compare_training(mesh, a_scene((), 4, extras=False), cameras="cameras")


# The tests.


def run_program(*argument_lists: tuple) -> list[dict]:
    """Start this file once for each list of arguments, all in parallel; returns what each prints."""
    environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    environment |= {"JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
    start = functools.partial(
        subprocess.Popen, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    programs = [start([sys.executable, __file__, *map(str, arguments)]) for arguments in argument_lists]
    try:
        outputs = [program.communicate(timeout=TIMEOUT) for program in programs]
    except subprocess.TimeoutExpired:
        pytest.fail(f"{len(programs)} program(s) had not ended after {TIMEOUT} s: {argument_lists}")
    finally:
        for program in programs:
            program.kill()  # does nothing to one that has ended
    for program, (_, errors), arguments in zip(programs, outputs, argument_lists, strict=True):
        assert program.returncode == 0, f"program {arguments} failed:\n{errors[-4000:]}"
    return [json.loads(out.splitlines()[-1]) for out, _ in outputs]


@pytest.fixture(scope="module")
def on_four():
    return run_program(("four", "scenes", "overflow"))[0]


@pytest.fixture(scope="module")
def more_on_four():
    """Comparisons that take another half minute."""
    return run_program(("four", "cameras", "forward"))[0]


def assert_same(result: dict) -> None:
    assert result["images"] <= 1e-6
    assert result["features"] <= 1e-6
    assert result["projected"] <= 1e-6
    assert result["counts"] == 0
    assert result["grads"] <= 1e-5
    assert result["least_gradient"] > 0
    assert result["params"] <= 1e-6


@pytest.mark.slow
def test_cameras_over_four_devices(more_on_four):
    assert_same(more_on_four["cameras"])
    assert more_on_four["cameras"]["part"] == [[1, HEIGHT, WIDTH, 4]] * 4


@pytest.mark.thorough
def test_scenes_and_cameras_over_two_by_two_devices(on_four):
    assert_same(on_four["scenes"])
    assert on_four["scenes"]["part"] == [[1, 1, HEIGHT, WIDTH, 4]] * 4


@pytest.mark.thorough
def test_every_device_reports_when_its_plan_is_too_small(on_four):
    assert on_four["overflow"] == {"flags": [True, False, True, False], "counts": 0}


@pytest.mark.slow
def test_forward_derivatives_over_four_devices(more_on_four):
    assert more_on_four["forward"] <= 1e-5


@pytest.mark.slow
def test_two_processes():
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    first, second = run_program((0, port), (1, port))
    assert_same(first)
    assert first["part"] == second["part"] == [[2, HEIGHT, WIDTH, 4]]  # half of the cameras each


@pytest.mark.thorough
def test_nothing_but_the_gradients_of_gaussians_is_sent(on_four):
    (kind,) = on_four["scenes"]["sent"]
    assert kind == "all-reduce"
    # Means, quats, scales, opacities and colours of a device's own scene.
    assert on_four["scenes"]["sent"][kind] == N * (3 + 4 + 3 + 1 + 3)


@pytest.fixture(scope="module")
def one_device_mesh():
    return jax.make_mesh((1,), ("cameras",), devices=jax.devices()[:1])


def four_of(names: tuple[str, ...]):
    return jax.sharding.AbstractMesh((2,) * len(names), names)


def test_every_argument_is_known():
    arguments = set(inspect.signature(gsjax.rasterization).parameters)
    assert arguments == {*sharding._ARRAYS, *OPTION_NAMES, "width", "height", "plan"}
    assert set(sharding._ARRAYS) == {*sharding._PER_SCENE, *sharding._PER_CAMERA, "colors"}


@pytest.mark.thorough
def test_one_device_is_the_plain_call(one_device_mesh):
    scene = jax.tree.map(jnp.asarray, a_scene((), 2, extras=False))
    plan = gsjax.Plan(WIDTH, HEIGHT, 4096)
    draw = gsjax.sharded_rasterization(one_device_mesh, cameras="cameras")
    many = draw(**scene, width=WIDTH, height=HEIGHT, plan=plan)
    assert (
        difference(whole(many), gsjax.rasterization(**scene, width=WIDTH, height=HEIGHT, plan=plan)) <= 1e-6
    )


@pytest.mark.thorough
def test_a_plan_without_a_capacity_keeps_its_options(one_device_mesh):
    scene = jax.tree.map(jnp.asarray, a_scene((), 2, extras=False))
    scene["means2d_offset"] = jnp.full((2, N, 2), 5.0)
    draw = gsjax.sharded_rasterization(one_device_mesh, cameras="cameras")
    plan = gsjax.Plan(WIDTH, HEIGHT, 0, near_plane=1.4, render_mode="RGB+ED", tile_size=16)
    options = {"width": WIDTH, "height": HEIGHT, "plan": plan}
    apart = difference(whole(draw(**scene, **options)), gsjax.rasterization(**scene, **options))
    assert apart <= 5e-5  # rounding of programs compiled without optimisation


@pytest.mark.usefixtures("as_users_run")
class TestErrors:
    """Every message names the argument and what to do."""

    def call(self, lead, cameras, axes, change=None):
        mesh = four_of(("cameras", "scenes"))
        scene = jax.tree.map(jnp.asarray, a_scene(lead, cameras, extras=False)) | (change or {})
        gsjax.sharded_rasterization(mesh, **axes)(**scene, width=WIDTH, height=HEIGHT)

    def test_cameras_that_do_not_divide(self):
        with pytest.raises(
            ValueError, match=r"viewmats holds 3 cameras.*2 devices.*'cameras'.*until there are 4"
        ):
            self.call((), 3, {"cameras": "cameras"})

    def test_scenes_that_do_not_divide(self):
        with pytest.raises(ValueError, match=r"means holds 3 scenes.*2 devices of mesh axis 'scenes'"):
            self.call((3,), 2, {"scenes": "scenes"})

    def test_two_mesh_axes_for_the_cameras(self):
        with pytest.raises(
            ValueError, match=r"viewmats holds 6 cameras.*4 devices of mesh axis 'cameras' x 'scenes'"
        ):
            self.call((), 6, {"cameras": ("cameras", "scenes")})

    def test_scenes_without_an_axis(self):
        with pytest.raises(ValueError, match=r"means has no leading axis.*\(B, N, 3\).*cameras="):
            self.call((), 2, {"scenes": "scenes"})

    def test_shapes_are_those_of_the_whole(self):
        with pytest.raises(ValueError, match=r"Ks must have shape \(2, 3, 3\).*got \(1, 3, 3\)"):
            self.call((), 2, {"cameras": "cameras"}, {"Ks": jnp.zeros((1, 3, 3))})
        with pytest.raises(ValueError, match="means must be an array; got list"):
            self.call((), 2, {"cameras": "cameras"}, {"means": [[0.0, 0.0, 0.0]]})

    @pytest.mark.thorough
    @pytest.mark.parametrize(
        ("axes", "message"),
        [
            ({}, "name the mesh axis"),
            ({"cameras": "rows"}, "cameras='rows' is not an axis of the mesh"),
            ({"cameras": "cameras", "scenes": "cameras"}, "both be split over mesh axis 'cameras'"),
        ],
    )
    def test_axes(self, axes, message):
        with pytest.raises(ValueError, match=message):
            gsjax.sharded_rasterization(four_of(("cameras", "scenes")), **axes)


if __name__ == "__main__":
    which, *rest = sys.argv[1:]
    print(json.dumps(four_devices(*rest) if which == "four" else two_processes(int(which), *map(int, rest))))
