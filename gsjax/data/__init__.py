"""Recordings, real and simulated: every reader gives the same sequence type."""

from gsjax.data.errors import DataError, DataWarning
from gsjax.data.open import open_sequence
from gsjax.data.panoptic import read_panoptic, write_panoptic
from gsjax.data.push_t import read_push_t
from gsjax.data.sequence import PointModel, Sequence, Truth
from gsjax.data.seven_scenes import read_seven_scenes
from gsjax.data.tum import read_tum
from gsjax.data.validation import check_depth

__all__ = [
    "DataError",
    "DataWarning",
    "PointModel",
    "Sequence",
    "Truth",
    "check_depth",
    "open_sequence",
    "read_panoptic",
    "read_push_t",
    "read_seven_scenes",
    "read_tum",
    "write_panoptic",
]
