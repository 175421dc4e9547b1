"""A semantic field for a scene that somebody else has fitted, asked in 3D (FD-3DGS, papers/002).

teacher = teacher_of_objects(masks, embeddings)
problem, state = begin_distill(gaussians, cameras, teacher, config)
for distilled in distill(problem, state): ...
scores = relevancy(gaussian_cosines(field, located, queries))

config.py    what can be set              distill.py   the losses, and one step
teacher.py   what pixels are to say       training.py  the loop on the host
field.py     hash grid and convolution    query.py     what a query means
inverse.py   from the teacher's channels back to the field's
votes.py     labels by majority, to be held against
"""

from gsjax.methods.distill.config import DistillConfig, DistillRatesConfig, DistillWeightsConfig
from gsjax.methods.distill.field import (
    FeatureField,
    carried,
    features_of,
    init_field,
    used_part,
    whole,
)
from gsjax.methods.distill.inverse import learned_inverse, pseudo_inverse
from gsjax.methods.distill.method import (
    Distilled,
    DistillProblem,
    DistillState,
    begin_distill,
    compiled_step,
    distill,
    finished,
    frozen_views,
)
from gsjax.methods.distill.query import (
    Threshold,
    back_projected_cosines,
    gaussian_cosines,
    painted_cosines,
    pixel_cosines,
    pixel_features,
    pixel_mask,
    relevancy,
    selection_mask,
    threshold_for,
)
from gsjax.methods.distill.teacher import Teacher, teacher_of_maps, teacher_of_objects, with_maps
from gsjax.methods.distill.update import DistillBatch, distill_loss, distill_step
from gsjax.methods.distill.votes import label_votes, majority_labels

__all__ = [
    "DistillBatch",
    "DistillConfig",
    "DistillProblem",
    "DistillRatesConfig",
    "DistillState",
    "DistillWeightsConfig",
    "Distilled",
    "FeatureField",
    "Teacher",
    "Threshold",
    "back_projected_cosines",
    "begin_distill",
    "carried",
    "compiled_step",
    "distill",
    "distill_loss",
    "distill_step",
    "features_of",
    "finished",
    "frozen_views",
    "gaussian_cosines",
    "init_field",
    "label_votes",
    "learned_inverse",
    "majority_labels",
    "painted_cosines",
    "pixel_cosines",
    "pixel_features",
    "pixel_mask",
    "pseudo_inverse",
    "relevancy",
    "selection_mask",
    "teacher_of_maps",
    "teacher_of_objects",
    "threshold_for",
    "used_part",
    "whole",
    "with_maps",
]
