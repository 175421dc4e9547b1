"""What a distillation came to: how it agrees with its teacher, pictures of what it learned, the report."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table as Grid

from gsjax.cli.feature_cache import FeatureCache
from gsjax.cli.field_file import StoredField
from gsjax.cli.field_scene import FieldScene
from gsjax.cli.field_scores import ClassScores, Frozen, angle_errors, class_maps, classes_of
from gsjax.cli.field_teacher import Asked, Said, teach
from gsjax.cli.fit_results import mean_scores
from gsjax.cli.machine import in_words
from gsjax.cli.messages import Notes, describe
from gsjax.cli.outputs import write_png
from gsjax.cli.report import Media, Table, write_report
from gsjax.cli.run_folder import RunFolder
from gsjax.methods.feature_field import FieldConfig, carried, features_of, frozen_views
from gsjax.rasterize.frozen import paint
from gsjax.viz.colors import (
    PcaColors,
    colorize_features,
    colorize_labels,
    fit_pca_colors,
    in_rows,
    to_uint8,
)
from gsjax.viz.plots import losses_over_steps, save

_SHOWN = 6  # views in the report
_OF_PCA = 20_000  # Gaussians that the colours are made for
_PANEL_HEIGHT = 240  # pixels, at least


def judge(
    folder: RunFolder,
    scene: FieldScene,
    said: Said,
    asked: Asked,
    cache: FeatureCache,
    stored: StoredField,
    config: FieldConfig,
    notes: Notes,
) -> dict[str, Any]:
    """Compares held-out views, or those that taught where none is held out, with what the teacher says of
    them, and draws some."""
    held_out, console = len(scene.held_out) > 0, Console(quiet=True)
    which = scene.held_out if held_out else scene.taught[:: max(1, len(scene.taught) // _SHOWN)][:_SHOWN]
    photographs = scene.photographs
    field, located = stored.at(scene.gaussians.means)
    cameras = [photographs.camera(i) for i in which]
    views = frozen_views(scene.gaussians, cameras, scene.rasterize_mode)
    errors: Sequence[float | None] = [None] * len(which)
    try:
        truth = teach(photographs, which, asked, cache, console).teacher if held_out else None
        if truth is None:
            places = [scene.taught.index(i) for i in which]
            truth = said.teacher._replace(
                ids=[said.teacher.ids[p] for p in places],
                maps=None if said.teacher.maps is None else [said.teacher.maps[p] for p in places],
            )
        errors = angle_errors(field, located, views, truth, config)
    except (ValueError, OSError) as error:
        notes.add(f"Held-out views were not compared with the teacher: {describe(error)}")
    names = {label - 1: name for label, name in said.source.names.items()}
    codes = of_gaussians = None
    if said.source.kind == "classes":
        encoder = said.source.encoder()
        codes = np.stack([encoder.embed_text(name) for name in names.values()])
        of_gaussians, order = classes_of(field, located, codes), np.array(list(names))
    scores, rows, pca = ClassScores(names), [], _colors(field, located)
    for view, i, error in zip(views, which, errors, strict=True):
        row: dict[str, Any] = {"view": photographs.names[i], "cosine": None if error is None else 1 - error}
        panels = {
            "photograph": to_uint8(photographs.image(i)),
            "features": _features(field, located, view, pca),
        }
        if codes is not None and of_gaussians is not None:
            found = class_maps(field, located, view, codes, of_gaussians)
            by_pixel, in_space = (np.where(one < 0, -1, order[np.maximum(one, 0)]) for one in found)
            panels["classes, by Gaussians"] = colorize_labels(np.maximum(in_space, 0))
            if (true := photographs.labels(i)) is not None:
                scores.add(by_pixel, in_space, true)
        if len([r for r in rows if "picture" in r]) < _SHOWN:
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


def _colors(field, located) -> PcaColors:
    features = np.asarray(features_of(field, located))
    return fit_pca_colors(features[:: max(1, len(features) // _OF_PCA)])


def _features(field, located, view: Frozen, pca: PcaColors) -> np.ndarray:
    """A view in the colours of its features; what shows little of the scene is near black."""
    parts = carried(field, located)
    image, alphas = paint(view[0], parts.values, view[1])
    channels = np.asarray(parts.channels_of(parts.joined(image, alphas)))
    alphas = np.asarray(alphas)
    mean = channels / np.maximum(alphas[..., None], 0.5)
    return colorize_features(np.where(alphas[..., None] > 0.5, mean, np.nan), pca)


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
    console, grid, test = Console(highlight=False), Grid.grid(padding=(0, 3, 0, 0)), found["test"]
    words = []
    if test["miou_3d"] is not None:
        words.append(f"mIoU {test['miou_3d']:.3f} by 3D query, {test['miou_2d']:.3f} by 2D query")
    if test["cosine"] is not None:
        words.append(f"cosine {test['cosine']:.3f}")
    if words:
        grid.add_row(f"[bold]{found['judged_by']}[/]", ", ".join(words))
    grid.add_row("[bold]features[/]", f"{found['features_are']}; masks: {found['masks']}")
    if found["names"]:
        grid.add_row("[bold]names[/]", ", ".join(found["names"]))
    seconds = found["seconds"]
    pace = f" ({seconds['steps'] / max(1, found['steps']):.2f} s each)" if seconds["steps"] else ""
    minutes = (seconds["steps"] + seconds["compile"]) / 60
    grid.add_row("[bold]steps[/]", f"{found['steps']:,} in {minutes:.1f} min{pace}")
    if not found["complete"]:
        grid.add_row("[bold]stopped[/]", "[bold yellow]partial run; go on with --resume[/]")
    console.print()
    console.print(grid)
    console.print(f"[bold]report[/]  {folder.report}", soft_wrap=True)
    console.print(f"[bold]ask it[/]  gsjax query {folder.path} TEXT", soft_wrap=True)
