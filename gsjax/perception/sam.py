"""SAM (Kirillov et al., 2023) through transformers: masks of everything in an image, or of clicked objects.
Weights are local files.

Needs the extra `foundation`; torch and transformers are imported when a model is loaded.
"""

import os
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Num, UInt8
from PIL import Image

from gsjax.perception import weights
from gsjax.perception.levels import labels_on_levels
from gsjax.perception.masks import Detections, labels_of_masks, name_by_size
from gsjax.perception.pictures import to_bytes


@dataclass(frozen=True)
class SamSegmenter:
    """A segmenter without a text prompt; from `load_sam`.

    By default it segments everything: SAM is prompted with a grid of points, and confident masks are kept.
    The input can be any image; on the difference of two frames, as in MotionSplicer, it finds what moved
    between them.

    With clicks it segments the clicked objects instead, one mask for each label of the clicks:

        dataclasses.replace(segmenter, clicks=((120, 80, 1), (310, 95, 2), (330, 240, 2)))(image)

    Attributes:
        pipeline: the "mask-generation" pipeline of transformers, with the model and its image processor.
        processor: processor of transformers, for clicks.
        torch: the module.
        clicks: column and row of a pixel, and the label of the object there; a click with label 0 marks a
            place outside all objects.
        points_per_side: grid points per side.
        points_per_batch: grid points processed at a time; fewer need less memory.
        min_score: masks with a lower score are dropped; the score is SAM's own estimate of the mask's IoU.
        min_stability: masks with a lower stability are dropped; the stability is the IoU of the mask at a
            logit of 1 with the mask at -1.
        max_box_overlap: of two masks whose boxes have a larger IoU, the one with the lower score is dropped.
        max_fraction: a mask that covers more of the image is not an object.
        min_pixels: objects with fewer pixels are dropped. This and the six before do not apply to clicks.
    """

    pipeline: Any
    processor: Any
    torch: Any
    clicks: tuple[tuple[float, float, int], ...] = ()
    points_per_side: int = 32
    points_per_batch: int = 64
    min_score: float = 0.88
    min_stability: float = 0.95
    max_box_overlap: float = 0.7
    max_fraction: float = 0.5
    min_pixels: int = 60

    def __call__(
        self,
        image: Num[np.ndarray, "H W 3"],
        depth: Num[np.ndarray, "..."] | None = None,
        K: Float[np.ndarray, "3 3"] | None = None,
    ) -> Int[np.ndarray, "H W"]:
        """Labels of an image: 0 for background, then 1, 2, ... from the largest object to the smallest; with
        clicks, their labels.

        Where masks overlap, the smaller one is on top.

        Args:
            image: RGB, uint8 or floats 0 to 1.
            depth, K: not used; present so that all segmenters have the same signature.

        Raises:
            ValueError: a click is outside the image or has a negative label, or all have label 0.
        """
        if self.clicks:
            return self._clicked(to_bytes(image))
        found = self.find(image)
        return name_by_size(labels_of_masks(found.masks, found.scores, self.max_fraction), self.min_pixels)

    def levels(self, image: Num[np.ndarray, "H W 3"]) -> Int[np.ndarray, "levels H W"]:
        """Labels of everything on the levels of `gsjax.perception.levels`: objects, their parts, and the
        parts of those; 0 where there is none.

        Args:
            image: RGB, uint8 or floats 0 to 1.
        """
        return labels_on_levels(self.find(image).masks, self.max_fraction, self.min_pixels)

    def find(self, image: Num[np.ndarray, "H W 3"]) -> Detections:
        """Masks of everything with their boxes, in descending order of score."""
        # The last step of the pipeline's own call is equivalent to what follows, but needs torchvision.
        chunks = self.pipeline.preprocess(
            Image.fromarray(to_bytes(image)),
            points_per_batch=self.points_per_batch,
            points_per_crop=self.points_per_side,
        )
        limits = {"pred_iou_thresh": self.min_score, "stability_score_thresh": self.min_stability}
        parts = [self.pipeline.forward(chunk, **limits) for chunk in chunks]
        boxes = np.concatenate([part["boxes"].float().numpy() for part in parts])
        scores = np.concatenate([part["iou_scores"].float().numpy() for part in parts])
        runs = [run["counts"] for part in parts for run in part["masks"]]
        corners_and_sizes = np.concatenate([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]], axis=1)
        kept = np.array(cv2.dnn.NMSBoxes(corners_and_sizes, scores, 0.0, self.max_box_overlap), int)
        masks = np.zeros((len(kept), *image.shape[:2]), bool)
        for i, row in enumerate(kept):
            masks[i] = _mask_of_runs(runs[row], image.shape[:2])
        return Detections(boxes[kept], scores[kept], masks)

    def _clicked(self, image: UInt8[np.ndarray, "H W 3"]) -> Int[np.ndarray, "H W"]:
        """For each pixel, the label of the clicks whose mask covers it; 0 where none does."""
        _check_clicks(self.clicks, image.shape[:2])
        names = np.unique([0, *(label for *_, label in self.clicks)]).astype(np.int32)
        model, device = self.pipeline.model, self.pipeline.device
        masks = np.zeros((len(names) - 1, *image.shape[:2]), bool)
        with self.torch.inference_mode():
            pixels = self.processor(image, return_tensors="pt")["pixel_values"]
            seen = model.get_image_embeddings(pixels.to(device))
            for i, name in enumerate(names[1:]):
                points = [[x, y] for x, y, label in self.clicks if label in (name, 0)]
                on_it = [int(label == name) for *_, label in self.clicks if label in (name, 0)]
                inputs = self.processor(
                    image, input_points=[[points]], input_labels=[[on_it]], return_tensors="pt"
                )
                # A single click may mean a part or the whole, so SAM returns three masks with scores.
                outputs = model(
                    image_embeddings=seen,
                    input_points=inputs["input_points"].to(device, self.torch.float32),
                    input_labels=inputs["input_labels"].to(device),
                    multimask_output=len(points) == 1,
                )
                answers = self.processor.image_processor.post_process_masks(
                    outputs.pred_masks.cpu(), inputs["original_sizes"], inputs["reshaped_input_sizes"]
                )[0][0]
                masks[i] = answers[int(outputs.iou_scores[0, 0].argmax())].numpy()
        return names[labels_of_masks(masks, np.ones(len(masks)))]


