"""SAM2 (Ravi et al., 2025) through transformers: masks of the first image, propagated to the others.
Weights are local files.

Needs the extra `foundation`; torch and transformers are imported when a model is loaded.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Num

from gsjax.perception import weights
from gsjax.perception.pictures import to_bytes


@dataclass(frozen=True)
class Sam2Propagator:
    """A propagator with a memory of each object's appearance; from `load_sam2`.

    It was trained on videos, but consecutive images may differ by viewpoint as well as by time, as in
    MotionSplicer.

    Attributes:
        model, processor: objects of transformers.
        session: the class of transformers that holds the images and the state of the inference.
        torch: the module.
        device: the device that holds the model.
    """

    model: Any
    processor: Any
    session: Any
    torch: Any
    device: str = "cpu"

    def __call__(
        self, images: Num[np.ndarray, "V H W 3"], labels: Int[np.ndarray, "rows columns"]
    ) -> Int[np.ndarray, "V H W"]:
        """Labels of all images: those of the first are returned unchanged; in the others, a pixel has the
        label with the largest logit, or 0 if no logit is positive.

        Args:
            images: RGB, uint8 or floats 0 to 1; neighbours should be similar. Each takes 12 MB of memory, and
                4 MB more per label.
            labels: labels of the first image, 0 for background.

        Raises:
            ValueError: labels and images differ in size.
        """
        if labels.shape != images.shape[1:3]:
            raise ValueError(
                f"labels: expected shape {images.shape[1:3]} to match images, found {labels.shape}"
            )
        names = np.append(0, _objects(labels))
        found = np.zeros(images.shape[:3], labels.dtype)
        found[0] = labels
        for view, logits in enumerate(self.logits(images, labels)):
            if view > 0:
                none = np.zeros((1, *labels.shape), logits.dtype)
                found[view] = names[np.concatenate([none, logits]).argmax(0)]
        return found

    def logits(
        self, images: Num[np.ndarray, "V H W 3"], labels: Int[np.ndarray, "H W"]
    ) -> Iterator[Float[np.ndarray, "P H W"]]:
        """SAM2's logits for each image in turn, one map per label in ascending order; positive is inside."""
        names = _objects(labels).tolist()
        if not names:
            return
        pixels = self.processor([to_bytes(image) for image in images], return_tensors="pt")["pixel_values"]
        resize, size = self.torch.nn.functional.interpolate, labels.shape
        session = self.session(
            video=pixels,
            video_height=size[0],
            video_width=size[1],
            inference_device=self.device,
            inference_state_device="cpu",
            video_storage_device="cpu",
            dtype=self.model.dtype,
        )
        for name in names:
            mask = self.torch.from_numpy(labels == name)[None, None].float()
            mask = resize(mask, pixels.shape[-2:], mode="bilinear", align_corners=False, antialias=True)
            session.add_mask_inputs(session.obj_id_to_idx(name), 0, (mask >= 0.5).float())
        session.obj_with_new_inputs = names
        for output in self.model.propagate_in_video_iterator(session, start_frame_idx=0):
            masks = output.pred_masks.float()
            yield resize(masks, size, mode="bilinear", align_corners=False)[:, 0].cpu().numpy()


def load_sam2(path: str | os.PathLike, device: str = "cpu") -> Sam2Propagator:
    """SAM2 for videos from a folder of weights in the layout of Hugging Face.

    Raises:
        FileNotFoundError: the folder or a file of it is missing.
        ValueError: the folder points to pickled weights.
        MissingExtra: torch or transformers is not installed.
    """
    folder = weights.model_folder(path, "SAM2's weights", (weights.PROCESSOR,), "facebook/sam2.1-hiera-tiny")
    torch, transformers = weights.foundation_modules("SAM2")
    model = weights.load_model(transformers, "Sam2VideoModel", folder, device)
    # SAM2's own processor needs torchvision. ViT's does the same to an image: resize, rescale, normalise.
    processor = transformers.ViTImageProcessorPil.from_pretrained(folder, local_files_only=True)
    return Sam2Propagator(model, processor, transformers.Sam2VideoInferenceSession, torch, device)


def _objects(labels: Int[np.ndarray, "H W"]) -> Int[np.ndarray, "P"]:
    """The labels that occur, without the background."""
    names = np.unique(labels)
    return names[names > 0]
