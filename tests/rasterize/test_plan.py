"""Plans: the ladder, use under transformations, contradictions, overflow, and what compiles when."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.rasterize.plan import UNSET, Plan, rung
from gsjax.rasterize.rasterization import plan, rasterization

compiled = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, _, **__: compiled.append(event) if event.endswith("backend_compile_duration") else None
)


def draw(scene, this, **options):
    return rasterization(**scene, width=this.width, height=this.height, **options)


def test_the_ladder_is_geometric_and_holds_what_is_requested():
    rungs = sorted({rung(pairs) for pairs in np.geomspace(1, 1e8, 2000)})
    assert rungs[0] == rung(0) == 4096
    assert len(rungs) < 32
    np.testing.assert_allclose(np.divide(rungs[1:], rungs[:-1]), np.sqrt(2), rtol=0.01)
    assert all(rung(r) == r for r in rungs)
    assert all(rung(r + 1) > r for r in rungs)


def test_a_plan_is_frozen_hashable_and_a_pytree_without_leaves():
    a, b = Plan(64, 48, 4096), Plan(64, 48, 4096)
    assert a == b
    assert hash(a) == hash(b)
    assert a != Plan(64, 48, 8192)
    assert jax.tree.leaves(a) == []
    with pytest.raises(dataclasses.FrozenInstanceError):
        a.capacity = 1


def test_a_plan_grows_and_never_shrinks():
    small = Plan(64, 48, 4096)
    assert small.grown(5000).capacity == rung(5000)
    assert small.grown(10) == small
    with pytest.raises(ValueError, match=r"needed must be 0 or more.*got -1"):
        small.grown(-1)
    assert small.grown(4000, headroom=1.25).capacity == rung(5000)
    with pytest.raises(ValueError, match=r"more than 2\^30 tiles of a 64x48 image; prune"):
        small.grown(np.iinfo(np.int32).max)


@pytest.mark.usefixtures("as_users_run")
def test_a_capacity_that_holds_nothing_is_refused():
    for capacity in (-16, 1, 1e5):
        with pytest.raises(ValueError, match=f"capacity must be a Python int of 2 or more.*got {capacity}"):
            Plan(32, 32, capacity)


@pytest.mark.parametrize(
    ("option", "says"),
    [
        (
            {"render_mode": "RGBD"},
            "render_mode must be one of 'RGB', 'D', 'ED', 'RGB\\+D', 'RGB\\+ED'; got 'RGBD'",
        ),
        ({"rasterize_mode": "exact"}, "rasterize_mode must be one of 'classic', 'antialiased'"),
        ({"derivative": "both"}, "derivative must be one of 'reverse', 'forward'"),
        ({"sh_degree": 4}, "sh_degree must be one of None, 0, 1, 2, 3; got 4"),
        ({"sh_degree": True}, "sh_degree must be one of None, 0, 1, 2, 3; got True"),
        ({"tile_size": 8.0}, "tile_size must be one of 4, 8, 16, 32; got 8.0"),
        ({"width": True}, "width must be a positive Python int"),
        ({"width": 0}, "width must be a positive Python int"),
        ({"height": 2.5}, "height must be a positive Python int"),
        ({"tiles_per_batch": 0}, "tiles_per_batch must be a positive"),
        ({"near_plane": 2.0, "far_plane": 1.0}, "near_plane 2.0 must be 0 or more, and below far_plane 1.0"),
        ({"near_plane": -1.0}, "near_plane -1.0 must be 0 or more"),
        ({"near_plane": "1"}, "near_plane must be a Python number \\(it is static\\); got '1'"),
        ({"far_plane": None}, "far_plane must be a Python number"),
        ({"alpha_max": 1.0}, "alpha_max must be above 0 and below 1; got 1.0"),
        ({"alpha_min": 0.0}, "alpha_min must be above 0 and below 1; got 0.0"),
        ({"eps2d": -0.1}, "eps2d must be 0 or more; got -0.1"),
        ({"eps2d": float("nan")}, "eps2d must be 0 or more; got nan"),
    ],
)
@pytest.mark.usefixtures("as_users_run")
def test_a_bad_option_is_named_with_what_is_allowed(option, says):
    with pytest.raises(ValueError, match=says):
        Plan(**{"width": 64, "height": 48, "capacity": 4096} | option)


@pytest.mark.thorough
def test_options_come_from_the_plan_and_may_be_repeated_but_not_contradicted(small, geometry):
    this, scene = small()
    p = plan(*geometry(scene), this.width, this.height, render_mode="RGB+ED", near_plane=0.2)
    assert repr(UNSET) == "UNSET"
    colors, _, _ = draw(scene, this, plan=p)
    again, _, _ = draw(scene, this, plan=p, render_mode="RGB+ED", near_plane=0.2)
    assert colors.shape[-1] == 4
    np.testing.assert_array_equal(colors, again)
    with pytest.raises(ValueError, match=r"render_mode='RGB' contradicts the plan.*render_mode='RGB\+ED'"):
        draw(scene, this, plan=p, render_mode="RGB")
    with pytest.raises(
        ValueError, match="sh_degree=0 contradicts the plan, which was made with sh_degree=None"
    ):
        draw(scene, this, plan=p, sh_degree=0)
    with pytest.raises(ValueError, match="width=34 contradicts the plan"):
        draw(scene, dataclasses.replace(this, width=34), plan=p)


@pytest.mark.thorough
def test_a_plan_travels_through_jit_vmap_and_scan(small, geometry):
    this, scene = small()
    p = plan(*geometry(scene), this.width, this.height)
    want = draw(scene, this, plan=p)[0]
    batch = {"scene": scene, "plan": p}

    def image(batch):
        return draw(batch["scene"], this, plan=batch["plan"])[0]

    np.testing.assert_allclose(jax.jit(image)(batch), want, atol=1e-5)
    stacked = {"scene": jax.tree.map(lambda a: a[None], scene), "plan": p}
    np.testing.assert_allclose(jax.vmap(image)(stacked)[0], want, atol=1e-6)
    carried, _ = jax.lax.scan(
        lambda c, _: ((c[0], image({"scene": scene, "plan": c[0]})), None), (p, want), None, 2
    )
    np.testing.assert_allclose(carried[1], want, atol=1e-5)


def test_without_a_plan_values_must_be_concrete(small, geometry):
    this, scene = small()
    p = plan(*geometry(scene), this.width, this.height)
    np.testing.assert_array_equal(draw(scene, this)[0], draw(scene, this, plan=p)[0])
    with pytest.raises(ValueError, match=r"these are traced .* Call plan = gsjax.plan\(means, .* outside"):
        jax.jit(lambda s: draw(s, this)[0])(scene)
    with pytest.raises(ValueError, match="are traced"):
        jax.jit(lambda m: plan(m, *geometry(scene)[1:], this.width, this.height))(scene["means"])


@pytest.mark.thorough
def test_eager_grad_without_a_plan_plans_by_itself(small, geometry):
    this, scene = small()
    p = plan(*geometry(scene), this.width, this.height)

    def loss(means, **kw):
        return draw(scene | {"means": means}, this, **kw)[0].sum()

    got, want = jax.grad(loss)(scene["means"]), jax.grad(lambda m: loss(m, plan=p))(scene["means"])
    np.testing.assert_array_equal(got, want)
    value, (linear,) = jax.vjp(loss, scene["means"])[0], jax.vjp(loss, scene["means"])[1](jnp.float32(1))
    np.testing.assert_array_equal(linear, want)
    assert np.isfinite(value)


def test_overflow_draws_nothing_and_is_reported_and_a_larger_plan_fixes_it(small, geometry):
    this, scene = small(channels=3)
    p = plan(*geometry(scene), this.width, this.height)
    want, _, meta = draw(scene, this, plan=p)
    needed = int(meta.needed[0])
    assert not meta.overflow[0]
    tight = dataclasses.replace(p, capacity=needed)
    assert not draw(scene, this, plan=tight)[2].overflow[0]
    short = dataclasses.replace(p, capacity=needed - 1)
    colors, alphas, meta = draw(scene, this, plan=short)
    assert bool(meta.overflow[0])
    assert (int(meta.needed[0]), int(meta.pairs[0])) == (needed, 0)
    np.testing.assert_array_equal(alphas, 0)
    np.testing.assert_array_equal(colors, jnp.broadcast_to(scene["backgrounds"], colors.shape))
    gradient = jax.grad(lambda s: draw(s, this, plan=short)[0].sum())(scene)
    assert all((gradient[k] == 0).all() for k in gradient if k != "backgrounds")
    mended, _, meta = draw(scene, this, plan=short.grown(int(meta.needed[0])))
    np.testing.assert_array_equal(mended, want)


@pytest.mark.thorough
def test_one_camera_overflows_alone_and_a_scan_ors_the_flag(small, geometry):
    this, scene = small()
    p = plan(*geometry(scene), this.width, this.height)
    needed = int(draw(scene, this, plan=p)[2].needed[0])
    short = dataclasses.replace(p, capacity=needed - 1)
    away = scene["viewmats"].at[:, 2, 3].add(-100.0)
    two = {"viewmats": jnp.concatenate([scene["viewmats"], away]), "Ks": jnp.repeat(scene["Ks"], 2, 0)}
    two["backgrounds"] = jnp.repeat(scene["backgrounds"], 2, 0)
    np.testing.assert_array_equal(draw(scene | two, this, plan=short)[2].overflow, [True, False])

    def frame(flag, viewmats):
        return flag | draw(scene | {"viewmats": viewmats}, this, plan=short)[2].overflow.any(), None

    frames = jnp.stack([away, scene["viewmats"], away])
    assert bool(jax.lax.scan(frame, jnp.array(False), frames)[0])
    assert not bool(jax.lax.scan(frame, jnp.array(False), frames[::2])[0])


@pytest.mark.thorough
def test_replanning_on_a_known_rung_compiles_nothing_and_a_call_is_traced_once(small, geometry):
    this, scene = small()
    traced = []

    @jax.jit
    def frame(scene, plan):
        traced.append(1)
        return draw(scene, this, plan=plan)[0]

    plans = []
    for i in range(4):
        moved = scene | {"means": scene["means"] + 0.01 * i}
        plans.append(plan(*geometry(moved), this.width, this.height))
        frame(moved, plans[-1])
        if i == 0:
            del compiled[:]
    assert plans[0] == plans[3]
    assert len(traced) == 1
    jax.block_until_ready(frame(scene, plans[0]))
    assert compiled == []


@pytest.mark.thorough
@pytest.mark.parametrize("headroom", [0.5, 0.0, float("nan")])
def test_headroom_below_one_is_refused_because_replanning_would_never_end(headroom):
    with pytest.raises(ValueError, match="headroom must be 1 or more"):
        Plan(width=8, height=8, capacity=4096).grown(10_000, headroom)
