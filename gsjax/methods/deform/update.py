"""One optimisation step of a deforming scene: deform, render colours and features in one pass, compare."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from gsjax.geometry.cameras import Camera, perturbed
from gsjax.geometry.rotations import multiply_quats, normalize_quats, quats_to_matrices
from gsjax.losses.extra import ExtraLosses, extra_terms, named_losses
from gsjax.losses.photometric import photometric_loss, weighted_mean
from gsjax.losses.regularization import local_strain, plane_variation, pseudo_huber, second_differences
from gsjax.methods.deform.config import DeformConfig
from gsjax.methods.deform.graph import FrameGraph, graph_loss
from gsjax.optim.step import Step, gradient_step, per_field_adam
from gsjax.rasterize.plan import Plan
from gsjax.scene.deformation import (
    DeformationField,
    Nodes,
    Offsets,
    blended_offsets,
    deform,
    deform_by_nodes,
    deform_rows,
    features_at,
    node_offsets,
)
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import render
from gsjax.scene.time_encodings import HexPlane

LOSSES = ("rgb", "depth", "feature", "node", "structure", "spatial", "temporal", "planes", "rigid")
"""Names of the losses in `info`, which are recorded during a run."""
_FINAL_RATE = 0.1
_TOLERANCE = 0.1  # strain above which the penalty is no longer quadratic
_WEIGHT_DECAY = 1e-5  # of AdamW (SurstSplat, section 3)


class DeformingScene(eqx.Module):
    """The trained parameters.

    Attributes:
        gaussians: canonical Gaussians, whose features are semantic.
        field: deformation field; None in the warm-up, and for a static scene.
        twists: rotation (radians) and translation (radii of the scene) of each frame's camera, along the
            world's axes; None if poses are not refined.
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
        """Features of some Gaussians at some times, equal to those of `at`.

        Args:
            times: 0 to 1.
            rows: rows of the Gaussians.
            moving: as for `at`.
        """
        if moving is None or isinstance(moving, Nodes):
            return features_at(self.gaussians, self.field, times, rows, moving)
        found = features_at(self.gaussians, self.field, times, rows)
        still = features_at(self.gaussians, None, times, rows)
        return jnp.where(jnp.isin(rows, moving)[:, None], found, still)


class SceneAtTime(NamedTuple):
    """The scene at one moment, as passed to extra losses.

    Attributes:
        gaussians: the Gaussians as they were rendered, deformed to this time.
        canonical: what is trained: `canonical.gaussians` before they were deformed, and `canonical.field`,
            which is None in the warm-up.
        moving: where the field is evaluated.
    """

    gaussians: Gaussians
    canonical: DeformingScene
    moving: "Moving" = None

    def at(self, time: Float[Array, ""]) -> Gaussians:
        """The Gaussians as they are rendered at a time, 0 to 1."""
        return self.canonical.at(time, self.moving)


Moving = Nodes | Int[Array, "M"] | None
"""Where the field is evaluated: at nodes, at some Gaussians, or at all of them."""


class Batch(NamedTuple):
    """The input of a step.

    Attributes:
        frame: frame of one camera, with a mask and a time.
        index: position of the frame in the recording.
        progress: share of the steps that are done, 0 to 1.
        view: row of the camera's twist; -1 for a camera that is not refined. None if no poses are.
        ids: row of the codebook for each of the teacher's pixels, -1 for none; None without a teacher.
        codebook: the teacher's features, in the scene's channels.
        moving: where the field is evaluated.
        graph: graph of the frame and those around it; None without.
        radius: radius of the scene, the unit of learning rates and of the depth error.
        plan: plan for rendering.
        background: RGB behind the scene; None is black.
    """

    frame: Frame
    index: Int[Array, ""] | int
    progress: Float[Array, ""] | float
    view: Int[Array, ""] | None
    ids: Int[Array, "h w"] | None
    codebook: Float[Array, "k channels"] | None
    moving: Moving
    graph: FrameGraph | None
    radius: Float[Array, ""] | float
    plan: Plan
    background: Float[Array, "1 3"] | None = None


