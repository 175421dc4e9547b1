"""DINOv2 (Oquab et al., 2024) through transformers: a feature for each pixel. Weights are local files.

Needs the extra `foundation`; torch and transformers are imported when a model is loaded.
"""

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Num

from gsjax.perception import weights
from gsjax.perception.pictures import in_patches


@dataclass(frozen=True)
class Dinov2Encoder:
    """Features of the last layer's patches, interpolated to pixels; from `load_dinov2`.

    Attributes:
        model, processor: the network and its preprocessor, from the transformers package.
        torch: the torch module.
        device: the device that holds the model.
        resolution: shorter side of the model's input, pixels, rounded to whole patches. Larger values resolve
            more.
    """

    model: Any
    processor: Any
    torch: Any
    device: str = "cpu"
    resolution: int = 518

    def __call__(self, images: Num[np.ndarray, "C H W 3"]) -> Float[np.ndarray, "C H W D"]:
        """Features of RGB images, uint8 or floats 0 to 1. Images are used whole, without cropping."""
        height, width = images.shape[1:3]
        patch = self.model.config.patch_size
        pixels, rows, columns = in_patches(images, self.processor, patch, self.resolution)
        with self.torch.inference_mode():
            tokens = self.model(pixel_values=pixels.to(self.device, self.model.dtype)).last_hidden_state
            # The class token and, in some models, registers precede the patches.
            grid = tokens[:, -rows * columns :].float().unflatten(1, (rows, columns)).permute(0, 3, 1, 2)
            maps = self.torch.nn.functional.interpolate(
                grid, (height, width), mode="bilinear", align_corners=False
            )
            return maps.permute(0, 2, 3, 1).cpu().numpy()


def load_dinov2(path: str | os.PathLike, device: str = "cpu", resolution: int = 518) -> Dinov2Encoder:
    """DINOv2, with or without registers, from a folder of weights in the layout of Hugging Face.

    Args:
        path: the folder.
        device: device of torch, "cpu" or "cuda".
        resolution: shorter side of the model's input, pixels.

    Raises:
        FileNotFoundError: the folder or a file of it is missing.
        ValueError: the folder points to pickled weights.
        MissingExtra: torch or transformers is not installed.
    """
    folder = weights.model_folder(path, "DINOv2's weights", (weights.PROCESSOR,), "facebook/dinov2-base")
    torch, transformers = weights.foundation_modules("DINOv2")
    model = weights.load_model(transformers, "AutoModel", folder, device, half=True)
    return Dinov2Encoder(model, weights.image_processor(transformers, folder), torch, device, resolution)
