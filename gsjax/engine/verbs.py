"""The five verbs: `gsjax.fit`, `track`, `parts`, `distill` and `deform`.

Each takes opened data and yields a `Tick` per step (per frame, for `track`), whose `result` is the
scene so far:

    for now in gsjax.fit(photographs, gsjax.FitConfig(steps=2000)):
        print(now.step, now.info["psnr"], now.seconds)
    now.result
"""

from collections.abc import Sequence as Indices
from typing import TYPE_CHECKING, Any, Literal

import jax

from gsjax.data.photographs import Photographs, photographs_of
from gsjax.data.sequence import Sequence
from gsjax.engine.drive import Drive, Tick, drive, warn_of_lost_losses
from gsjax.engine.track.tracking import track as track
from gsjax.losses.extra import ExtraLosses
from gsjax.methods.deform import DeformConfig
from gsjax.methods.distill import PRESETS, Distill, DistillConfig, Teacher
from gsjax.methods.fit import Fit, FitConfig, prune
from gsjax.methods.parts import Parts, PartsConfig
from gsjax.methods.parts.pictures import Problem as PartsProblem
from gsjax.methods.protocols import Segmenter
from gsjax.optim.method import Method, Run
from gsjax.scene.gaussians import Gaussians

if TYPE_CHECKING:
    from gsjax.engine.teaching.choice import TeacherChoice
else:
    TeacherChoice = Any  # slow to import, like everything that finds a teacher


def fit(
    photographs: Photographs,
    config: FitConfig | None = None,
    *,
    after: Tick | None = None,
    extra_losses: ExtraLosses = (),
) -> Drive:
    """Fit a static scene to posed photographs (3D Gaussian Splatting, Kerbl et al. 2023).

    Args:
        photographs: from `gsjax.open_photographs`; all of them are fitted (see `select`).
        config: settings (default: those of `FitConfig`).
        after: a tick of an earlier fit of the same photographs, to continue from.
        extra_losses: custom losses `loss(scene, rendered, frame)`; see `gsjax.losses.extra`.

    Returns:
        ticks, whose `result` is the scene's `Gaussians`.

    Raises:
        ValueError: as for `gsjax.methods.fit.Fit.start`.
        DataError: a photograph cannot be read.
    """
    from gsjax.engine.fit.start import start_from  # matching is seldom needed, and slow to import

    frames = [photographs.frame(i) for i in range(photographs.num)]
    config, cloud = start_from(photographs, frames, FitConfig() if config is None else config)
    method = Fit(config, extra_losses)
    problem, run = method.start(frames, cloud, photographs.background)
    return drive(method, problem, run if after is None else _continued(after, method, run))


def deform(
    sequence: Sequence,
    config: DeformConfig | None = None,
    *,
    teacher: "TeacherChoice | str | None" = None,
    tools: Literal["leave-out", "draw"] = "leave-out",
    tool_values: tuple[int, ...] = (),
    first: int | None = None,
    gaussians: Gaussians | None = None,
    after: Tick | None = None,
    extra_losses: ExtraLosses = (),
) -> Drive:
    """Reconstruct a deforming scene seen by one camera (SurstSplat, GaussianClin).

    Args:
        sequence: from `gsjax.open_sequence`; trains on all frames of its first camera (see `select`).
            Depth is the camera's own, else from stereo matching with the second camera; without either, the
            scene starts within its visual hull if the camera goes around it, else as a plane.
        config: settings (default: `PRESETS["around"]` of `gsjax.methods.deform` for the hull of an object in
            pictures with transparency, else those of `DeformConfig`).
        teacher: source of the features learned alongside colours: "classes" of masks, "closed", a folder of
            feature files, "none", or a `TeacherChoice` with weights and masks (default: classes, if there are
            two or more among the pixels that count).
        tools: whether tools, recognised by the names of mask values, are left out ("leave-out") or drawn
            ("draw").
        tool_values: mask values that are tools, whatever their names.
        first: index of the frame of the canonical scene (default: with classes, the earliest frame that
            shows the most of them; else the first in which a pixel counts).
        gaussians: initial canonical scene (default: from depth).
        after: a tick of an earlier reconstruction of the same sequence, to continue from.
        extra_losses: custom losses `loss(scene, rendered, frame)`; see `gsjax.losses.extra`.

    Returns:
        ticks, whose `result` is a `DeformResult`: `at(time)` gives the `Gaussians` at a time, 0 to 1,
        and `query(text)` scores them.

    Raises:
        ValueError: as for `gsjax.methods.deform.Deform.start`; the teacher does not fit the recording; or
            `first` is not a training frame.
        DataError: a picture, depth or mask cannot be read.
        FileNotFoundError: weights or feature files do not exist.
    """
    from gsjax.engine.deform.start import start_from  # teachers are slow to import

    given = (sequence, teacher, tools, tool_values, first, gaussians)
    method, problem, run = start_from(config, extra_losses, *given)
    return drive(method, problem, run if after is None else _continued(after, method, run))


