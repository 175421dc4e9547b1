"""Results of a distillation: agreement with the teacher, pictures of the features, the report."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8
from rich.console import Console
from rich.table import Table as Grid

from gsjax.engine.distill.scene import FieldScene
from gsjax.engine.distill.scores import ClassScores, Frozen, angle_error, class_maps, classes_of, one_by_one
from gsjax.engine.ending import print_grid
from gsjax.engine.folder import RunFolder
from gsjax.engine.machine import in_words
from gsjax.engine.messages import Notes, describe
from gsjax.engine.report import Media, Table, write_report
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
from gsjax.viz.plots import losses_over_steps, save

_SHOWN = 6  # views in the report, classes in a line of the terminal
_WEAK = 0.5  # IoU of a class that is not learned well
_PCA_GAUSSIANS = 20_000  # at most, to fit the colours to
_PANEL_HEIGHT = 240  # pixels, at least


def judge(
    folder: RunFolder,
    scene: FieldScene,
    teaching: Teaching,
    result: DistillResult,
    config: DistillConfig,
    notes: Notes,
) -> dict[str, Any]:
    """Compares held-out views, or some of those that taught where none is held out, with the teacher, and
    draws some. A photograph that cannot be read is noted and not compared.

    Args:
        folder: of the run, for pictures.
        scene: the scene and its photographs.
        teaching: the teacher of any photograph.
        result: the field.
        config: its settings.
        notes: receives warnings.
    """
    held_out, photographs = len(scene.held_out) > 0, scene.photographs
    which = scene.held_out if held_out else scene.taught[:: max(1, len(scene.taught) // _SHOWN)][:_SHOWN]
    field, located = result.placed
    views = one_by_one(scene.gaussians, (photographs.camera(i) for i in which), scene.rasterize_mode)
    names = {label - 1: name for label, name in teaching.source.names.items()}
    codes = of_gaussians = None
    if teaching.source.kind == "classes":
        encoder = teaching.source.encoder()
        codes = np.stack([encoder.embed_text(name) for name in names.values()])
        of_gaussians, order = classes_of(field, located, codes), np.array(list(names))
    scores, rows, error_of = ClassScores(names), [], angle_error(config)
    colors, pca = feature_colors(field, located)
    for view, i in zip(views, which, strict=True):
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
    """The three principal components of each Gaussian's feature, and the colours that stand for them."""
    parts = rendered_features(field, located)
    some = parts.values[:: max(1, len(parts.values) // _PCA_GAUSSIANS)]
    pca = fit_pca_colors(np.asarray(parts.channels_of(parts.joined(some, jnp.ones(len(some), some.dtype)))))
    axes = jnp.asarray(pca.axes, parts.values.dtype)
    # Linear, as rendering is: three channels are painted, not all.
    ones = jnp.ones(len(parts.values), parts.values.dtype)
    numbers = jnp.matmul(parts.joined(parts.values, ones), parts.lifted(axes.T).T, precision="highest")
    return numbers, pca._replace(mean=pca.mean @ pca.axes, axes=np.eye(3))


def draw_features(
    numbers: Float[Array, "n three"], frozen: Frozen, pca: PcaColors
) -> UInt8[np.ndarray, "h w 3"]:
    """A view in the colours of its features; pixels that show little of the scene are near black.

    Args:
        numbers: components of each Gaussian, from `feature_colors`.
        frozen: the view.
        pca: their colours, from `feature_colors`.
    """
    image, alphas = (np.asarray(a) for a in paint(frozen[0], numbers, frozen[1]))
    alphas = alphas[..., None]
    return colorize_features(np.where(alphas > 0.5, image / np.maximum(alphas, 0.5), np.nan), pca)


def write_results(folder: RunFolder, found: dict[str, Any]) -> None:
    """Writes the losses' plot and report.html."""
    plots = []
    if found["curve"]:
        save(losses_over_steps(found["curve"]), folder.plot("losses"))
        plots.append(Media(folder.plot("losses"), "Losses, unweighted, over steps"))
    test, judged, cards = found["test"], found["judged_by"], {}
    if test["miou_3d"] is not None:
        cards[f"mIoU by 3D query, {judged}"] = f"{test['miou_3d']:.3f}"
        cards["mIoU by 2D query"] = f"{test['miou_2d']:.3f}"
    if test["cosine"] is not None:
        cards[f"cosine to the teacher, {judged}"] = f"{test['cosine']:.3f}"
    cards["Gaussians"] = found["num_gaussians"]
    cards["Learned for"] = (
        f"{(found['seconds']['steps'] + found['seconds']['compile']) / 60:.1f}",
        "minutes",
    )
    tables = [
        Table("Views", ("view", "cosine to the teacher"), [[r["view"], r["cosine"]] for r in found["scores"]])
    ]
    if found["classes"]:
        keys = ("class", "iou_3d", "iou_2d", "boundary_iou_3d", "boundary_iou_2d")
        heads = ("class", "IoU, 3D query", "IoU, 2D query", "boundary IoU, 3D", "boundary IoU, 2D")
        rows = [[row[key] for key in keys] for row in found["classes"]]
        tables.insert(0, Table("Classes", heads, rows, decimals=(None, 3, 3, 3, 3)))
    shown = [
        Media(folder.path / r["picture"], f"{r['view']}, {judged}") for r in found["scores"] if "picture" in r
    ]
    views = found["views"]
    write_report(
        folder.report,
        title=f"A field on {found['dataset']}" + ("" if found["complete"] else " (partial run)"),
        subtitle=f"{found['features_are']}; {views['taught']} views taught, {views['held_out']} held out",
        summary=cards,
        strips=shown,
        plots=plots,
        tables=tables,
        notes=[*found["notes"], f"Machine: {in_words(found['machine'])}."],
    )


def print_results(folder: RunFolder, found: dict[str, Any]) -> None:
    """The run in a few lines."""
    grid, test = Grid.grid(padding=(0, 3, 0, 0)), found["test"]
    words = []
    if test["miou_3d"] is not None:
        words.append(f"mIoU {test['miou_3d']:.3f} by 3D query, {test['miou_2d']:.3f} by 2D query")
    if test["cosine"] is not None:
        words.append(f"cosine {test['cosine']:.3f}")
    if words:
        views = "held out" if found["views"]["held_out"] else "that taught it (none is held out)"
        grid.add_row("[bold]views[/]", f"{', '.join(words)}, of those {views}")
    weak = sorted((row["iou_3d"], row["class"]) for row in found["classes"] if row["iou_3d"] < _WEAK)
    if weak:
        listed = ", ".join(f"{name} {iou:.2f}" for iou, name in weak[:_SHOWN])
        grid.add_row(
            "[bold]weak[/]", f"[yellow]{listed}{', ...' if len(weak) > _SHOWN else ''}[/] (IoU, 3D query)"
        )
    grid.add_row("[bold]features[/]", f"{found['features_are']}; masks: {found['masks']}")
    if found["names"]:
        grid.add_row("[bold]names[/]", ", ".join(found["names"]))
    seconds = found["seconds"]
    pace = f" ({seconds['steps'] / max(1, found['steps']):.2f} s each)" if seconds["steps"] else ""
    minutes = (seconds["steps"] + seconds["compile"]) / 60
    grid.add_row("[bold]steps[/]", f"{found['steps']:,} in {minutes:.1f} min{pace}")
    print_grid(folder, found, grid)
    Console(highlight=False).print(f"[bold]ask it[/]  gsjax query {folder.path} TEXT", soft_wrap=True)
