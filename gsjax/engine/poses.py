"""A run of `gsjax poses`: photographs without poses in, a dataset with cameras out."""

import os
import shlex
import shutil
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import numpy as np
import tyro
from rich.console import Console

from gsjax.data import Photographs, open_photographs, read_colmap
from gsjax.data.alignment import align_cameras
from gsjax.data.stills import write_stills
from gsjax.data.structure_from_motion import (
    MotionConfig,
    SfmResult,
    list_photographs,
    reconstruct_cameras,
)
from gsjax.engine.locks import lock, releasing_locks
from gsjax.engine.messages import Notes, stage
from gsjax.engine.options import Common, Overwriting
from gsjax.engine.terminal import print_facts
from gsjax.io.atomic import write_json
from gsjax.io.brief import shortened
from gsjax.io.parsed import parse_json

REPORT = "poses.json"
"""The results, in the folder that is written; it also marks the folder as written by gsjax."""


@dataclass(frozen=True)
class Options(Common, Overwriting):
    """Options of `gsjax poses`."""

    images: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="IMAGES")]
    """Folder of photographs, or a video."""
    out: Path
    """Folder for the dataset: images/ and COLMAP's sparse/0/."""
    stills: int = 100
    """Number of pictures to take from a video: the sharpest in each of as many equal intervals."""
    compare: str | None = None
    """A dataset with poses of the same photographs (matched by name), to compare the result with."""
    place: Annotated[MotionConfig, tyro.conf.arg(name="")] = field(default_factory=MotionConfig)
    """Settings of the reconstruction."""


@releasing_locks()
def run(options: Options) -> int:
    """Find the cameras of photographs, and write a dataset that `gsjax fit` opens.

    Raises:
        ValueError, OSError: an option cannot be met; nothing is left behind.
    """
    console, begun = Console(stderr=True, highlight=False), perf_counter()
    of_video = options.images.is_file()
    in_place = not of_video and options.images.resolve() == (options.out / "images").resolve()
    if not of_video and options.images.resolve() == options.out.resolve():
        raise ValueError(
            f"--out {options.out}: the photographs themselves are there; name another folder, or move them "
            f"to {options.out / 'images'} and give that"
        )
    if not of_video and options.images.resolve() in options.out.resolve().parents:
        raise ValueError(
            f"--out {options.out}: expected a folder outside {options.images}, found one among the "
            "photographs, where the copies would be taken for more of them; name another folder"
        )
    lock(options.out)
    _check_out(options.out, in_place, options.overwrite)
    with Notes(console) as notes:
        names = [] if of_video else list_photographs(options.images)
        reference = None if options.compare is None else open_photographs(options.compare)
        if reference is not None and not of_video:
            _in_both(names, reference)  # an error before the work, not after
        with tempfile.TemporaryDirectory(prefix=".poses-", dir=options.out) as made:
            work = Path(made)
            folder = work / "images" if of_video else options.images
            if of_video:
                with stage(console, f"choosing frames of {options.images}"):
                    names = write_stills(options.images, folder, options.stills)
            announce = partial(stage, console)
            placed = reconstruct_cameras(
                folder, names, work, options.place, in_order=of_video, stage=announce
            )
            _write(options, placed, names, work, folder, in_place)
        photographs = read_colmap(options.out)  # makes sure that it can be read
        found = _found(options, placed, len(names), perf_counter() - begun)
        found |= {"copied": not in_place, "notes": notes.all}
        write_json(options.out / REPORT, found)
        if reference is not None:
            found["compared"] = compare(photographs, reference)
            write_json(options.out / REPORT, found)
    print_facts(_facts(found), title=str(options.out))
    print(f"\nNext: gsjax fit {shlex.quote(str(options.out))} --out RUN")
    return 0


def compare(photographs: Photographs, reference: Photographs) -> dict[str, Any]:
    """Differences from the cameras of another dataset for photographs of the same name, after aligning their
    centres by a similarity.

    Raises:
        ValueError: fewer than three names agree.
    """
    both = _in_both(photographs.names, reference)
    ours, theirs = (list(indices) for indices in zip(*both, strict=True))
    aligned = align_cameras(photographs.viewmats[ours], reference.viewmats[theirs])
    share = aligned.moved / aligned.extent
    focal = photographs.Ks[ours, 0, 0] / photographs.sizes[ours, 0]
    given = reference.Ks[theirs, 0, 0] / reference.sizes[theirs, 0]
    return {
        "dataset": reference.name,
        "photographs": len(both),
        "turned_deg": {"median": np.median(aligned.turned_deg), "max": aligned.turned_deg.max()},
        "moved_share_of_extent": {"median": np.median(share), "max": share.max()},
        "focal_ratio": float(np.median(focal / given)),
        "scale": aligned.scale,
    }


