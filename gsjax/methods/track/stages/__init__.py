"""The stages of an update, in the order in which a frame goes through them; see `track_step`.

Each is a pure function of a `Moment`, which all of them share, and of what the stages before it found.

    look_back         what the last scene shows of each group
    starting_points   where each group may have gone
    align_and_search  aligned with the images; looked for everywhere, and elsewhere
    refine_motion     against rendered images, where that is asked for
    detect_lost       whether each group is where it is believed to be
    remember          what the scene shows now, from which the next frame goes on
"""

from gsjax.methods.track.stages.follow import align_and_search, look_back, refine_motion, starting_points
from gsjax.methods.track.stages.moment import Moment
from gsjax.methods.track.stages.settle import detect_lost, remember
from gsjax.methods.track.stages.shown import memory_of, pixels_shown, show

__all__ = [
    "Moment",
    "align_and_search",
    "detect_lost",
    "look_back",
    "memory_of",
    "pixels_shown",
    "refine_motion",
    "remember",
    "show",
    "starting_points",
]
