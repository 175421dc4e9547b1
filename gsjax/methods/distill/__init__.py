"""A semantic feature field of a static scene, queried in 3D (FD-3DGS).

teacher = teacher_of_objects(masks, embeddings)
method = Distill(config)
problem, run = method.start(gaussians, cameras, teacher)
for now in drive(method, problem, run): ...
scores = now.result.scores(vectors)

config.py   configuration
teacher.py  target features of pixels
views.py    the scene and the teacher in each view
field.py    hash grid and convolution
levels.py   masks that a view lacks on a level, from the votes of other views
solve.py    a vector for each Gaussian, by least squares
update.py   the loss, and one optimisation step
method.py   the method of the drive loop
result.py   the field with its queries
query.py    scores of Gaussians and pixels
inverse.py  a learned inverse of the convolution
votes.py    labels by majority vote, the baseline
"""

from gsjax.methods.distill.config import (
    PRESETS,
    DistillConfig,
    DistillRatesConfig,
    DistillWeightsConfig,
    SolveConfig,
)
from gsjax.methods.distill.field import (
    FeatureField,
    active_table,
    features_of,
    full_table,
    init_field,
    rendered_features,
)
from gsjax.methods.distill.inverse import learned_inverse
from gsjax.methods.distill.method import Distill, Problem, field_step
from gsjax.methods.distill.query import (
    back_projected_cosines,
    gaussian_cosines,
    pixel_cosines,
    pixel_features,
)
from gsjax.methods.distill.result import DistillResult
from gsjax.methods.distill.solve import SolveBatch, solve_step
from gsjax.methods.distill.teacher import Teacher, teacher_of_maps, teacher_of_objects, with_maps
from gsjax.methods.distill.update import distill_loss
from gsjax.methods.distill.update import distill_step as step
from gsjax.methods.distill.views import Batch, frozen_views, view_batch
from gsjax.methods.distill.votes import label_votes, voted_labels

__all__ = [
    "PRESETS",
    "Batch",
    "Distill",
    "DistillConfig",
    "DistillRatesConfig",
    "DistillResult",
    "DistillWeightsConfig",
    "FeatureField",
    "Problem",
    "SolveBatch",
    "SolveConfig",
    "Teacher",
    "active_table",
    "back_projected_cosines",
    "distill_loss",
    "features_of",
    "field_step",
    "frozen_views",
    "full_table",
    "gaussian_cosines",
    "init_field",
    "label_votes",
    "learned_inverse",
    "pixel_cosines",
    "pixel_features",
    "rendered_features",
    "solve_step",
    "step",
    "teacher_of_maps",
    "teacher_of_objects",
    "view_batch",
    "voted_labels",
    "with_maps",
]
