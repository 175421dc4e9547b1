"""`gsjax distill`: meaning on the Gaussians of a scene that stands, to be asked by `gsjax query`."""

import dataclasses
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Annotated, Literal

import jax
import tyro
from rich.console import Console

from gsjax.cli.distill_loop import Learning, learn, load
from gsjax.cli.feature_cache import FeatureCache
from gsjax.cli.field_file import NAME, StoredField, write_field
from gsjax.cli.field_results import judge, print_results, write_results
from gsjax.cli.field_scene import FieldScene, scaled, scene_of_file, scene_of_run
from gsjax.cli.field_source import SAID
from gsjax.cli.field_teacher import Asked, teach
from gsjax.cli.machine import describe as describe_machine
from gsjax.cli.messages import Notes, reason, stage
from gsjax.cli.recording import expect_scale, located
from gsjax.cli.run_folder import RunFolder, expect_run
from gsjax.cli.run_records import digest
from gsjax.data.open import ReadOptions
from gsjax.methods.feature_field import FieldConfig, begin_field

FOLDER = "field"
"""Within a run, where its field lies."""
_OF_NO_BEARING = ("resume", "overwrite", "debug", "out")  # on what is learned
_OF_PHOTOGRAPHS = ("frames", "cameras", "eval_cameras", "test_every", "read")  # a run has chosen these


@dataclass(frozen=True)
class Options:
    """What `gsjax distill` is told."""

    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|SCENE.ply")]
    """Folder of a run of `gsjax fit`, `gsjax track` (its first frame) or `gsjax parts` (its canonical frame);
    or a PLY file that anybody made, with --images and --out."""
    out: Path | None = None
    """Folder for the field. Unless given, `field` in the run's."""
    images: str | None = None
    """Photographs of a PLY file's scene, posed in its world: a folder, as for `gsjax fit`. Of a run: where
    they are now."""
    features: str = "auto"
    """What is to be learned: classes (a code for each class of the mask files), closed (colour and outline of
    each mask; no foundation model), clip or maskclip (with --weights), or a folder of feature files
    (LangSplat's, Feature-3DGS's, LERF's, .npy, .npz). auto: classes if there are mask files, else closed."""
    masks: Literal["auto", "files", "segment"] = "auto"
    """Whose masks: the recording's own, or a segmenter's that needs no weights. auto: files if there are."""
    sam: Path | None = None
    """Folder of SAM's weights: let it segment."""
    weights: Path | None = None
    """Folder of CLIP's weights, in the layout of Hugging Face."""
    level: Literal["default", "small", "medium", "large"] = "default"
    """Of LangSplat's files, which size of objects."""
    scale: float = 1.0
    """Learn from photographs this many times smaller, as in 0.5; time goes with the number of pixels."""
    frames: Annotated[str, tyro.conf.arg(metavar="START:STOP[:STEP]")] = ":"
    """Of --images: which photographs, or which frame of a recording, as Python slices them."""
    cameras: Annotated[tuple[int, ...], tyro.conf.arg(metavar="ID [ID ...]")] = ()
    """Of --images, a recording: ids of the cameras to learn from. All that are not held out, unless given."""
    eval_cameras: Annotated[tuple[int, ...], tyro.conf.arg(metavar="ID [ID ...]")] = ()
    """Of --images, a recording: ids of cameras that only judge."""
    test_every: int = 8
    """Of --images: hold out every N-th photograph where the data has no split; 0 holds out none."""
    resume: bool = False
    """Go on with the unfinished field in the same folder, given the same options, to the same bits."""
    overwrite: bool = False
    """Replace an earlier field in the same folder."""
    debug: bool = False
    """Show Python's traceback when something fails."""
    read: ReadOptions = dataclasses.field(default_factory=ReadOptions)
    """Of --images: what the layout of the data leaves open."""
    field: FieldConfig = dataclasses.field(default_factory=FieldConfig)
    """How it is learned."""


