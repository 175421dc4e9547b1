"""CLIP (Radford et al., 2021) and SigLIP (Zhai et al., 2023) through transformers: images and text in one
space. Weights are local files.

Needs the extra `foundation`; torch and transformers are imported when a model is loaded.
"""

import math
import os
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Num

from gsjax.perception import weights
from gsjax.perception.pictures import square_crop, to_bytes

_BATCH = 32  # images; SAM finds hundreds of masks in a photograph
_CLIP, _SIGLIP = "clip", "siglip"  # `model_type` in config.json; SigLIP 2 of fixed resolution is "siglip" too
_CHANCE = 0.01  # probability of a match by SigLIP's sigmoid


@dataclass(frozen=True)
class ClipEncoder:
    """Unit vectors of object crops and of text; from `load_clip`.

    Attributes:
        model, processor, tokenizer: objects of transformers.
        torch: the module.
        device: the device that holds the model.
        min_score: a query whose best cosine is lower matches none of the objects. CLIP's cosines lie around
            0.25 to 0.3 for an image and a matching text, and around 0.15 to 0.2 for one that does not match.
            SigLIP's are lower: `load_clip` takes the one at which SigLIP's own sigmoid gives a match a
            probability of 1 in 100.
    """

    model: Any
    processor: Any
    tokenizer: Any
    torch: Any
    device: str = "cpu"
    min_score: float = 0.2

    @property
    def is_siglip(self) -> bool:
        """Whether the model is a SigLIP."""
        return self.model.config.model_type == _SIGLIP

    @property
    def dimension(self) -> int:
        """Length of a vector."""
        config = self.model.config
        return config.vision_config.hidden_size if self.is_siglip else config.projection_dim

    def embed_images(self, images: list[np.ndarray]) -> Float[np.ndarray, "n D"]:
        """Unit vectors of RGB images [h,w,3], uint8 or floats 0 to 1, computed in batches to limit memory."""
        vectors = []
        for first in range(0, len(images), _BATCH):
            some = [to_bytes(image) for image in images[first : first + _BATCH]]
            pixels = self.processor(some, return_tensors="pt")["pixel_values"]
            with self.torch.inference_mode():
                seen = self.model.get_image_features(pixel_values=pixels.to(self.device, self.model.dtype))
                vectors.append(seen.pooler_output.float().cpu().numpy())
        return _unit(np.concatenate(vectors))

    def embed_text(self, text: str) -> Float[np.ndarray, "D"]:
        """The unit vector of a text.

        Raises:
            ValueError: the text is empty.
        """
        if not text.strip():
            raise ValueError("text: expected words that describe an object, found an empty text")
        how: dict[str, Any] = {"truncation": True, "return_tensors": "pt"}
        if self.is_siglip:  # trained on lower case, padded to full length, with no mask of the padding
            length = self.model.config.text_config.max_position_embeddings
            tokens = self.tokenizer([text.lower()], padding="max_length", max_length=length, **how)
            tokens = {"input_ids": tokens["input_ids"].to(self.device)}
        else:
            tokens = self.tokenizer([text], **how).to(self.device)
        with self.torch.inference_mode():
            read = self.model.get_text_features(**tokens)
            return _unit(read.pooler_output.float().cpu().numpy())[0]

    def embed_objects(
        self, image: Num[np.ndarray, "H W 3"], labels: Int[np.ndarray, "H W"], count: int
    ) -> Float[np.ndarray, "count D"]:
        """The vector of a square crop around each of the labels 1 to `count`; zeros for absent labels.

        A crop keeps the object's surroundings, because these models were trained on whole images, not on
        cut-outs.

        Args:
            image: RGB, uint8 or floats 0 to 1.
            labels: label of each pixel, 0 for background.
            count: the largest label to embed.
        """
        vectors = np.zeros((count, self.dimension), np.float32)
        there = [label for label in range(1, count + 1) if (labels == label).any()]
        if there:
            crops = [square_crop(np.asarray(image), labels == label) for label in there]
            vectors[np.array(there) - 1] = self.embed_images(crops)
        return vectors


def load_clip(path: str | os.PathLike, device: str = "cpu") -> ClipEncoder:
    """CLIP or SigLIP (also SigLIP 2 of fixed resolution) from a folder of weights in the layout of Hugging
    Face.

    Args:
        path: the folder.
        device: device of torch, "cpu" or "cuda".

    Raises:
        FileNotFoundError: the folder or a file of it is missing.
        ValueError: the folder holds another model, or points to pickled weights.
        MissingExtra: torch or transformers is not installed.
    """
    files = (weights.PROCESSOR, "tokenizer.json|vocab.json|spiece.model")
    folder = weights.model_folder(path, "CLIP's weights", files, "openai/clip-vit-large-patch14")
    kind = weights.model_type(folder)
    if kind not in (_CLIP, _SIGLIP):
        raise ValueError(
            f"{folder / 'config.json'}: expected the model_type clip or siglip, found {kind!r}. Of SigLIP 2 "
            "take a model of fixed resolution, such as google/siglip2-base-patch16-224"
        )
    torch, transformers = weights.foundation_modules("CLIP")
    model = weights.load_model(transformers, "AutoModel", folder, device, half=True)
    processor = weights.image_processor(transformers, folder)
    tokenizer = transformers.AutoTokenizer.from_pretrained(folder, **weights.LOCAL_FILES)
    encoder = ClipEncoder(model, processor, tokenizer, torch, device)
    if not encoder.is_siglip:
        return encoder
    logit = math.log(_CHANCE / (1 - _CHANCE))
    bias, scale = (float(number.detach()) for number in (model.logit_bias, model.logit_scale.exp()))
    return replace(encoder, min_score=(logit - bias) / scale)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
