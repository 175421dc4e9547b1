"""`gsjax eval`: scores the scene of a run of `gsjax fit` again, or with more metrics."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import tyro
from jaxtyping import Int
from rich.console import Console
from rich.progress import track

from gsjax.data.origin import relative_to_origin
from gsjax.data.photographs import Photographs
from gsjax.engine.fit.judge import Compared, Judge, write_panel
from gsjax.engine.folder import replaced_folder
from gsjax.engine.machine import describe as describe_machine
from gsjax.engine.messages import Notes, counted
from gsjax.engine.options import Common
from gsjax.engine.photographs import photographs_of_run, read_frames, split
from gsjax.engine.records import EVALUATION, Record, digest, read_record
from gsjax.engine.report import write_report
from gsjax.engine.scores import mean_scores
from gsjax.engine.summary import Card, Column, Media, Summary, Table, title_of
from gsjax.engine.terminal import print_summary
from gsjax.io.atomic import write_json
from gsjax.io.brief import shortened
from gsjax.io.ply import read_ply
from gsjax.methods.fit import FitConfig
from gsjax.methods.fit.padding import sizes_of
from gsjax.metrics.image import MS_SSIM_LEAST_SIDE, ms_ssim
from gsjax.metrics.perceptual import LpipsWeights, fingerprint, load_lpips, lpips
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians

NO_LPIPS = (
    "LPIPS: absent, for no weights were given (--lpips-weights PATH; docs/scores.md says what they are)."
)
COLUMNS = (
    Column("PSNR", "psnr", "dB", 2),
    Column("PSNR, colours matched", "psnr_matched", "dB", 2),
    Column("SSIM", "ssim", "", 3),
    Column("MS-SSIM", "ms_ssim", "", 3),
    Column("LPIPS", "lpips", "", 3),
    Column("depth", "depth_mm", "mm", 1),
)
Color = tuple[float, float, float]
_WRITTEN = (EVALUATION.name, "report.html", "renders")
_PICTURES = 12  # in the report, at most
_HELD_OUT, _TRAIN = "held out", "train"
_PER_PHOTOGRAPH = {"exposure": "an exposure", "refine_poses": "a pose"}


@dataclass(frozen=True)
class Options(Common):
    """Options of `gsjax eval`."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder of a run of `gsjax fit`, finished or stopped."""
    views: Literal["held-out", "train", "all"] = "held-out"
    """Which photographs to score: held-out ones, training ones, or both."""
    images: str | None = None
    """Current location of the photographs; default: where the fit found them."""
    lpips_weights: Path | None = None
    """Weights of LPIPS, a .npz or .safetensors file or a folder of them; without them LPIPS is not scored."""


class Chosen(NamedTuple):
    """Photographs to score.

    Attributes:
        photographs: all photographs, at the size at which they were fitted.
        indices: those to score.
        held_out: whether each of these was held out.
    """

    photographs: Photographs
    indices: Int[np.ndarray, "n"]
    held_out: list[bool]


def run(options: Options) -> int:
    """Score the views, and write eval/ into the run's folder; returns the exit code.

    Raises:
        ValueError, OSError: there is no such run, or its photographs or the weights cannot be read.
    """
    console = Console(stderr=True, highlight=False)
    with Notes(console) as notes:
        record = read_record(options.run)
        _check(record)
        weights = None if options.lpips_weights is None else load_lpips(options.lpips_weights)
        gaussians, report = read_ply(record.path / "scene.ply")
        photographs, indices, held_out = _choose(options, record)
        photographs = relative_to_origin(photographs, report.origin)
        frames = read_frames(photographs.select(indices.tolist()), console)
        folder, rows = record.path / EVALUATION.parent, []
        with replaced_folder(folder, _WRITTEN) as new:
            exposed = bool(record.config["fit"].get("exposure"))
            compared = _compared(record, gaussians, frames, photographs.background)
            for seen in track(compared, "scoring", len(frames), console=console, transient=True):
                picture, i = Path("renders", f"{len(rows):06d}.png"), len(rows)
                write_panel(new / picture, seen)
                row = {"view": photographs.names[indices[i]], "split": _HELD_OUT if held_out[i] else _TRAIN}
                rows.append(row | scores(seen, weights, exposed) | {"picture": picture.as_posix()})
            _note_missing(notes, record, rows, frames, weights)
            known = None if weights is None else {"network": weights.network, "weights": fingerprint(weights)}
            found = {
                "kind": "eval",
                "dataset": photographs.name,
                "complete": record.complete,
                "scene_sha256": digest(record.path / "scene.ply"),
                "num_gaussians": gaussians.num,
                "lpips": known or {"absent": NO_LPIPS},
                "mean": {
                    kind: mean_scores([row for row in rows if row["split"] == kind], [c.key for c in COLUMNS])
                    for kind in dict.fromkeys(row["split"] for row in rows)
                },
                "views": rows,
                "machine": describe_machine(),
                "notes": notes.all,
            }
            summary = _summarize(new, record, found)
            write_report(new / "report.html", summary)
            write_json(new / EVALUATION.name, found)
    print_summary(summary, folder / "report.html", notes=True)
    return 0


