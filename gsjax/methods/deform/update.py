"""One step of a deforming scene: deform, draw colours and features in one pass, compare, descend."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from gsjax.geometry.cameras import Camera, perturbed
from gsjax.losses.extra import ExtraLosses, extra_terms, named_losses
from gsjax.losses.photometric import photometric_loss, weighted_mean
from gsjax.losses.regularization import plane_variation, second_differences
from gsjax.methods.deform.config import DeformConfig
from gsjax.methods.deform.graph import FrameGraph, graph_loss
from gsjax.optim.step import Step, gradient_step, per_field_adam
from gsjax.rasterize.plan import Plan
from gsjax.scene.deformation import DeformationField, Nodes, deform_by_nodes, deform_rows, features_at
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import render
from gsjax.scene.time_encodings import HexPlane

_FINAL_RATE = 0.1
_DECAY = 1e-5  # of AdamW (SurstSplat, section 3)


class DeformingScene(eqx.Module):
    """What trains.

    Attributes:
        gaussians: canonical; features are semantic.
        field: what moves them; None in the warm-up, and of a static scene.
        twists: of each frame's camera, a turn (radians) and a shift (radii of the scene), in the world's
            axes; None: cameras stand as given.
    """

    gaussians: Gaussians
    field: DeformationField | None = None
    twists: Float[Array, "frames 6"] | None = None

    def at(self, time: Float[Array, ""], moving: "Moving" = None) -> Gaussians:
        """The scene at a time.

        Args:
            time: 0 to 1.
            moving: nodes, as for `deform_by_nodes`, or rows, as for `deform_rows`.
        """
        if self.field is None:
            return self.gaussians
        if isinstance(moving, Nodes):
            return deform_by_nodes(self.gaussians, self.field, time, moving)
        return deform_rows(self.gaussians, self.field, time, moving)

    def features_at(
        self, times: Float[Array, "T"], rows: Int[Array, "n"], moving: "Moving" = None
    ) -> Float[Array, "T n c"]:
        """Features of some Gaussians at some times, as in `at`.

        Args:
            times: 0 to 1.
            rows: of the Gaussians.
            moving: which of them move, as for `at`.
        """
        if moving is None or isinstance(moving, Nodes):
            return features_at(self.gaussians, self.field, times, rows, moving)
        found = features_at(self.gaussians, self.field, times, rows)
        still = features_at(self.gaussians, None, times, rows)
        return jnp.where(jnp.isin(rows, moving)[:, None], found, still)


Moving = Nodes | Int[Array, "M"] | None
"""Where the field is evaluated: at nodes, at some Gaussians, or at all of them."""


class Batch(NamedTuple):
    """What a step is given.

    Attributes:
        frame: of one camera, RGB in bytes, with the mask of the pixels that count and its time.
        view: row of the scene's twists that is the camera's; -1 for the camera that stands as given. None
            where none is refined.
        ids: row of the codebook of each of the teacher's pixels, -1 for none; None without a teacher.
        codebook: the teacher's features, in the scene's channels.
        moving: where the field is evaluated.
        graph: of the frame and those around it; None without.
        radius: of the scene, the unit in which means and cameras move and depth counts.
        plan: to draw with.
    """

    frame: Frame
    view: Int[Array, ""] | None
    ids: Int[Array, "h w"] | None
    codebook: Float[Array, "k channels"] | None
    moving: Moving
    graph: FrameGraph | None
    radius: Float[Array, ""] | float
    plan: Plan


def deform_loss(config: DeformConfig, extra_losses: ExtraLosses = ()) -> Callable:
    """`loss(scene, batch, *, step, key)`: L1 and D-SSIM of the pixels that count (SurstSplat, eq. 13), depth,
    features against the teacher's (GaussianClin, eq. 10), the graph (`graph_loss`), and smoothness of the
    field's planes (4DGS).

    Args:
        config: its weights.
        extra_losses: given the `DeformingScene`, with its Gaussians where they are at this time, how it was
            drawn, and the frame; what does not count is drawn as photographed.
    """
    weights = config.weights

    def loss(scene: DeformingScene, batch: Batch, *, step: Any, key: Any):
        frame, radius = batch.frame, batch.radius
        assert frame.masks is not None
        assert frame.time is not None
        there, camera = scene.at(jnp.asarray(frame.time), batch.moving), _refined_camera(scene, batch)
        drawn = render(there, camera, batch.plan)
        target = frame.colors
        # What does not count is as it was photographed: no slope, no edge.
        image = jnp.where(frame.masks[..., None], drawn.colors, target)
        counts = frame.masks.astype(image.dtype)
        area = jnp.maximum(counts.mean(), 1e-6)
        terms = {"rgb": photometric_loss(image, target, weights.dssim) / area}
        if weights.depth and frame.depths is not None:
            known = counts * (frame.depths > 0) * jax.lax.stop_gradient(drawn.alphas > 0.5)
            off = jnp.abs(drawn.depths - jnp.where(frame.depths > 0, frame.depths, 0.0))
            terms["depth"] = weights.depth * weighted_mean(off, known) / radius
        if weights.feature and batch.ids is not None and batch.codebook is not None:
            assert drawn.features is not None
            terms["feature"] = weights.feature * feature_loss(drawn.features[0], batch.codebook, batch.ids)
        if batch.graph is not None and scene.gaussians.features is not None:
            features = scene.features_at(batch.graph.times, batch.graph.nodes, batch.moving)
            terms |= graph_loss(features, batch.graph, config.graph)
        if scene.field is not None and isinstance(scene.field.encoding, HexPlane):
            space, time = scene.field.encoding.space, scene.field.encoding.time
            terms["planes"] = (
                weights.plane_tv * sum(plane_variation(planes) for planes in space)
                + weights.time_smoothness * sum(second_differences(planes) for planes in time)
                + weights.time_sparsity * sum(jnp.abs(planes - 1).mean() for planes in time)
            )
        mse = jnp.square(image - target).mean() / area
        meta = drawn.meta
        info = {"psnr": -10 * jnp.log10(mse), "overflow": meta.overflow.any(), "needed": meta.needed.max()}
        if extra_losses:
            now = eqx.tree_at(lambda s: s.gaussians, scene, there)
            rendered = drawn._replace(colors=image)
            seen = Frame(target, frame.depths, camera, frame.masks, frame.time)
            info["extra"] = extra_terms(extra_losses, now, rendered, seen)
            return sum(terms.values()) + sum(info["extra"].values()), terms | info
        return sum(terms.values()), terms | info

    return loss


def _refined_camera(scene: DeformingScene, batch: Batch) -> Camera:
    """The frame's camera, refined where cameras are."""
    camera = batch.frame.cameras
    if scene.twists is None or batch.view is None:
        return camera
    twist = jnp.where(batch.view >= 0, scene.twists[batch.view], 0.0)
    return eqx.tree_at(lambda c: c.viewmat, camera, perturbed(camera.viewmat, twist, batch.radius))


