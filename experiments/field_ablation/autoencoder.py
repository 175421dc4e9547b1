"""Features compressed by an autoencoder of the scene, as in LangSplat (Qin et al. 2024, section 3.3):
Gaussians carry codes, and a decoder turns rendered codes into features."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

STEPS, RATE, HIDDEN = 1_500, 1e-3, 128


class Autoencoder(NamedTuple):
    """Networks with one hidden layer; codes have length 1, as LangSplat's."""

    encoder: eqx.nn.MLP
    decoder: eqx.nn.MLP

    def encode(self, features: Float[Array, "n d"]) -> Float[Array, "n c"]:
        codes = jax.vmap(self.encoder)(features)
        return codes / jnp.maximum(jnp.linalg.norm(codes, axis=-1, keepdims=True), 1e-9)

    def decode(self, codes: Float[Array, "n c"]) -> Float[Array, "n d"]:
        return jax.vmap(self.decoder)(
            codes / jnp.maximum(jnp.linalg.norm(codes, axis=-1, keepdims=True), 1e-9)
        )


def trained(features: Float[np.ndarray, "n d"], size: int, seed: int) -> tuple[Autoencoder, float]:
    """An autoencoder of a scene's embeddings, trained on squared difference and angle; and the final 1 -
    cosine."""
    first, second = jax.random.split(jax.random.key(seed))
    dimension, given = features.shape[1], jnp.asarray(features)
    model = Autoencoder(
        eqx.nn.MLP(dimension, size, HIDDEN, 1, key=first), eqx.nn.MLP(size, dimension, HIDDEN, 1, key=second)
    )
    weights, rest = eqx.partition(model, eqx.is_array)
    optimizer = optax.adam(RATE)

    def loss(weights):
        model = eqx.combine(weights, rest)
        found = model.decode(model.encode(given))
        angle = 1 - optax.cosine_similarity(found, given).mean()
        return jnp.mean((found - given) ** 2) + angle, angle

    def step(carry, _):
        weights, state = carry
        (_, angle), slope = jax.value_and_grad(loss, has_aux=True)(weights)
        updates, state = optimizer.update(slope, state)
        return (optax.apply_updates(weights, updates), state), angle

    (weights, _), angles = jax.jit(
        lambda start: jax.lax.scan(step, start, None, STEPS),
    )((weights, optimizer.init(weights)))
    return eqx.combine(weights, rest), float(angles[-1])
