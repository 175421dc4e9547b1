"""Recordings and photographs, real and simulated: every reader returns a `Sequence` or `Photographs`."""

from gsjax.data.bop import read_bop
from gsjax.data.clip import read_clip
from gsjax.data.colmap import read_colmap
from gsjax.data.endonerf import read_endonerf
from gsjax.data.endovis import read_endovis
from gsjax.data.errors import DataError, DataWarning
from gsjax.data.objects import PointModel, Truth
from gsjax.data.open import ReadOptions, open_photographs, open_sequence
from gsjax.data.open3d_rgbd import read_open3d
from gsjax.data.panoptic import read_panoptic, write_panoptic
from gsjax.data.paris import read_paris
from gsjax.data.photographs import Cloud, Photographs, photographs_of
from gsjax.data.poses_bounds import read_dynerf, read_llff
from gsjax.data.push_t import read_push_t
from gsjax.data.realsense import read_realsense
from gsjax.data.record3d import read_record3d
from gsjax.data.sequence import Sequence
from gsjax.data.seven_scenes import read_seven_scenes
from gsjax.data.transforms import read_transforms
from gsjax.data.tum import read_tum
from gsjax.data.validation import check_depth

__all__ = [
    "Cloud",
    "DataError",
    "DataWarning",
    "Photographs",
    "PointModel",
    "ReadOptions",
    "Sequence",
    "Truth",
    "check_depth",
    "open_photographs",
    "open_sequence",
    "photographs_of",
    "read_bop",
    "read_clip",
    "read_colmap",
    "read_dynerf",
    "read_endonerf",
    "read_endovis",
    "read_llff",
    "read_open3d",
    "read_panoptic",
    "read_paris",
    "read_push_t",
    "read_realsense",
    "read_record3d",
    "read_seven_scenes",
    "read_transforms",
    "read_tum",
    "write_panoptic",
]