def distill(
    scene: Gaussians,
    photographs: Photographs,
    teacher: Teacher | TeacherChoice | str = "auto",
    config: DistillConfig | None = None,
    *,
    rasterize_mode: str = "classic",
    after: Tick | None = None,
) -> Drive:
    """Distil a semantic field, which answers queries in 3D, for a static scene (FD-3DGS).

    Args:
        scene: the Gaussians, from any fit; they are not changed.
        photographs: views of the scene, posed in its world; all of them are used (see `select`).
        teacher: features of the photographs' pixels: "classes" of their masks, "closed" for colours and
            outlines of masks, "auto" (classes where there are masks, else closed), a folder of feature files,
            a `TeacherChoice` with weights of CLIP or SAM, or a custom `Teacher` of the same photographs.
            Outputs of encoders and segmenters are cached in the user's cache folder.
        config: settings (default: `PRESETS["field"]` of `gsjax.methods.distill`, which takes a minute or two;
            `DistillConfig()` has the paper's).
        rasterize_mode: "antialiased" for a scene that was fitted that way.
        after: a tick of an earlier distillation of the same scene and photographs, to continue from.

    Returns:
        ticks, whose `result` is a `DistillResult`: `query(text)` scores the Gaussians, and
        `gsjax.write_field` writes it for `gsjax query` and `gsjax view`.

    Raises:
        ValueError: the teacher does not fit the photographs, or as for `gsjax.methods.distill.Distill.start`.
        DataError: a photograph or its masks cannot be read.
        FileNotFoundError: weights or feature files do not exist.
    """
    from gsjax.engine.teaching.teaching import teacher_for

    method = Distill(PRESETS["field"] if config is None else config)
    teacher, source = teacher_for(photographs, teacher)
    cameras = [photographs.camera(i) for i in range(photographs.num)]
    problem, run = method.start(scene, cameras, teacher, rasterize_mode, source=source)
    return drive(method, problem, run if after is None else _continued(after, method))


def parts(
    sequence: Sequence,
    config: PartsConfig | None = None,
    *,
    eval_cameras: Indices[int] = (),
    anchor: int | None = None,
    gaussians: Gaussians | None = None,
    segmenter: Segmenter | None = None,
    after: Tick | None = None,
    extra_losses: ExtraLosses = (),
) -> Drive:
    """Find the parts of a moving scene by their motion, without annotation (MotionSplicer).

    Args:
        sequence: from `gsjax.open_sequence`: synchronised cameras; or two states, which are two frames with
            depth, each seen by cameras of its own.
        config: settings (default: those of `PartsConfig`).
        eval_cameras: ids of the cameras to hold out.
        anchor: index of the canonical frame (default: the one that differs most from the others).
        gaussians: the scene at `anchor`, which must then be given too (default: it is fitted, which
            takes minutes).
        segmenter: divides a picture into pieces (default: one without weights).
        after: a tick of an earlier discovery in the same sequence, to continue from.
        extra_losses: custom losses `loss(scene, rendered, frame)`; see `gsjax.losses.extra`.

    Returns:
        ticks, whose `result` is a `PartsResult`: the scene with its parts, `weights`, `poses(t)`, `joints()`.

    Raises:
        ValueError: there are fewer than two cameras or frames, a camera to hold out does not exist, Gaussians
            are given without an anchor, two states have no depth, or nothing that moves is found.
        DataError: a picture cannot be read.
    """
    from gsjax.engine.parts.start import FIT, detect_motion, discover, has_two_states
    from gsjax.perception.segmenters import PieceSegmenter  # slow to import

    method = Parts(PartsConfig() if config is None else config, extra_losses)
    config, eval_cameras = method.config, tuple(eval_cameras)
    if unknown := [c for c in eval_cameras if c not in sequence.camera_ids]:
        raise ValueError(
            f"eval_cameras: expected ids of cameras, {list(sequence.camera_ids)}, found {unknown[0]}"
        )
    tracked = sequence.select(cameras=[c for c in sequence.camera_ids if c not in eval_cameras])
    if after is not None:
        problem = PartsProblem(tracked, at_once=has_two_states(tracked))
        return drive(method, problem, _continued(after, method), headroom=config.headroom)
    if gaussians is not None and anchor is None:
        raise ValueError("anchor: expected the frame that the given Gaussians show, found none; name it")
    chosen, moved = detect_motion(tracked, config, anchor)
    if gaussians is None:
        photographs = photographs_of(tracked.select(frames=[chosen.frame]))
        fitting = fit(photographs, FIT)
        for _ in fitting:
            pass
        gaussians, _ = prune(fitting.result, fitting.problem.frames, FIT)
    start = discover(tracked, gaussians, chosen, moved, config, segmenter or PieceSegmenter())
    problem, run = method.start(tracked, start)
    return drive(method, problem, run, headroom=config.headroom)


_TRAINED = {"exposures": "exposure", "twists": "refine_poses"}  # trained parameters: settings that add them


def _continued(after: Tick, method: Method, begun: Run | None = None) -> Run:
    """A copy of an earlier tick's run, because steps donate its arrays, and a tick may be continued twice.
    With other settings or losses, new losses are not compared with earlier ones. The run must have the
    trained parameters that a new run would have."""
    warn_of_lost_losses(after, getattr(method, "extra_losses", ()))
    run = after.run
    held = run.params, run.state
    if any(leaf.is_deleted() for leaf in jax.tree.leaves(held) if isinstance(leaf, jax.Array)):
        raise ValueError("after: expected a tick whose loop has taken no further step, found an earlier one")
    would = run.params if begun is None else begun.params
    for name, setting in _TRAINED.items():
        had, has = (getattr(one, name, None) is not None for one in (run.params, would))
        if had != has:
            raise ValueError(
                f"after: expected a run with {setting}={has}, as in the config, found one with "
                f"{setting}={had}; change the config, or begin a run of its own"
            )
    params, state = jax.tree.map(lambda leaf: leaf.copy() if isinstance(leaf, jax.Array) else leaf, held)
    run = run.having(params=params, state=state)
    return run if after.method == method else run.having(guard=None)
