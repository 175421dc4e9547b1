"""Grounded SAM (Ren et al., 2024) through transformers: boxes for a text by Grounding DINO (Liu et al.,
2024), and the mask of each by SAM (Kirillov et al., 2023). Weights are local files.

Needs the extra `foundation`; torch and transformers are imported when models are loaded.
"""

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Num

from gsjax.perception import weights
from gsjax.perception.masks import Detections, labels_of_masks, name_by_size
from gsjax.perception.pictures import to_bytes


@dataclass(frozen=True)
class GroundedSam:
    """A segmenter prompted by text; from `load_grounded_sam`.

    Attributes:
        detector, detector_processor, segmenter, segmenter_processor: objects of transformers.
        torch: the module.
        device: the device that holds the models.
        prompt: what to look for; separate several things by full stops. "object" is the prompt in
            Object-Aware Gaussian Splatting for Robotic Manipulation.
        min_box_score, min_text_score: boxes, and words for a box, with lower scores are dropped.
        max_fraction: a mask that covers more of the image is not an object (a table, a wall).
        max_overlap: of two masks with a larger IoU, the one with the lower score is dropped.
        min_pixels: objects with fewer pixels are dropped.
    """

    detector: Any
    detector_processor: Any
    segmenter: Any
    segmenter_processor: Any
    torch: Any
    device: str = "cpu"
    prompt: str = "object"
    min_box_score: float = 0.25
    min_text_score: float = 0.25
    max_fraction: float = 0.5
    max_overlap: float = 0.8
    min_pixels: int = 60

    def __call__(
        self,
        image: Num[np.ndarray, "H W 3"],
        depth: Num[np.ndarray, "..."] | None = None,
        K: Float[np.ndarray, "3 3"] | None = None,
    ) -> Int[np.ndarray, "H W"]:
        """Labels of an image: 0 for background, then 1, 2, ... from the largest object to the smallest.

        Args:
            image: RGB, uint8 or floats 0 to 1.
            depth, K: not used; present so that all segmenters have the same signature.
        """
        found = self.find(image)
        return name_by_size(
            labels_of_masks(found.masks, found.scores, self.max_fraction, self.max_overlap), self.min_pixels
        )

    def find(self, image: Num[np.ndarray, "H W 3"]) -> Detections:
        """Boxes that match the prompt, and their masks."""
        image, size = to_bytes(image), image.shape[:2]
        text = self.prompt.strip().lower().rstrip(".") + "."
        inputs = self.detector_processor(images=image, text=text, return_tensors="pt").to(self.device)
        with self.torch.inference_mode():
            outputs = self.detector(**inputs)
        found = self.detector_processor.post_process_grounded_object_detection(
            outputs,
            inputs["input_ids"],
            threshold=self.min_box_score,
            text_threshold=self.min_text_score,
            target_sizes=[size],
        )[0]
        boxes, scores = found["boxes"].cpu().numpy(), found["scores"].cpu().numpy()
        if len(boxes) == 0:
            return Detections(boxes, scores, np.zeros((0, *size), bool))
        return Detections(boxes, scores, self._masks(image, boxes))

    def _masks(
        self, image: Num[np.ndarray, "H W 3"], boxes: Float[np.ndarray, "n 4"]
    ) -> Bool[np.ndarray, "n H W"]:
        """One mask per box; a box is unambiguous, so SAM is asked for a single mask."""
        inputs = self.segmenter_processor(image, input_boxes=[boxes.tolist()], return_tensors="pt")
        with self.torch.inference_mode():
            outputs = self.segmenter(
                pixel_values=inputs["pixel_values"].to(self.device),
                input_boxes=inputs["input_boxes"].to(self.device, self.torch.float32),
                multimask_output=False,
            )
        masks = self.segmenter_processor.image_processor.post_process_masks(
            outputs.pred_masks.cpu(), inputs["original_sizes"], inputs["reshaped_input_sizes"]
        )
        return masks[0][:, 0].numpy()


def load_grounded_sam(
    detector: str | os.PathLike, segmenter: str | os.PathLike, device: str = "cpu", prompt: str = "object"
) -> GroundedSam:
    """Grounding DINO and SAM from two folders of weights in the layout of Hugging Face.

    Args:
        detector: the folder of Grounding DINO.
        segmenter: the folder of SAM.
        device: device of torch, "cpu" or "cuda".
        prompt: what to look for.

    Raises:
        FileNotFoundError: a folder or a file of it is missing.
        ValueError: a folder points to pickled weights.
        MissingExtra: torch or transformers is not installed.
    """
    files = (weights.PROCESSOR, "tokenizer.json|vocab.txt")
    boxes = weights.model_folder(
        detector, "Grounding DINO's weights", files, "IDEA-Research/grounding-dino-tiny"
    )
    masks = weights.model_folder(segmenter, "SAM's weights", (weights.PROCESSOR,), "facebook/sam-vit-base")
    torch, transformers = weights.foundation_modules("Grounded SAM")
    tokenizer = transformers.AutoTokenizer.from_pretrained(boxes, **weights.LOCAL_FILES)
    return GroundedSam(
        detector=weights.load_model(transformers, "GroundingDinoForObjectDetection", boxes, device),
        detector_processor=transformers.GroundingDinoProcessor(
            weights.image_processor(transformers, boxes), tokenizer
        ),
        segmenter=weights.load_model(transformers, "SamModel", masks, device),
        segmenter_processor=transformers.SamProcessor(weights.image_processor(transformers, masks)),
        torch=torch,
        device=device,
        prompt=prompt,
    )