def deform_loss(config: DeformConfig, extra_losses: ExtraLosses = ()) -> Callable:
    """`loss(scene, batch, *, step, key)`: L1 and D-SSIM of the pixels that count (SurstSplat, eq. 13), depth,
    features (GaussianClin, eq. 10), the graph (`graph_loss`), and smoothness of the field's planes (4DGS).

    Args:
        config: configuration, with the weights.
        extra_losses: custom losses of the `SceneAtTime`, the rendered view, in which pixels
            that do not count are those of the photograph, and the frame.
    """
    weights = config.weights

    def loss(scene: DeformingScene, batch: Batch, *, step: Any, key: Any):
        frame, radius = batch.frame, batch.radius
        assert frame.masks is not None
        assert frame.time is not None
        time, camera, terms = jnp.asarray(frame.time), _refined_camera(scene, batch), {}
        if scene.field is not None and isinstance(batch.moving, Nodes):
            offsets = node_offsets(scene.gaussians, scene.field, time, batch.moving)
            there = deform(scene.gaussians, blended_offsets(offsets, batch.moving))
            if weights.rigidity:
                terms["rigid"] = weights.rigidity * _strain(scene.gaussians, offsets, batch.moving)
        else:
            there = scene.at(time, batch.moving)
        drawn = render(there, camera, batch.plan, backgrounds=batch.background)
        target = frame.colors
        # Pixels that do not count are the photograph's: they add neither a gradient nor an edge.
        image = jnp.where(frame.masks[..., None], drawn.colors, target)
        counts = frame.masks.astype(image.dtype)
        area = jnp.maximum(counts.mean(), 1e-6)
        terms["rgb"] = photometric_loss(image, target, weights.dssim) / area
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
        mse = jnp.square(image - target).mean() / counts.mean()  # NaN if no pixel counts, rather than 0
        meta = drawn.meta
        info = {"psnr": -10 * jnp.log10(mse), "overflow": meta.overflow.any(), "needed": meta.needed.max()}
        if extra_losses:
            now = SceneAtTime(there, scene, batch.moving)
            rendered = drawn._replace(colors=image)
            seen = Frame(target, frame.depths, camera, frame.masks, frame.time)
            context = {"index": batch.index, "progress": batch.progress}
            info["extra"] = extra_terms(extra_losses, now, rendered, seen, **context)
            return sum(terms.values()) + sum(info["extra"].values()), terms | info
        return sum(terms.values()), terms | info

    return loss


def _strain(gaussians: Gaussians, offsets: Offsets, nodes: Nodes) -> Float[Array, ""]:
    """How far nodes and their neighbours are from moving rigidly and growing alike."""
    rest = jax.tree.map(lambda leaf: leaf[nodes.rows], gaussians)
    moved, neighbors = deform(rest, offsets), nodes.indices[nodes.rows]
    back = normalize_quats(rest.quats) * jnp.array([1.0, -1.0, -1.0, -1.0])
    turns = quats_to_matrices(multiply_quats(moved.quats, back))
    strains = local_strain(rest.means, moved.means, turns, neighbors)
    growths = jnp.square(offsets.log_scales[neighbors] - offsets.log_scales[:, None]).sum(-1)
    return (pseudo_huber(strains, _TOLERANCE) + pseudo_huber(growths, _TOLERANCE)).mean()


def _refined_camera(scene: DeformingScene, batch: Batch) -> Camera:
    """The camera of the frame, refined if poses are."""
    camera = batch.frame.cameras
    if scene.twists is None or batch.view is None:
        return camera
    twist = jnp.where(batch.view >= 0, scene.twists[batch.view], 0.0)
    return eqx.tree_at(lambda c: c.viewmat, camera, perturbed(camera.viewmat, twist, batch.radius))


def feature_loss(
    drawn: Float[Array, "height width c"], codebook: Float[Array, "k c"], ids: Int[Array, "h w"]
) -> Float[Array, ""]:
    """Mean of |F_t - F_s| over channels and the teacher's pixels, with F_s resized to the teacher's grid
    (GaussianClin, eq. 10).

    Args:
        drawn: F_s, the rendered features.
        codebook: the teacher's features.
        ids: row of the codebook of each of the teacher's pixels; -1 for none.
    """
    known = (ids >= 0).astype(drawn.dtype)
    off = jnp.abs(on_grid(drawn, ids.shape) - codebook[jnp.maximum(ids, 0)])
    return weighted_mean(off.mean(axis=-1), known)


def on_grid(drawn: Float[Array, "height width c"], shape: tuple[int, int]) -> Float[Array, "h w c"]:
    """Rendered features resized bilinearly to the teacher's grid; antialiased for a coarser one, as most
    pixels would get no gradient otherwise."""
    return jax.image.resize(drawn, (*shape, drawn.shape[2]), "linear", antialias=True)


def deform_step(config: DeformConfig, extra_losses: ExtraLosses = ()) -> Step:
    """A step of Adam or AdamW on a `DeformingScene`.

    `batch` is a `Batch`; `key` and `step` are unused, as the rates decay with the optimizer's own count of
    steps. `info` has `psnr` and each loss by name in addition to what every step reports.

    Args:
        config: configuration of the reconstruction.
        extra_losses: custom losses (`gsjax.losses.extra`), added to those of the method.
    """
    named_losses(extra_losses)
    total = max(1, config.warmup + config.iterations)
    if config.schedule == "cosine":
        decay = optax.cosine_decay_schedule(1.0, total)
    else:
        decay = optax.exponential_decay(1.0, total, _FINAL_RATE)
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
        before = 0 if scene.field is None else config.warmup  # steps of the warm-up's own optimizer
        schedules = {
            name: lambda count, rate=rate: rate * decay(count + before) for name, rate in rates.items()
        }
        weight_decay = _WEIGHT_DECAY if config.optimizer == "adamw" else 0.0
        return gradient_step(loss, per_field_adam(schedules, decay=weight_decay))

    def update(params: DeformingScene, state, batch: Batch, *, step, key):
        return of(params, batch.radius).update(params, state, batch, step=step, key=key)

    return Step(lambda params: of(params, 1.0).init(params), update)