def scores(seen: Compared, weights: LpipsWeights | None, exposed: bool = False) -> dict[str, float | None]:
    """The scores of a view, by the keys of `COLUMNS`; None where the picture is too small for a score, or
    where the depth or the weights that it requires are missing.

    Args:
        seen: the view.
        weights: of LPIPS.
        exposed: whether the fit learned an exposure for each photograph, so that PSNR is also taken with
            colours matched.
    """
    pair, side = (seen.image, seen.truth, seen.mask), min(seen.covered.shape)
    perceived = weights is not None and side >= weights.least_side
    return {
        "psnr": seen.psnr(),
        "psnr_matched": seen.psnr_matched() if exposed else None,
        "ssim": seen.ssim(),
        "ms_ssim": ms_ssim(*pair) if side >= MS_SSIM_LEAST_SIDE else None,
        "lpips": lpips(weights, *pair) if weights is not None and perceived else None,
        "depth_mm": seen.depth_mm(),
    }


def _check(record: Record) -> None:
    """Raises ValueError if the run is not a fit, or has no scene."""
    if record.kind != "fit":
        raise ValueError(
            f"{record.path}: expected a run of `gsjax fit`, found one of `gsjax {record.kind}`, whose frames "
            "were scored when it ended; see its metrics.json"
        )
    if not (record.path / "scene.ply").is_file():
        raise ValueError(
            f"{record.path}: expected a scene.ply to score, found none: the run is still going on, or was "
            "killed; gsjax fit --resume finishes it"
        )


def _choose(options: Options, record: Record) -> Chosen:
    """The photographs of the fit, and which of them are to be scored.

    Raises:
        ValueError: they cannot be read, are others than those of the fit, or none is held out.
    """
    config, dataset = record.config, options.images or str(record.config.get("dataset"))
    photographs = photographs_of_run(config, dataset)
    train, held_out = split(photographs, config["test_every"])
    names = [photographs.names[i] for i in held_out]
    known = (record.metrics or {}).get("views")
    # Under --minutes, a fit may have scored some of them only.
    if known and len(held_out) and not {row["view"] for row in known} <= set(names):
        raise ValueError(
            f"{dataset}: expected the photographs of the fit, which held out "
            f"{shortened((row['view'] for row in known), 4)}, found others, which would hold out "
            f"{shortened(names, 4)}; "
            "give the folder of the fit's photographs with --images"
        )
    if options.views == "held-out" and not len(held_out):
        raise ValueError(
            f"{record.path}: the fit held out no photograph; score those it saw by --views train"
        )
    parts = {"held-out": (held_out,), "train": (train,), "all": (held_out, train)}[options.views]
    return Chosen(photographs, np.concatenate(parts), np.isin(np.concatenate(parts), held_out).tolist())


def _compared(
    record: Record, gaussians: Gaussians, frames: list[Frame], behind: Color | None
) -> Iterator[Compared]:
    """Each rendered view and its photograph; views of the same size share a plan."""
    fit = record.config["fit"]
    background = {"data": behind, "white": (1.0, 1.0, 1.0)}.get(fit.get("background", "data"))
    config = FitConfig(antialiased=bool(fit.get("antialiased", False)))
    judge = Judge(config, background, sizes_of(frames))
    for frame in frames:
        yield judge.compare(gaussians, frame)


def _note_missing(
    notes: Notes,
    record: Record,
    rows: list[dict[str, Any]],
    frames: list[Frame],
    weights: LpipsWeights | None,
) -> None:
    """Notes why scores are absent, and what training views are scored without."""

    def small(key: str, least: int, name: str) -> None:
        count = sum(row[key] is None for row in rows)
        if count:
            notes.add(
                f"{name}: absent for {count} of {len(rows)} views, which have a side below {least} pixels."
            )

    small("ms_ssim", MS_SSIM_LEAST_SIDE, "MS-SSIM")
    if weights is None:
        notes.add(NO_LPIPS)
    else:
        small("lpips", weights.least_side, "LPIPS")
        notes.add(f"LPIPS 0.1 with {weights.network} (weights {fingerprint(weights)}).")
    if all(frame.depths is None for frame in frames):
        notes.add("Depth: not scored, for the photographs have none.")
    learned = [words for name, words in _PER_PHOTOGRAPH.items() if record.config["fit"].get(name)]
    if learned and any(row["split"] == _TRAIN for row in rows):
        notes.add(
            f"The fit learned {' and '.join(learned)} for each photograph, which scene.ply does not "
            "contain: training views are scored without them."
        )


def _summarize(folder: Path, record: Record, found: dict[str, Any]) -> Summary:
    """The summary of an evaluation, whose pictures lie in `folder`."""
    rows, means = found["views"], found["mean"]
    every = max(1, -(-len(rows) // _PICTURES))
    split = [Column("split", "split")] if len(means) > 1 else []
    return Summary(
        title=f"Scores of {record.path.resolve().name}",
        subtitle=f"{title_of(found['dataset'])}: {counted(len(rows), 'view')}, "
        f"{found['num_gaussians']:,} Gaussians"
        + ("" if found["complete"] else ", of a run that was not finished"),
        cards=[
            Card(f"{column.head}, {kind}", values[column.key], column.unit, column.decimals)
            for kind, values in means.items()
            for column in COLUMNS
            if values[column.key] is not None
        ],
        tables=[
            Table(
                "Scores",
                [Column("view", "view"), *split, *COLUMNS],
                rows,
                means=[
                    values | {"view": f"mean of {sum(row['split'] == kind for row in rows)} {kind}"}
                    for kind, values in means.items()
                ],
                brief=True,
            )
        ],
        strips=[Media(folder / row["picture"], f"{row['view']}, {row['split']}") for row in rows[::every]],
        notes=found["notes"],
        machine=found["machine"],
    )
