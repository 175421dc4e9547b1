"""The five verbs: `gsjax.fit`, `track`, `parts`, `distill` and `deform`.

Data goes in as it was opened. Each yields a `Tick` a step (a frame, for `track`), and what the user came for
is its `result`:

    for now in gsjax.fit(photographs, gsjax.FitConfig(steps=2000)):
        print(now.step, now.info["psnr"], now.seconds)
    now.result
"""

from gsjax.data.photographs import Photographs
from gsjax.engine.drive import Drive, Tick, drive
from gsjax.losses.extra import ExtraLosses
from gsjax.methods.fit import Fit, FitConfig


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
