"""Pictures of a field: its features, its classes, its scene in one colour per Gaussian, and their names."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.engine.distill import query as field_query
from gsjax.engine.distill import scores as field_scores
from gsjax.engine.distill.judge import draw_features, feature_colors
from gsjax.engine.distill.saved import short_names
from gsjax.engine.distill.scores import class_maps, classes_of, one_by_one
from gsjax.geometry.cameras import Camera
from gsjax.io.ply import read_ply
from gsjax.methods.distill import (
    DistillConfig,
    frozen_views,
    init_field,
    pixel_cosines,
    rendered_features,
)
from gsjax.rasterize.frozen import paint, strip_of
from gsjax.scene.feature_grid import FeatureGridConfig
from gsjax.scene.gaussians import gaussians_from_activated
from gsjax.viz.colors import colorize_features, fit_pca_colors
from gsjax.viz.viewer.drawing import Drawer

painted = jax.jit(paint)
features_of_field = jax.jit(rendered_features)


def some_of(scene, every):
    """Every `every`-th Gaussian of the scene in a file."""
    return jax.tree.map(lambda a: jnp.asarray(np.asarray(a)[::every]), read_ply(scene)[0])


def ahead(distance, K, width, height):
    """A camera that looks along z, `distance` in front of the origin."""
    pose = np.eye(4, dtype=np.float32)
    pose[2, 3] = distance
    return Camera(jnp.asarray(pose), jnp.asarray(K, jnp.float32), width, height)


@pytest.mark.thorough
@pytest.mark.parametrize("encoding", ["grid", "table"])
def test_a_picture_of_features_needs_three_numbers_a_pixel(scene, encoding):
    gaussians = some_of(scene, 40)
    grid = FeatureGridConfig(levels=2, most_resolution=16, log2_entries=8, hidden=8)
    field, located = init_field(
        jax.random.key(0), DistillConfig(channels=6, encoding=encoding, grid=grid), gaussians.means, 4
    )
    K = np.array([[40, 0, 20], [0, 40, 16], [0, 0, 1]])
    cameras = [ahead(distance, K, 40, 32) for distance in (3, 2)]
    colors, pca = feature_colors(field, located)
    parts = features_of_field(field, located)
    ones = jnp.ones(len(parts.values))
    known = fit_pca_colors(np.asarray(parts.channels_of(parts.joined(parts.values, ones))))
    wanted = frozen_views(gaussians, cameras)
    kinds = set()
    for frozen, (view, plan) in zip(one_by_one(gaussians, cameras, "classic"), wanted, strict=True):
        image, alphas = painted(view, parts.values, plan)
        channels = np.asarray(parts.channels_of(parts.joined(image, alphas)))
        alphas = np.asarray(alphas)[..., None]
        assert (alphas > 0.5).any()
        mean = np.where(alphas > 0.5, channels / np.maximum(alphas, 0.5), np.nan)
        found = draw_features(colors, frozen, pca).astype(int)
        assert np.abs(found - colorize_features(mean, known)).max() <= 1
        kinds.add((frozen[1], *(len(a) for a in frozen[0])))
    assert len(kinds) == 1  # one program for both


@pytest.mark.thorough
def test_classes_of_a_picture_are_found_strip_by_strip(scene, monkeypatch):
    gaussians = some_of(scene, 20)
    grid = FeatureGridConfig(levels=2, most_resolution=32, log2_entries=8, hidden=8)
    field, located = init_field(jax.random.key(0), DistillConfig(channels=6, grid=grid), gaussians.means, 4)
    field = eqx.tree_at(lambda f: f.encoding.table, field, 1e5 * field.encoding.table)
    codes, rows = np.random.default_rng(0).normal(size=(5, 4)).astype(np.float32), []
    K = np.array([[40, 0, 20], [0, 40, 30], [0, 0, 1]])
    frozen = frozen_views(gaussians, [ahead(3, K, 40, 60)])[0]

    def recorded(view, plan, first, count):
        rows.append(count)
        return strip_of(view, plan, first, count)

    monkeypatch.setattr(field_scores, "strip_of", recorded)
    asked = (field, located, frozen, codes, classes_of(field, located, codes))
    whole, strips = class_maps(*asked), class_maps(*asked, strip_megabytes=0.1)
    assert rows == [frozen[1].tiles_y, 3] == [8, 3]
    parts = features_of_field(field, located, frozen[0].rows)
    cosines, alphas = jax.device_get(jax.jit(pixel_cosines)(field, parts, *frozen, codes))
    np.testing.assert_array_equal(whole[0], np.where(alphas > 0.5, cosines.argmax(-1), -1))
    for one, other in zip(whole, strips, strict=True):
        np.testing.assert_array_equal(one, other)
        assert len(np.unique(one)) > 3


@pytest.mark.thorough
def test_a_scene_has_one_colour_a_gaussian_from_one_camera():
    random = np.random.default_rng(0)
    means, quats = random.uniform(-1, 1, (20, 3)), random.normal(size=(20, 4))
    shN = random.normal(size=(20, 3, 3)) * 0.3
    shiny = gaussians_from_activated(means, quats, np.full((20, 3), 0.2), np.full(20, 0.8), means**2, shN=shN)
    pose, K = np.eye(4), np.array([[20.0, 0, 12], [0, 20, 9], [0, 0, 1]])
    pose[2, 3] = 4
    camera = Camera(jnp.asarray(pose[None], float), jnp.asarray(K[None], float), 24, 18)
    drawn, painted = (Drawer()(g, camera).colors for g in (shiny, field_query._seen_from(shiny, camera)))
    assert drawn.max() > 0.2
    np.testing.assert_allclose(painted, drawn, atol=1e-5)


def test_photographs_have_short_names():
    assert short_names(["3/000000", "12/000000"]) == ("3", "12")
    assert short_names(["images/a.jpg", "images/b.jpg"]) == ("images_a", "images_b")
    assert short_names(["a.png", "a.jpg"]) == ("a.png", "a.jpg")
    assert short_names(["a/b.png", "a_b.png"]) == ("0_a_b.png", "1_a_b.png")