def load_sam(path: str | os.PathLike, device: str = "cpu") -> SamSegmenter:
    """SAM from a folder of weights in the layout of Hugging Face.

    Raises:
        FileNotFoundError: the folder, or a file in it, is missing.
        ValueError: the folder points to pickled weights.
        MissingExtra: torch or transformers is not installed.
    """
    folder = weights.model_folder(path, "SAM's weights", (weights.PROCESSOR,), "facebook/sam-vit-base")
    torch, transformers = weights.foundation_modules("SAM")
    model = weights.load_model(transformers, "SamModel", folder, device)
    pictures = weights.image_processor(transformers, folder)
    pipeline = transformers.pipeline("mask-generation", model=model, image_processor=pictures, device=device)
    return SamSegmenter(pipeline, transformers.SamProcessor(pictures), torch)


def _mask_of_runs(counts: list[int], size: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """A mask from its run lengths, alternating between outside and inside, column by column."""
    inside = np.arange(len(counts)) % 2 == 1
    return np.repeat(inside, counts).reshape(size[::-1]).T


def _check_clicks(clicks: tuple[tuple[float, float, int], ...], size: tuple[int, int]) -> None:
    height, width = size
    for x, y, label in clicks:
        if not (0 <= x < width and 0 <= y < height):
            raise ValueError(
                f"clicks: expected x in [0, {width}) and y in [0, {height}), found {(x, y, label)}"
            )
        if label < 0:
            raise ValueError(f"clicks: expected labels of 0 or more, found {(x, y, label)}")
    if all(label == 0 for *_, label in clicks):
        raise ValueError(
            "clicks: expected at least one label of 1 or more, found only label 0, which is background"
        )
