"""Behaviour cloning: the inputs of the policies, their networks, and their training."""

from functools import cache
from pathlib import Path
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Key

from experiments.policies.sight import described

Seen = Literal["tracked Gaussians", "images", "true poses"]
CHUNK = 4  # actions predicted at a time, and carried out before the next observation
UPDATES, BATCH, RATE = 4000, 32, 1e-3
SHIFT = 3  # largest shift of training images, pixels


class Keypoints(eqx.Module):
    """A small convolutional encoder whose channels each point at one place (spatial softmax).

    After Finn et al., Deep spatial autoencoders for visuomotor learning, ICRA 2016. Not pretrained.
    """

    layers: list[eqx.nn.Conv2d]

    def __init__(self, key: Key[Array, ""]):
        sizes = [(3, 16, 5, 2), (16, 32, 3, 2), (32, 32, 3, 1)]
        keys = jax.random.split(key, len(sizes))
        self.layers = [
            eqx.nn.Conv2d(*size[:3], stride=size[3], padding=1, key=k)
            for size, k in zip(sizes, keys, strict=True)
        ]

    def __call__(self, image: Float[Array, "h w 3"]) -> Float[Array, "64"]:
        x = jnp.moveaxis(image, -1, 0)
        for layer in self.layers[:-1]:
            x = jax.nn.relu(layer(x))
        x = self.layers[-1](x)
        share = jax.nn.softmax(x.reshape(len(x), -1), axis=1).reshape(x.shape)
        rows, columns = (jnp.linspace(-1, 1, n) for n in x.shape[1:])
        return jnp.concatenate([(share.sum(2) * rows).sum(1), (share.sum(1) * columns).sum(1)])


class Policy(eqx.Module):
    """Proprioception and either an object's pose or images -> the next CHUNK actions."""

    encoders: list[Keypoints]
    mean: Float[Array, "d"]
    scale: Float[Array, "d"]
    head: eqx.nn.MLP

    def __init__(self, vectors: Float[np.ndarray, "n d"], cameras: int, key: Key[Array, ""]):
        *keys, last = jax.random.split(key, cameras + 1)
        self.encoders = [Keypoints(k) for k in keys]
        self.mean, self.scale = jnp.asarray(vectors.mean(0)), jnp.asarray(vectors.std(0) + 1e-2)
        size = vectors.shape[1] + 64 * cameras
        self.head = eqx.nn.MLP(size, 4 * CHUNK, 256, 2, key=last)

    def __call__(self, vector: Float[Array, "d"], images: Float[Array, "c h w 3"]) -> Float[Array, "chunk 4"]:
        parts = [(vector - jax.lax.stop_gradient(self.mean)) / jax.lax.stop_gradient(self.scale)]
        parts += [encoder(image) for encoder, image in zip(self.encoders, images, strict=False)]
        return self.head(jnp.concatenate(parts)).reshape(CHUNK, 4)


def vector_of(seen: Seen, felt: np.ndarray, pose: np.ndarray, first: np.ndarray) -> np.ndarray:
    """A policy's input beside images; policies that see images get no pose."""
    return felt if seen == "images" else np.concatenate([felt, described(pose, first, felt)])


@cache
def demonstrations(folder: Path, seen: Seen) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All steps of all demonstrations: vectors [N, D], images [N, C, h, w, 3], next actions [N, CHUNK, 4].

    Raises:
        FileNotFoundError: none are there.
    """
    vectors, images, chunks = [], [], []
    for path in sorted(folder.glob("demo_*.npz")):
        with np.load(path) as demo:
            poses = demo["tracked" if seen == "tracked Gaussians" else "true"]
            felt, actions = demo["felt"], demo["action"].astype(np.float32)
            vectors += [vector_of(seen, f, pose, poses[0]) for f, pose in zip(felt, poses, strict=True)]
            images.append(demo["images"])
            ahead = np.minimum(np.arange(len(actions))[:, None] + np.arange(CHUNK), len(actions) - 1)
            chunks.append(actions[ahead])
    if not vectors:
        raise FileNotFoundError(
            f"{folder}: no demonstrations; make them by demonstrations.py beside this file"
        )
    return np.stack(vectors).astype(np.float32), np.concatenate(images), np.concatenate(chunks)


def _loss(policy: Policy, vectors: Array, images: Array, chunks: Array) -> Array:
    return jnp.abs(jax.vmap(policy)(vectors, images) - chunks).mean()


@cache
def trained(folder: Path, seen: Seen, seed: int) -> Policy:
    """A policy after `UPDATES` of AdamW on batches of `BATCH` steps, with the L1 loss."""
    vectors, images, chunks = demonstrations(folder, seen)
    cameras = images.shape[1] if seen == "images" else 0
    policy = Policy(vectors, cameras, jax.random.key(seed))
    optimizer = optax.adamw(optax.warmup_cosine_decay_schedule(0.0, RATE, 100, UPDATES), weight_decay=1e-4)
    state = optimizer.init(eqx.filter(policy, eqx.is_array))

    @eqx.filter_jit
    def update(policy, state, *batch):
        grads = eqx.filter_grad(_loss)(policy, *batch)
        change, state = optimizer.update(grads, state, eqx.filter(policy, eqx.is_array))
        return eqx.apply_updates(policy, change), state

    rng = np.random.default_rng(seed)
    for _ in range(UPDATES):
        rows = rng.integers(len(vectors), size=BATCH)
        batch = images[rows, :cameras].astype(np.float32) / 255
        if cameras:
            batch = np.stack([np.roll(b, rng.integers(-SHIFT, SHIFT + 1, 2), (1, 2)) for b in batch])
        policy, state = update(policy, state, vectors[rows], batch, chunks[rows])
    return policy


@eqx.filter_jit
def act(
    policy: Policy, vector: Float[Array, "d"], images: Float[Array, "c h w 3"]
) -> Float[Array, "chunk 4"]:
    return policy(vector, images)
