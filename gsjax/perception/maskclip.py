"""MaskCLIP (Zhou et al., "Extract Free Dense Labels from CLIP", ECCV 2022): a CLIP vector for each patch, in
the space of its text, without training.

CLIP's last layer pools the values of all patches into one token; these values describe the patches. So they
replace the output of the layer, as in the code of F3RM and FeatUp: the values pass through the layer's own
output projection, the final norm and the projection to the text space, with no residual and no MLP.

Needs the extra `foundation`; weights are those of CLIP, local files.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Num

from gsjax.perception.clip import ClipEncoder
from gsjax.perception.pictures import in_patches


@dataclass(frozen=True)
class MaskClipEncoder:
    """Unit vectors of patches and of text, by a model that `gsjax.perception.clip.load_clip` reads.

    Attributes:
        clip: the model, also used for text.
        resolution: shorter side of the model's input, pixels, rounded to whole patches. Larger values resolve
            more, as far as the interpolated position embeddings allow.
    """

    clip: ClipEncoder
    resolution: int = 448

    def __post_init__(self):
        if self.clip.is_siglip:  # it pools with a learned query, not with a token among the patches
            raise ValueError(
                "vectors of patches: expected the weights of CLIP, found those of SigLIP, which has vectors "
                "of whole pictures only"
            )

    @property
    def min_score(self) -> float:
        """A query whose best cosine is lower matches nothing in view; the same as for `ClipEncoder`."""
        return self.clip.min_score

    def __call__(self, images: Num[np.ndarray, "C H W 3"]) -> Float[np.ndarray, "C h w D"]:
        """A vector per patch of RGB images, uint8 or floats 0 to 1. Images are not cropped."""
        vision, torch = self.clip.model.vision_model, self.clip.torch
        patch = self.clip.model.config.vision_config.patch_size
        pixels, rows, columns = in_patches(images, self.clip.processor, patch, self.resolution)
        with torch.inference_mode():
            seen = vision(
                pixel_values=pixels.to(self.clip.device, self.clip.model.dtype),
                output_hidden_states=True,
                interpolate_pos_encoding=True,
            )
            last = vision.encoder.layers[-1]
            values = last.self_attn.v_proj(last.layer_norm1(seen.hidden_states[-2]))
            patches = vision.post_layernorm(last.self_attn.out_proj(values)[:, 1:])
            vectors = self.clip.model.visual_projection(patches).float().cpu().numpy()
        vectors /= np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
        return vectors.reshape(len(images), rows, columns, -1)

    def embed_text(self, text: str) -> Float[np.ndarray, "D"]:
        """The unit vector of a text.

        Raises:
            ValueError: the text is empty.
        """
        return self.clip.embed_text(text)