def feature_loss(
    drawn: Float[Array, "height width c"], codebook: Float[Array, "k c"], ids: Int[Array, "h w"]
) -> Float[Array, ""]:
    """|F_t - F_s|_1, a mean over channels and the teacher's pixels, to whose grid F_s is brought bilinearly
    (GaussianClin, eq. 10).

    Args:
        drawn: F_t, the scene's features.
        codebook: the teacher's features.
        ids: row of the codebook of each of the teacher's pixels; -1 where it has none.
    """
    known = (ids >= 0).astype(drawn.dtype)
    off = jnp.abs(on_grid(drawn, ids.shape) - codebook[jnp.maximum(ids, 0)])
    return weighted_mean(off.mean(axis=-1), known)


def on_grid(drawn: Float[Array, "height width c"], shape: tuple[int, int]) -> Float[Array, "h w c"]:
    """Rendered features brought to the teacher's grid, bilinearly; to a coarser one by a triangle as wide as
    its cells are, or most pixels would learn nothing."""
    return jax.image.resize(drawn, (*shape, drawn.shape[2]), "linear", antialias=True)


def deform_step(config: DeformConfig, extra_losses: ExtraLosses = ()) -> Step:
    """Adam or AdamW on a `DeformingScene`.

    `batch` is a `Batch`; `key` and `step` are not used, for rates fall with the optimizer's own count of
    steps. `info` has `psnr` and each loss by its name beside what every step reports.

    Args:
        config: of the reconstruction.
        extra_losses: custom losses (`gsjax.losses.extra`) beside those of the method.
    """
    named_losses(extra_losses)
    total = max(1, config.warmup + config.iterations)
    if config.schedule == "cosine":
        fall = optax.cosine_decay_schedule(1.0, total)
    else:
        fall = optax.exponential_decay(1.0, total, _FINAL_RATE)
    settings = vars(config.rates)
    loss = deform_loss(config, extra_losses)

    def of(scene: DeformingScene, radius: Float[Array, ""] | float) -> Step:
        rates: dict[str, Any] = {
            name: settings[name] for name in ("quats", "log_scales", "logit_opacities", "sh0")
        }
        rates["means"] = settings["means"] * radius
        if scene.gaussians.features is not None:
            rates["features"] = settings["features"]
        if scene.field is not None:
            inner = {"hexplane": ("space", "time"), "mlp": (), "voxels": ("grid",)}
            rates |= dict.fromkeys(inner[scene.field.config.kind], settings["planes"])
            rates["layers"] = settings["layers"]
        if scene.twists is not None:
            rates["twists"] = settings["twists"]
        made = 0 if scene.field is None else config.warmup  # by the optimizer before this one
        falling = {name: _falling(rate, fall, made) for name, rate in rates.items()}
        decay = _DECAY if config.optimizer == "adamw" else 0.0
        return gradient_step(loss, per_field_adam(falling, decay=decay))

    def update(params: DeformingScene, state, batch: Batch, *, step, key):
        return of(params, batch.radius).update(params, state, batch, step=step, key=key)

    return Step(lambda params: of(params, 1.0).init(params), update)


def _falling(rate: Any, fall: Callable, made: int) -> Callable:
    return lambda count: rate * fall(count + made)
