"""One step of a deforming scene: deform, draw colours and features in one pass, compare, descend."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, UInt8

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
_DECAY = 1e-5  # of AdamW (papers/003, section 3)


class DeformingScene(eqx.Module):
    """What trains.

    Attributes:
        gaussians: canonical; features are semantic.
        field: what moves them; None in the warm-up, and of a static scene.
        twists: of each look's camera, a turn (radians) and a shift (radii of the scene), in the world's axes;
            None: cameras stand as given.
    """

    gaussians: Gaussians
    field: DeformationField | None = None
    twists: Float[Array, "looks 6"] | None = None

    def at(self, time: Float[Array, ""], moving: "Moving" = None) -> Gaussians:
        """The scene at a time, 0 to 1.

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
        """Features of some Gaussians at some times, as `at` has them.

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
"""What the field is asked about: nodes, some Gaussians, or all of them."""


class Batch(NamedTuple):
    """What a step is given.

    Attributes:
        image: RGB, 0 to 255.
        counts: which pixels count.
        depth: metres, 0 = unknown; None without.
        camera: one, viewmat [1,4,4] and K [1,3,3].
        time: 0 to 1.
        ids: which row of the codebook each of the teacher's pixels has, -1 for none; None without teacher.
        codebook: what the teacher says, in the scene's channels.
        moving: what the field is asked about.
        graph: of the look and those around it; None without.
        plan: to draw with.
        look: which row of the scene's twists the camera has; -1 of the one that stands as given. None where
            none is refined.
    """

    image: UInt8[Array, "1 height width 3"]
    counts: Bool[Array, "1 height width"]
    depth: Float[Array, "1 height width"] | None
    camera: Camera
    time: Float[Array, ""]
    ids: Int[Array, "h w"] | None
    codebook: Float[Array, "k channels"] | None
    moving: Moving
    graph: FrameGraph | None
    plan: Plan
    look: Int[Array, ""] | None = None


def deform_loss(config: DeformConfig, radius: float, extra_losses: ExtraLosses = ()) -> Callable:
    """`loss(scene, batch, *, step, key)`: L1 and D-SSIM of pixels that count (papers/003, eq. 13), depth,
    features against the teacher's (papers/004, eq. 10), the graph (`graph_loss`), and smoothness of the
    field's planes (4DGS).

    Args:
        config: its weights.
        radius: of the scene, in which depth counts and cameras move.
        extra_losses: given the `DeformingScene`, with its Gaussians where they are at this time, how it was
            drawn, and the picture; what does not count is drawn as photographed.
    """
    weights = config.weights

    def loss(scene: DeformingScene, batch: Batch, *, step: Any, key: Any):
        there, camera = scene.at(batch.time, batch.moving), _seen_from(scene, batch, radius)
        drawn = render(there, camera, batch.plan)
        target = batch.image.astype(drawn.colors.dtype) / 255
        # What does not count is as it was photographed: no slope, no edge.
        image = jnp.where(batch.counts[..., None], drawn.colors, target)
        counts = batch.counts.astype(image.dtype)
        area = jnp.maximum(counts.mean(), 1e-6)
        terms = {"rgb": photometric_loss(image, target, weights.dssim) / area}
        if weights.depth and batch.depth is not None:
            known = counts * (batch.depth > 0) * jax.lax.stop_gradient(drawn.alphas > 0.5)
            off = jnp.abs(drawn.depths - jnp.where(batch.depth > 0, batch.depth, 0.0))
            terms["depth"] = weights.depth * weighted_mean(off, known) / radius
        if weights.feature and batch.ids is not None and batch.codebook is not None:
            assert drawn.features is not None
            terms["feature"] = weights.feature * feature_loss(drawn.features[0], batch.codebook, batch.ids)
        if batch.graph is not None and scene.gaussians.features is not None:
            meanings = scene.features_at(batch.graph.times, batch.graph.nodes, batch.moving)
            terms |= graph_loss(meanings, batch.graph, config.graph)
        if scene.field is not None and isinstance(scene.field.encoding, HexPlane):
            space, time = scene.field.encoding.space, scene.field.encoding.time
            terms["planes"] = (
                weights.plane_tv * sum(plane_variation(planes) for planes in space)
                + weights.time_smoothness * sum(second_differences(planes) for planes in time)
                + weights.time_sparsity * sum(jnp.abs(planes - 1).mean() for planes in time)
            )
        mse = jnp.square(image - target).mean() / area
        meta = drawn.meta
        told = {"psnr": -10 * jnp.log10(mse), "overflow": meta.overflow.any(), "needed": meta.needed.max()}
        if extra_losses:
            now = eqx.tree_at(lambda s: s.gaussians, scene, there)
            rendered = drawn._replace(colors=image)
            told["extra"] = extra_terms(extra_losses, now, rendered, Frame(target, batch.depth, camera))
            return sum(terms.values()) + sum(told["extra"].values()), terms | told
        return sum(terms.values()), terms | told

    return loss


def _seen_from(scene: DeformingScene, batch: Batch, radius: float) -> Camera:
    """The look's camera, refined where cameras are."""
    if scene.twists is None or batch.look is None:
        return batch.camera
    twist = jnp.where(batch.look >= 0, scene.twists[batch.look], 0.0)
    return eqx.tree_at(lambda c: c.viewmat, batch.camera, perturbed(batch.camera.viewmat, twist, radius))