def _in_both(names: Sequence[str], reference: Photographs) -> list[tuple[int, int]]:
    """Pairs of indices of the photographs that both have: those whose paths have an end in common that occurs
    once in each."""
    pairs: dict[int, int] = {}
    for length in range(1, 1 + max(len(Path(name).parts) for name in (*names, *reference.names))):
        ours, theirs = _by_unique_end(names, length), _by_unique_end(reference.names, length)
        pairs |= {ours[end]: theirs[end] for end in ours.keys() & theirs.keys()}
    both = sorted(pairs.items())
    if len(both) < 3:
        raise ValueError(
            f"--compare: expected poses of three of these photographs or more in {reference.name}, found "
            f"{len(both)} of the same name; it has {shortened(reference.names, 5)}"
        )
    return both


def _by_unique_end(names: Sequence[str], length: int) -> dict[tuple[str, ...], int]:
    """Indices of paths by their last `length` parts, where these occur once."""
    ends = [Path(name).parts[-length:] for name in names]
    counts = Counter(ends)
    return {end: i for i, end in enumerate(ends) if counts[end] == 1}


def _check_out(out: Path, in_place: bool, overwrite: bool) -> None:
    own = [
        name for name in ("images", "sparse") if (out / name).exists() and not (in_place and name == "images")
    ]
    if not own:
        return
    if not (out / REPORT).is_file():
        raise FileExistsError(
            f"{out}: expected a folder without images and sparse, found {' and '.join(own)} that gsjax "
            "poses did not write; name another folder"
        )
    if "images" in own and not _has_copies(out):
        raise FileExistsError(
            f"{out / 'images'}: expected copies made by gsjax poses, and {REPORT} does not say that they are "
            "(copied); name another folder, or move them"
        )
    if not overwrite:
        raise FileExistsError(f"{out}: found the result of an earlier gsjax poses; --overwrite replaces it")


def _has_copies(out: Path) -> bool:
    """Whether gsjax copied the photographs in images/; where the report does not say so, they are the
    user's."""
    try:
        return parse_json((out / REPORT).read_text(encoding="utf-8")).get("copied") is True
    except (ValueError, AttributeError):
        return False


def _write(
    options: Options, placed: SfmResult, names: list[str], work: Path, folder: Path, in_place: bool
) -> None:
    """Move the results into place; nothing is replaced until all of them exist."""
    sparse = work / "new" / "sparse"
    (sparse / "0").mkdir(parents=True)
    placed.model.write_binary(sparse / "0")
    images = work / "images"
    if not in_place and folder != images:
        for name in names:
            (images / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(folder / name, images / name)
    mark = {"complete": False, "copied": not in_place}
    write_json(options.out / REPORT, mark)  # marks the folder, whatever happens from here on
    for new, old in ((images, options.out / "images"), (sparse, options.out / "sparse")):
        if new.exists():
            if old.is_symlink():
                old.unlink()
            elif old.exists():
                shutil.rmtree(old)
            os.replace(new, old)


def _found(options: Options, placed: SfmResult, count: int, seconds: float) -> dict[str, Any]:
    camera = placed.model.cameras[min(placed.model.cameras)]
    return {
        "photographs": count,
        "registered": len(placed.names),
        "left_out": list(placed.left_out),
        "other_models": list(placed.others),
        "points": placed.points,
        "error_px": placed.error_px,
        "track_length": placed.model.compute_mean_track_length(),
        "pairs": placed.pairs,
        "features": {
            "median": np.median(list(placed.features.values())),
            "least": min(placed.features.values()),
        },
        "cameras": {
            "number": len(placed.model.cameras),
            "model": options.place.camera_model,
            "size": [camera.width, camera.height],
            "params": list(camera.params),
        },
        "seconds": placed.seconds | {"total": seconds},
    }


def _facts(found: dict[str, Any]) -> dict[str, str]:
    """The results in a few lines."""
    left_out, others, cameras = found["left_out"], found["other_models"], found["cameras"]
    facts = {
        "registered": f"{found['registered']} of {found['photographs']} photographs",
        "left out": f"{len(left_out)}: {shortened(left_out, 5)}" if left_out else "none",
        "points": f"{found['points']:,}, each in {found['track_length']:.1f} photographs on average",
        "error": f"{found['error_px']:.2f} px mean reprojection error",
        "cameras": f"{cameras['number']} {cameras['model']}, {cameras['size'][0]} x {cameras['size'][1]}, "
        f"focal length {cameras['params'][0]:.1f} px",
        "time": ", ".join(f"{name} {took:.0f} s" for name, took in found["seconds"].items()),
    }
    if others:
        facts["other models"] = (
            f"of {', '.join(map(str, others))} photographs, left out: nothing joins them to the first one. "
            "More photographs in between would"
        )
    if (compared := found.get("compared")) is not None:
        turned, moved = compared["turned_deg"], compared["moved_share_of_extent"]
        facts["compared"] = (
            f"with {compared['photographs']} of {compared['dataset']}: turned by {turned['median']:.3f}° "
            f"(median; at most {turned['max']:.3f}°), moved by {moved['median']:.2%} of the cameras' extent "
            f"(at most {moved['max']:.2%}), focal length {compared['focal_ratio']:.4f} of theirs"
        )
    return facts
