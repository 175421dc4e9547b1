"""Scoring a distilled field in held-out views: agreement with the teacher, and segmentation by class."""

from itertools import tee
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from gsjax.engine.budget import Budget
from gsjax.engine.distill.scene import FieldScene
from gsjax.engine.distill.scores import ClassScores, Frozen, angle_error, class_maps, classes_of, one_by_one
from gsjax.engine.folder import RunFolder
from gsjax.engine.messages import Notes, describe
from gsjax.engine.scores import mean_scores
from gsjax.engine.teaching.teaching import Teaching
from gsjax.io.pictures import write_png
from gsjax.methods.distill import DistillConfig, DistillResult, FeatureField, rendered_features
from gsjax.rasterize.frozen import paint
from gsjax.scene.feature_grid import Located
from gsjax.viz.colors import (
    PcaColors,
    colorize_features,
    colorize_labels,
    fit_pca_colors,
    in_rows,
    to_uint8,
)

_SHOWN = 6  # views in the report
_PCA_GAUSSIANS = 20_000  # at most, to fit the colours to
_PANEL_HEIGHT = 240  # pixels, at least


def judge(
    folder: RunFolder,
    scene: FieldScene,
    teaching: Teaching,
    result: DistillResult,
    config: DistillConfig,
    notes: Notes,
    budget: Budget | None = None,
) -> dict[str, Any]:
    """Compares held-out views, or some training views if none is held out, with the teacher, and draws some
    of them. A photograph that cannot be read is noted and not compared.

    Args:
        folder: of the run, for pictures.
        scene: the scene and its photographs.
        teaching: gives the teacher's features of any photograph.
        result: the field.
        config: its settings.
        notes: receives warnings.
        budget: the time that is left; if it does not allow all views, some of them are scored.
    """
    held_out, photographs = len(scene.held_out) > 0, scene.photographs
    which = scene.held_out if held_out else scene.taught[:: max(1, len(scene.taught) // _SHOWN)][:_SHOWN]
    field, located = result.placed
    names = {label - 1: name for label, name in teaching.source.names.items()}
    codes = of_gaussians = None
    if teaching.source.kind == "classes":
        encoder = teaching.source.encoder()
        codes = np.stack([encoder.embed_text(name) for name in names.values()])
        of_gaussians, order = classes_of(field, located, codes), np.array(list(names))
    scores, rows, error_of = ClassScores(names), [], angle_error(config)
    colors, pca = feature_colors(field, located)
    judged, placed = tee(which if budget is None else budget.affordable(which))
    views = one_by_one(scene.gaussians, map(photographs.camera, placed), scene.rasterize_mode)
    for view, i in zip(views, judged, strict=True):
        row: dict[str, Any] = {"view": photographs.names[i], "cosine": None}
        panels, true, shown = {}, None, len(rows) < _SHOWN
        try:
            panels["photograph"] = to_uint8(photographs.image(i))
            true = photographs.labels(i)
            if (teacher := teaching.of(i)) is not None:
                row["cosine"] = 1 - error_of(field, located, view, teacher)
        except (ValueError, OSError) as error:
            notes.warn(f"{row['view']} was not compared with the teacher: {describe(error)}")
        if shown:
            panels["features"] = draw_features(colors, view, pca)
        if codes is not None and of_gaussians is not None:
            found = class_maps(field, located, view, codes, of_gaussians, config.strip_megabytes)
            by_pixel, in_space = (np.where(one < 0, -1, order[np.maximum(one, 0)]) for one in found)
            panels["classes, by Gaussians"] = colorize_labels(np.maximum(in_space, 0))
            if true is not None:
                scores.add(by_pixel, in_space, true)
        if shown:
            path = folder.render("held_out" if held_out else "taught", len(rows))
            write_png(path, in_rows(panels, len(panels), _PANEL_HEIGHT))
            row["picture"] = str(path.relative_to(folder.path))
        rows.append(row)
    classes = scores.rows()
    found = mean_scores(rows, ("cosine",))
    things = [row for row in classes if row["label"] != 0]
    for name in ("iou_2d", "iou_3d", "boundary_iou_2d", "boundary_iou_3d"):
        found[f"m{name}"] = mean_scores(things, (name,))[name]
    return {
        "judged_by": "held out" if held_out else "taught",
        "test": found,
        "scores": rows,
        "classes": classes,
    }


def feature_colors(field: FeatureField, located: Located | None) -> tuple[Float[Array, "n three"], PcaColors]:
    """The first three principal components of each Gaussian's feature, and their mapping to colours."""
    parts = rendered_features(field, located)
    some = parts.values[:: max(1, len(parts.values) // _PCA_GAUSSIANS)]
    pca = fit_pca_colors(np.asarray(parts.channels_of(parts.joined(some, jnp.ones(len(some), some.dtype)))))
    axes = jnp.asarray(pca.axes, parts.values.dtype)
    # Both the projection and rendering are linear, so three channels are rendered instead of all.
    ones = jnp.ones(len(parts.values), parts.values.dtype)
    numbers = jnp.matmul(parts.joined(parts.values, ones), parts.lifted(axes.T).T, precision="highest")
    return numbers, pca._replace(mean=pca.mean @ pca.axes, axes=np.eye(3))


def draw_features(
    numbers: Float[Array, "n three"], frozen: Frozen, pca: PcaColors
) -> UInt8[np.ndarray, "h w 3"]:
    """A view coloured by its features; pixels that show little of the scene are near black.

    Args:
        numbers: components of each Gaussian, from `feature_colors`.
        frozen: the view.
        pca: the mapping to colours, from `feature_colors`.
    """
    image, alphas = (np.asarray(a) for a in paint(frozen[0], numbers, frozen[1]))
    alphas = alphas[..., None]
    return colorize_features(np.where(alphas > 0.5, image / np.maximum(alphas, 0.5), np.nan), pca)