def feature_loss(
    drawn: Float[Array, "height width c"], codebook: Float[Array, "k c"], ids: Int[Array, "h w"]
) -> Float[Array, ""]:
    """|F_t - F_s|_1, a mean over channels and the teacher's pixels, to whose grid F_s is brought bilinearly
    (papers/004, eq. 10).

    Args:
        drawn: F_t, the scene's features.
        codebook: what the teacher may say.
        ids: which of it, of each of its pixels; -1 where it says nothing.
    """
    known = (ids >= 0).astype(drawn.dtype)
    off = jnp.abs(on_grid(drawn, ids.shape) - codebook[jnp.maximum(ids, 0)])
    return weighted_mean(off.mean(axis=-1), known)


def on_grid(drawn: Float[Array, "height width c"], shape: tuple[int, int]) -> Float[Array, "h w c"]:
    """Rendered features brought to the teacher's grid, bilinearly; to a coarser one by a triangle as wide as
    its cells are, or most pixels would learn nothing."""
    return jax.image.resize(drawn, (*shape, drawn.shape[2]), "linear", antialias=True)


def deform_step(config: DeformConfig, radius: float, extra_losses: ExtraLosses = ()) -> Step:
    """Adam or AdamW on a `DeformingScene`. `batch` is a `Batch`, `step` counts from 0.

    Args:
        config: of the reconstruction.
        radius: of the scene, the unit in which means move.
        extra_losses: of one's own (`gsjax.losses.extra`), beside those of the method.
    """
    named_losses(extra_losses)
    total = max(1, config.warmup + config.iterations)
    if config.schedule == "cosine":
        fall = optax.cosine_decay_schedule(1.0, total)
    else:
        fall = optax.exponential_decay(1.0, total, _FINAL_RATE)
    told = vars(config.rates)
    loss = deform_loss(config, radius, extra_losses)

    def of(scene: DeformingScene) -> Step:
        rates = {name: told[name] for name in ("quats", "log_scales", "logit_opacities", "sh0")}
        rates["means"] = told["means"] * radius
        if scene.gaussians.features is not None:
            rates["features"] = told["features"]
        if scene.field is not None:
            inner = {"hexplane": ("space", "time"), "mlp": (), "voxels": ("grid",)}
            rates |= dict.fromkeys(inner[scene.field.config.kind], told["planes"])
            rates["layers"] = told["layers"]
        if scene.twists is not None:
            rates["twists"] = told["twists"]
        made = 0 if scene.field is None else config.warmup  # by the optimizer before this one
        falling = {name: _falling(rate, fall, made) for name, rate in rates.items()}
        decay = _DECAY if config.optimizer == "adamw" else 0.0
        return gradient_step(loss, per_field_adam(falling, decay=decay))

    def update(params: DeformingScene, state, batch: Batch, *, step, key):
        return of(params).update(params, state, batch, step=step, key=key)

    return Step(lambda params: of(params).init(params), update)


def _falling(rate: float, fall: Callable, made: int) -> Callable:
    return lambda count: rate * fall(count + made)
