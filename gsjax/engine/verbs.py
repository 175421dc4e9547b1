"""The five verbs: `gsjax.fit`, `track`, `parts`, `distill` and `deform`.

Data goes in as it was opened. Each yields a `Tick` a step (a frame, for `track`), and what the user came for
is its `result`:

    for now in gsjax.fit(photographs, gsjax.FitConfig(steps=2000)):
        print(now.step, now.info["psnr"], now.seconds)
    now.result
"""

from collections.abc import Sequence as Indices

import jax

from gsjax.data.photographs import Photographs, photographs_of
from gsjax.data.sequence import Sequence
from gsjax.engine.drive import Drive, Tick, drive
from gsjax.engine.parts.start import FIT, without_needless
from gsjax.losses.extra import ExtraLosses
from gsjax.methods.fit import Fit, FitConfig
from gsjax.methods.parts import Parts, PartsConfig, begin, choose_anchor, moved_pixels
from gsjax.methods.parts.pictures import problem_of
from gsjax.methods.protocols import Segmenter
from gsjax.scene.gaussians import Gaussians


def fit(
    photographs: Photographs,
    config: FitConfig | None = None,
    *,
    after: Tick | None = None,
    extra_losses: ExtraLosses = (),
) -> Drive:
    """Fit a static scene to posed photographs (3D Gaussian Splatting, Kerbl et al. 2023).

    Args:
        photographs: from `gsjax.open_photographs`; all of them are fitted (`select` chooses).
        config: how; the default settings unless given.
        after: a tick of an earlier fit of the same photographs, to go on from.
        extra_losses: custom losses `loss(scene, rendered, frame)`; see `gsjax.losses.extra`.

    Returns:
        ticks, whose `result` are the scene's `Gaussians`.

    Raises:
        ValueError: as `gsjax.methods.fit.Fit.start`.
        DataError: a photograph cannot be read.
    """
    from gsjax.engine.fit.start import start_from  # matching is seldom needed, and slow to import

    frames = [photographs.frame(i) for i in range(photographs.num)]
    config, cloud = start_from(photographs, frames, FitConfig() if config is None else config)
    method = Fit(config, extra_losses)
    problem, run = method.start(frames, cloud, photographs.background)
    return drive(method, problem, run if after is None else after.run)


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
        sequence: from `gsjax.open_sequence`, of synchronised cameras.
        config: how; the default settings unless given.
        eval_cameras: ids of cameras that are held out.
        anchor: the canonical frame; by default the one that differs most from the others.
        gaussians: the scene at `anchor`, which must then be given; by default it is fitted here, which takes
            minutes.
        segmenter: finds what belongs together in a picture; by default one that needs no weights.
        after: a tick of an earlier discovery in the same sequence, to go on from.
        extra_losses: custom losses `loss(scene, rendered, frame)`; see `gsjax.losses.extra`.

    Returns:
        ticks, whose `result` is a `PartsResult`: the scene with its parts, `weights`, `poses(t)`, `joints()`.

    Raises:
        ValueError: there are fewer than two cameras or frames, Gaussians are given without an anchor, or
            nothing is found that moves.
        DataError: a picture cannot be read.
    """
    from gsjax.perception.segmenters import PieceSegmenter  # slow to import

    method = Parts(PartsConfig() if config is None else config, extra_losses)
    config, eval_cameras = method.config, tuple(eval_cameras)
    tracked = sequence.select(cameras=[c for c in sequence.camera_ids if c not in eval_cameras])
    if after is not None:
        return drive(method, problem_of(tracked), after.run, headroom=config.headroom)
    if gaussians is not None and anchor is None:
        raise ValueError("anchor: expected the frame that the given Gaussians show, found none; name it")
    chosen = choose_anchor(tracked.image, tracked.num_frames, tracked.num_cameras, anchor)
    discover = config.discover
    moved = moved_pixels(
        tracked.image, chosen, tracked.num_cameras, frames=discover.frames, threshold=discover.threshold
    )
    if gaussians is None:
        photographs = photographs_of(tracked.select(frames=[chosen.frame]))
        fitting = fit(photographs, FIT)
        for _ in fitting:
            pass
        gaussians = without_needless(photographs, fitting.result, FIT)
    segmenter, key = segmenter or PieceSegmenter(), jax.random.key(config.seed)
    start = begin(tracked, gaussians, chosen, moved, config, segmenter, key)
    problem, run = method.start(tracked, start)
    return drive(method, problem, run, headroom=config.headroom)
