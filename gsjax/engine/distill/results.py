"""The summary of a distillation: agreement with the teacher, classes, and pictures of the features."""

import shlex

from gsjax.engine.folder import RunFolder
from gsjax.engine.messages import counted
from gsjax.engine.summary import (
    Column,
    Media,
    Metrics,
    Score,
    Summary,
    Table,
    at,
    cards_of,
    minutes,
    title_of,
)
from gsjax.viz.plots import losses_over_steps, save

SCORES = (
    Score("cosine to the teacher", "cosine", "", 3, "more", at("test", "cosine")),
    Score("mIoU 2D", "miou_2d", "", 3, "more", at("test", "miou_2d")),
    Score("mIoU 3D", "miou_3d", "", 3, "more", at("test", "miou_3d")),
    Score("boundary mIoU 3D", "mboundary_iou_3d", "", 3, "more", at("test", "mboundary_iou_3d")),
    Score("Gaussians", "num_gaussians", "", None, None, at("num_gaussians")),
    Score("parameters", "trained", "", None, "less", at("trained")),
    Score("time", "minutes", "min", 2, "less", minutes(), "machine"),
    Score("steps", "steps", "", None, None, at("steps")),
)
_CLASSES = (
    Column("class", "class"),
    Column("IoU, 3D query", "iou_3d", "", 3),
    Column("IoU, 2D query", "iou_2d", "", 3),
    Column("boundary IoU, 3D", "boundary_iou_3d", "", 3),
    Column("boundary IoU, 2D", "boundary_iou_2d", "", 3),
)
_VIEWS = (Column("view", "view"), Column("cosine to the teacher", "cosine", "", 3))


def asked_by(features: str) -> str:
    """The arguments of `gsjax query` for a field, as in its usage line; an unknown encoder reads no texts.

    Args:
        features: the kind of the features.
    """
    return "--point X,Y --camera ID" if features == "files" else "TEXT"


def summarize(folder: RunFolder, found: Metrics) -> Summary:
    """The summary of a distillation; also draws its losses into the folder."""
    plots, judged, views = [], found["judged_by"], found["views"]
    if len(found["curve"]) > 1:
        plot = save(losses_over_steps(found["curve"]), folder.plot("losses"))
        plots.append(Media(plot, "Losses, unweighted, over steps"))
    names = [f"Names: {', '.join(found['names'])}."] if found["names"] else []
    return Summary(
        title=f"A field on {title_of(found['dataset'])}",
        subtitle=(
            f"{found['features_are']}; masks: {found['masks']}; {counted(views['taught'], 'view')} taught, "
            f"{views['held_out']} held out; scores are of views {judged}"
        ),
        cards=cards_of(SCORES, found),
        tables=[
            Table("Classes", _CLASSES, found["classes"], brief=True),
            Table("Views", _VIEWS, found["scores"]),
        ],
        plots=plots,
        strips=[
            Media(folder.path / row["picture"], f"{row['view']}, {judged}")
            for row in found["scores"]
            if "picture" in row
        ],
        notes=[*names, *found["notes"]],
        machine=found["machine"],
        hints=[("query it", f"gsjax query {shlex.quote(str(folder.path))} {asked_by(found['features'])}")],
        complete=found["complete"],
    )