def run(options: Options) -> int:
    """Distil a field and report on it; returns the exit code.

    Raises:
        ValueError, OSError: what was asked cannot be done; everything learned before that is on disk.
    """
    console, begun = Console(stderr=True, highlight=False), perf_counter()
    with Notes(console) as notes:
        asked = Asked(options.features, options.masks, options.sam, options.weights, options.level)
        asked.check()
        scene = open_scene(options)
        folder = RunFolder(_out(options), overwrite=options.overwrite, resume=options.resume)
        settings = replace(options, scene=Path(located(str(options.scene))))
        if options.images is not None:
            settings = replace(settings, images=located(options.images))
        if options.resume:
            folder.check_config(settings, but=_OF_NO_BEARING)
        cache, photographs = FeatureCache(), scene.photographs
        said = teach(photographs, scene.taught, asked, cache, console)
        if asked.features == "auto":
            console.print(f"[bold]features[/]  {said.source.kind}: {SAID[said.source.kind]}", soft_wrap=True)
        with stage(console, "looking which Gaussians each view shows"):
            cameras = [photographs.camera(i) for i in scene.taught]
            problem, state = begin_field(
                scene.gaussians, cameras, said.teacher, options.field, scene.rasterize_mode
            )
        folder.write_config(settings)  # from here on an earlier field is gone
        learning = Learning(state)
        if options.resume:
            learning = load(folder.resume, learning)
            notes.add(f"Resumed after {learning.state.step} steps of an earlier run.")
        learning = learn(problem, learning, folder, console)
        stored = StoredField(
            learning.state.field,
            problem.rows,
            said.source,
            {
                "file": str(scene.file.resolve()),
                "sha256": digest(scene.file),
                "num_gaussians": scene.gaussians.num,
                "rasterize_mode": scene.rasterize_mode,
            },
        )
        write_field(folder.path / NAME, stored)
        complete = learning.stopped is None
        with stage(console, "asking it about views"):
            judged = judge(folder, scene, said, asked, cache, stored, options.field, notes)
        _say_what_was_odd(scene, learning, notes)
        found = {
            "kind": "distill",
            "dataset": photographs.name,
            "complete": complete,
            "report": True,
            "stopped": None if complete else reason(learning.stopped),
            "features": said.source.kind,
            "features_are": SAID[said.source.kind],
            "masks": said.masks,
            "names": sorted(said.source.names.values()),
            "dimension": said.teacher.dimension,
            "steps": learning.state.step,
            "skipped": learning.skipped,
            "num_gaussians": scene.gaussians.num,
            "trained": sum(leaf.size for leaf in jax.tree.leaves(learning.state.field)),
            "views": {"taught": len(problem.views), "held_out": len(scene.held_out)},
            "size": photographs.sizes.max(0),
            "encoded": {"anew": cache.asked, "from_cache": cache.found},
            "seconds": {
                "steps": learning.seconds,
                "compile": learning.compile_seconds,
                "total": perf_counter() - begun,
            },
            "machine": describe_machine(),
            **judged,
            "curve": learning.rows,
            "notes": notes.all,
        }
        folder.write_metrics(found)
        write_results(folder, found)
        if complete:
            folder.forget_resume()
    print_results(folder, found)
    if isinstance(learning.stopped, KeyboardInterrupt):
        return 130
    if learning.stopped is not None:
        raise learning.stopped
    return 0


def open_scene(options: Options) -> FieldScene:
    """The scene and its photographs.

    Raises:
        ValueError, OSError: they are not there, or options are given that a run has chosen itself.
    """
    expect_scale(options.scale)
    path = options.scene
    if path.is_file():
        if options.images is None:
            raise ValueError(f"{path}: a PLY file has no photographs; --images names a folder of them")
        if options.test_every < 0 or options.test_every == 1:
            raise ValueError(f"--test-every: expected 0 (none) or 2 and more, found {options.test_every}")
        chosen = {name: getattr(options, name) for name in ("frames", "cameras", "eval_cameras")}
        scene = scene_of_file(path, options.images, options.read, options.test_every, **chosen)
    else:
        expect_run(path, "`gsjax fit`, `gsjax track` or `gsjax parts`, or a PLY file")
        given = [n for n in _OF_PHOTOGRAPHS if getattr(options, n) != getattr(Options(path), n)]
        if given:
            flag = f"--{given[0].replace('_', '-')}"
            raise ValueError(
                f"{flag}: {path} is a run, which has its photographs chosen and split; leave it out"
            )
        scene = scene_of_run(path, options.images)
    if not scene.gaussians.num:
        raise ValueError(f"{scene.file}: expected Gaussians to give a meaning to, found none")
    return scaled(scene, options.scale)


def _out(options: Options) -> Path:
    if options.out is not None:
        return options.out
    if options.scene.is_file():
        raise ValueError(
            f"{options.scene}: a PLY file has no folder of its own; --out names one for the field"
        )
    return options.scene / FOLDER


def _say_what_was_odd(scene: FieldScene, learning: Learning, notes: Notes) -> None:
    if learning.skipped:
        notes.warn(f"{learning.skipped} steps met numbers that are not finite and changed nothing")
    if not len(scene.held_out):
        notes.add("No view is held out: nothing was judged that the field had not seen.")
