"""How well a field says of views what its teacher would have said: angles, and masks of classes."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gsjax.methods.feature_field import (
    FeatureField,
    FieldBatch,
    FieldConfig,
    Teacher,
    field_loss,
    gaussian_cosines,
    pixel_cosines,
)
from gsjax.metrics.segmentation import MaskOverlap
from gsjax.optim.compiler import host_options
from gsjax.rasterize.frozen import FrozenView, paint
from gsjax.rasterize.plan import Plan
from gsjax.scene.feature_grid import Located

_OPAQUE = 0.5
Frozen = tuple[FrozenView, Plan]


class ClassScores:
    """Masks of classes in views, by either query, against true labels.

    Attributes:
        by_pixel: overlaps of each class, by what pixels say (2D query).
        in_space: the same by Gaussians, each of the class that it is nearest to, drawn (3D query).
    """

    def __init__(self, names: Mapping[int, str]):
        """
        Args:
            names: of true labels.
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
        """Count one view; -1 where nothing is said."""
        for label in self.names:
            self.by_pixel[label].add(by_pixel == label, truth == label)
            self.in_space[label].add(in_space == label, truth == label)

    def rows(self) -> list[dict[str, Any]]:
        """Of each class that occurred: name, iou and boundary_iou by either query."""
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
) -> tuple[Int[np.ndarray, "h w"], Int[np.ndarray, "h w"]]:
    """Which class each pixel of a view is, by either query; -1 where little of the scene shows.

    Args:
        field, located: as queries take them.
        frozen: the view.
        codes: of the classes.
        of_gaussians: which class each Gaussian is (`classes_of`).
    """
    view, plan = frozen
    nearest, share, alphas = _maps(
        field, located, view, jnp.asarray(codes), jnp.asarray(of_gaussians), plan, len(codes)
    )
    opaque = np.asarray(alphas) > _OPAQUE
    most = np.asarray(share)
    in_space = np.where(most.max(-1) > _OPAQUE, most.argmax(-1), -1)
    return np.where(opaque, np.asarray(nearest), -1), in_space


def classes_of(
    field: FeatureField, located: Located | None, codes: Float[np.ndarray, "k d"]
) -> Int[np.ndarray, "n"]:
    """Which class each Gaussian is nearest to."""
    return np.asarray(gaussian_cosines(field, located, jnp.asarray(codes)).argmax(axis=-1))


def angle_errors(
    field: FeatureField,
    located: Located | None,
    views: list[Frozen],
    teacher: Teacher,
    config: FieldConfig,
) -> list[float | None]:
    """1 - cosine to what the teacher says, the mean over each view's pixels; None where it says nothing."""
    quiet = replace(config, weights=replace(config.weights, rec=1.0, contrast=0.0, tv=0.0))
    loss = jax.jit(partial(field_loss(quiet), step=0, key=None), compiler_options=host_options())
    codebook = None if teacher.codebook is None else jnp.asarray(teacher.codebook)
    found: list[float | None] = []
    for v, (view, plan) in enumerate(views):
        ids, said = (
            jnp.asarray(teacher.ids[v]),
            None if teacher.maps is None else jnp.asarray(teacher.maps[v]),
        )
        if said is None and not (teacher.ids[v] >= 0).any():
            found.append(None)
            continue
        found.append(float(loss(field, FieldBatch(view, located, ids, codebook, said, plan))[1]["cos"]))
    return found


@partial(jax.jit, static_argnums=(5, 6))
def _maps(
    field: FeatureField,
    located: Located | None,
    view: FrozenView,
    codes: Array,
    of_gaussians: Array,
    plan: Plan,
    count: int,
):
    cosines, alphas = pixel_cosines(field, located, view, plan, codes)
    share, _ = paint(view, jax.nn.one_hot(of_gaussians, count), plan)
    return cosines.argmax(axis=-1), share, alphas
