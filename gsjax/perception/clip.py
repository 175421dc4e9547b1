"""CLIP (Radford et al., 2021) through transformers: images and text in one space. Weights are local files.

Needs the extra `foundation`; torch and transformers are imported when a model is loaded.
"""

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Num

from gsjax.perception import weights
from gsjax.perception.pictures import square_crop, to_bytes

_BATCH = 32  # images; SAM finds hundreds of masks in a photograph


@dataclass(frozen=True)
class ClipEncoder:
    """Unit vectors of object crops and of text; from `load_clip`.

    Attributes:
        model, processor, tokenizer: objects of transformers.
        torch: the module.
        device: the device that holds the model.
        min_score: a query whose best cosine is lower matches none of the objects. CLIP's cosines lie around
            0.25 to 0.3 for an image and a matching text, and around 0.15 to 0.2 for one that does not match.
    """

    model: Any
    processor: Any
    tokenizer: Any
    torch: Any
    device: str = "cpu"
    min_score: float = 0.2

    def embed_images(self, images: list[np.ndarray]) -> Float[np.ndarray, "n D"]:
        """Unit vectors of RGB images [h,w,3], uint8 or floats 0 to 1; a few images at a time are in the
        model's memory."""
        vectors = []
        for first in range(0, len(images), _BATCH):
            some = [to_bytes(image) for image in images[first : first + _BATCH]]
            pixels = self.processor(some, return_tensors="pt")["pixel_values"]
            with self.torch.inference_mode():
                seen = self.model.vision_model(pixel_values=pixels.to(self.device)).pooler_output
                vectors.append(self.model.visual_projection(seen).float().cpu().numpy())
        return _unit(np.concatenate(vectors))

    def embed_text(self, text: str) -> Float[np.ndarray, "D"]:
        """The unit vector of a text.

        Raises:
            ValueError: the text is empty.
        """
        if not text.strip():
            raise ValueError("text: expected words that describe an object, found an empty text")
        tokens = self.tokenizer([text], truncation=True, return_tensors="pt").to(self.device)
        with self.torch.inference_mode():
            read = self.model.text_model(**tokens).pooler_output
            return _unit(self.model.text_projection(read).float().cpu().numpy())[0]

    def embed_objects(
        self, image: Num[np.ndarray, "H W 3"], labels: Int[np.ndarray, "H W"], count: int
    ) -> Float[np.ndarray, "count D"]:
        """The vector of a square crop around each of the labels 1 to `count`; zeros for absent labels.

        A crop keeps the object's surroundings, because CLIP was trained on whole images, not on cut-outs.

        Args:
            image: RGB, uint8 or floats 0 to 1.
            labels: label of each pixel, 0 for background.
            count: the largest label to embed.
        """
        vectors = np.zeros((count, self.model.config.projection_dim), np.float32)
        there = [label for label in range(1, count + 1) if (labels == label).any()]
        if there:
            crops = [square_crop(np.asarray(image), labels == label) for label in there]
            vectors[np.array(there) - 1] = self.embed_images(crops)
        return vectors


def load_clip(path: str | os.PathLike, device: str = "cpu") -> ClipEncoder:
    """CLIP from a folder of weights in the layout of Hugging Face.

    Raises:
        FileNotFoundError: the folder or a file of it is missing.
        ValueError: the folder points to pickled weights.
        MissingExtra: torch or transformers is not installed.
    """
    files = (weights.PROCESSOR, "tokenizer.json|vocab.json")
    folder = weights.model_folder(path, "CLIP's weights", files, "openai/clip-vit-large-patch14")
    torch, transformers = weights.foundation_modules("CLIP")
    model = transformers.CLIPModel.from_pretrained(folder, **weights.LOCAL_WEIGHTS).eval().to(device)
    processor = weights.image_processor(transformers, folder)
    tokenizer = transformers.AutoTokenizer.from_pretrained(folder, **weights.LOCAL_FILES)
    return ClipEncoder(model, processor, tokenizer, torch, device)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
