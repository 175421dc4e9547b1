"""Scores of a field in views: angles to the teacher's features, and masks of classes."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gsjax.geometry.cameras import Camera
from gsjax.methods.distill import (
    DistillConfig,
    FeatureField,
    Teacher,
    distill_loss,
    frozen_views,
    gaussian_cosines,
    pixel_cosines,
    rendered_features,
    view_batch,
)
from gsjax.methods.distill.teacher import max_rows
from gsjax.metrics.segmentation import MaskOverlap
from gsjax.optim.compiler import host_options
from gsjax.rasterize.frozen import FrozenView, padded_view, paint_shown, rows_within, strip_of
from gsjax.rasterize.plan import Plan, rung
from gsjax.scene.feature_grid import Located
from gsjax.scene.gaussians import Gaussians

_OPAQUE = 0.5
Frozen = tuple[FrozenView, Plan]


class ClassScores:
    """Overlap of class masks with true labels over views, for 2D and 3D queries.

    Attributes:
        by_pixel: overlap of each class if pixels are classified by their own features (2D query).
        in_space: overlap if each Gaussian is classified, and rendered as its nearest class (3D query).
    """

    def __init__(self, names: Mapping[int, str]):
        """
        Args:
            names: names of the true labels.
        """
        self.names = dict(names)
        self.by_pixel = {label: MaskOverlap() for label in names}
        self.in_space = {label: MaskOverlap() for label in names}

    def add(
        self,
        by_pixel: Int[np.ndarray, "h w"],
        in_space: Int[np.ndarray, "h w"],
        truth: Int[np.ndarray, "h w"],
    ) -> None:
        """Count one view; -1 where the class is unknown.

        Args:
            by_pixel: class of each pixel by its own features.
            in_space: class by the Gaussians that it shows.
            truth: true label.
        """
        for label in self.names:
            self.by_pixel[label].add(by_pixel == label, truth == label)
            self.in_space[label].add(in_space == label, truth == label)

    def rows(self) -> list[dict[str, Any]]:
        """Name, IoU and boundary IoU by both queries, for each class that occurred."""
        found = []
        for label, name in self.names.items():
            ours, theirs = self.by_pixel[label], self.in_space[label]
            if ours.either or theirs.either:
                found.append(
                    {
                        "class": name,
                        "label": label,
                        "iou_2d": ours.iou,
                        "iou_3d": theirs.iou,
                        "boundary_iou_2d": ours.boundary_iou,
                        "boundary_iou_3d": theirs.boundary_iou,
                    }
                )
        return found


def class_maps(
    field: FeatureField,
    located: Located | None,
    frozen: Frozen,
    codes: Float[np.ndarray, "k d"],
    of_gaussians: Int[np.ndarray, "n"],
    strip_megabytes: float = 256.0,
) -> tuple[Int[np.ndarray, "h w"], Int[np.ndarray, "h w"]]:
    """The class of each pixel of a view, from the pixel's own feature and from the classes of the Gaussians;
    -1 where little of the scene shows.

    Args:
        field, located: as `gaussian_cosines` takes them.
        frozen: the view.
        codes: vector of each class.
        of_gaussians: class of each Gaussian (`classes_of`).
        strip_megabytes: memory of a strip; larger pictures are drawn strip by strip, to the same result.
    """
    view, plan = frozen
    of_classes = (jnp.asarray(codes), jnp.asarray(of_gaussians))
    by_pixel, in_space = _maps(field, located, view, *of_classes, plan, strip_megabytes)
    return np.asarray(by_pixel), np.asarray(in_space)


def classes_of(
    field: FeatureField, located: Located | None, codes: Float[np.ndarray, "k d"]
) -> Int[np.ndarray, "n"]:
    """The class that each Gaussian is nearest to.

    Args:
        field, located: as `gaussian_cosines` takes them.
        codes: vector of each class.
    """
    return np.asarray(gaussian_cosines(field, located, jnp.asarray(codes)).argmax(axis=-1))


def angle_error(config: DistillConfig) -> Callable[[FeatureField, Located | None, Frozen, Teacher], float]:
    """Returns a function that computes 1 - cosine to the teacher, averaged over the pixels of a view; it is
    compiled once for views of one kind.

    Args:
        config: of the field.
    """
    quiet = replace(config, weights=replace(config.weights, rec=1.0, contrast=0.0, tv=0.0))
    loss = jax.jit(partial(distill_loss(quiet), step=0, key=None), compiler_options=host_options())

    def error(field: FeatureField, located: Located | None, frozen: Frozen, teacher: Teacher) -> float:
        rows = 1 << (max_rows(teacher) - 1).bit_length()  # few lengths, so few compilations
        return float(loss(field, view_batch(teacher, 0, rows, located, frozen))[1]["cos"])

    return error


def one_by_one(gaussians: Gaussians, cameras: Iterable[Camera], rasterize_mode: str) -> Iterator[Frozen]:
    """The scene as each camera sees it, one view in memory at a time. Lists are padded to a few lengths,
    which never shrink, so that views of one size share a compiled program.

    Args:
        gaussians: the scene.
        cameras: views of it.
        rasterize_mode: as the scene was fitted.
    """
    largest: dict[tuple[int, int], tuple[int, int, int]] = {}
    for camera in cameras:
        ((view, plan),) = frozen_views(gaussians, [camera], rasterize_mode)
        needed = (plan.capacity, rung(len(view.rows)), rung(len(view.ids)))
        before = largest.get((plan.width, plan.height), needed)
        capacity, seen, pairs = largest[plan.width, plan.height] = tuple(map(max, needed, before))
        view = jax.device_put(padded_view(view, seen, pairs))
        yield view, replace(plan, capacity=capacity)


@partial(jax.jit, static_argnums=(5, 6))
def _maps(
    field: FeatureField,
    located: Located | None,
    view: FrozenView,
    codes: Array,
    of_gaussians: Array,
    plan: Plan,
    strip_megabytes: float,
):
    parts = rendered_features(field, located, view.rows)
    kinds = jax.nn.one_hot(of_gaussians[view.rows], len(codes))
    rows = rows_within(strip_megabytes, 2 * (parts.values.shape[1] + len(codes)), plan)

    def of_strip(first):
        strip, strip_plan = strip_of(view, plan, first, rows)
        cosines, alphas = pixel_cosines(field, parts, strip, strip_plan, codes)
        shares, _ = paint_shown(strip, kinds, strip_plan)
        by_pixel = jnp.where(alphas > _OPAQUE, cosines.argmax(axis=-1), -1)
        return by_pixel, jnp.where(shares.max(axis=-1) > _OPAQUE, shares.argmax(axis=-1), -1)

    strips = jax.lax.map(of_strip, jnp.arange(0, plan.tiles_y, rows))
    return tuple(one.reshape(-1, plan.width)[: plan.height] for one in strips)
