"""SAM (Kirillov et al., 2023) through transformers: masks of everything in a picture, or of what was clicked
on. Weights are local files.

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
from gsjax.perception.masks import Found, labels_of_masks, name_by_size
from gsjax.perception.pictures import to_bytes


@dataclass(frozen=True)
class SamSegmenter:
    """A segmenter that knows no words; from `load_sam`.

    It segments everything: SAM is asked at a grid of points, and what it is sure of is kept. Any picture will
    do. On the difference of two frames, as in MotionSplicer, it finds what moved between them.

    With clicks it finds what they are on instead, one mask for each of their labels:

        dataclasses.replace(segmenter, clicks=((120, 80, 1), (310, 95, 2), (330, 240, 2)))(image)

    Attributes:
        pipeline: "mask-generation" of transformers, with the model and its image processor.
        processor: of transformers, for clicks.
        torch: the module.
        clicks: column and row of a pixel, and the label of what is there; a click with label 0 is on nothing
            of what is wanted.
        points_per_side: of the grid.
        points_per_batch: of the grid, at a time. Fewer take less memory.
        min_score: weaker masks are dropped; SAM's own guess of its intersection over union with the truth.
        min_stability: so are masks that change more when their threshold does; intersection over union of
            the mask at a logit of 1 with that at -1.
        max_box_overlap: of two masks whose boxes have a larger intersection over union the weaker is dropped.
        max_fraction: a mask with more of the picture is no object.
        min_pixels: smaller objects are dropped. This and the six before do not concern clicks.
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
        """Labels of a picture: 0 background, then 1, 2, ... from the largest object to the smallest; with
        clicks, their labels.

        Where masks overlap the smaller is on top.

        Args:
            image: RGB, uint8 or floats 0 to 1.
            depth, K: not used; they stand here so that all segmenters are called alike.

        Raises:
            ValueError: a click is outside the picture or has a negative label, or all have label 0.
        """
        if self.clicks:
            return self._clicked(to_bytes(image))
        found = self.find(image)
        return name_by_size(labels_of_masks(found.masks, found.scores, self.max_fraction), self.min_pixels)

    def find(self, image: Num[np.ndarray, "H W 3"]) -> Found:
        """Masks of everything, the best first, with their boxes."""
        # The last step of the pipeline's own call is the same as what follows here, but needs torchvision.
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
        return Found(boxes[kept], scores[kept], masks)

    def _clicked(self, image: UInt8[np.ndarray, "H W 3"]) -> Int[np.ndarray, "H W"]:
        """The label of the clicks whose mask a pixel is in, 0 where it is in none."""
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
                # One click may mean a part or the whole: then SAM gives three answers, with scores.
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
        FileNotFoundError: the folder or a file of it is missing.
        ValueError: the folder leads to weights that are a pickle.
        MissingExtra: torch or transformers is not installed.
    """
    folder = weights.model_folder(path, "SAM's weights", (weights.PROCESSOR,), "facebook/sam-vit-base")
    torch, transformers = weights.foundation_modules("SAM")
    model = transformers.SamModel.from_pretrained(folder, **weights.LOCAL_WEIGHTS).eval()
    pictures = weights.image_processor(transformers, folder)
    pipeline = transformers.pipeline("mask-generation", model=model, image_processor=pictures, device=device)
    return SamSegmenter(pipeline, transformers.SamProcessor(pictures), torch)


def _mask_of_runs(counts: list[int], size: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """A mask from the lengths of its runs, by turns outside and inside, column after column."""
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
            "clicks: all have label 0, on nothing of what is wanted; give some a label of 1 or more"
        )
