"""Parts from two states: pictures of a scene before and after its parts moved, each state seen by its own
cameras, with depth (the setting of PARIS). The motion in between is not observed, so it is searched for.

found = states_of(before, after)  # frames of all cameras
found.labels, found.motions

surfaces.py      points with normals and colours, and what cameras tell about points
registration.py  initial guesses of motions, and the one that fits best near each
search.py        the motions that together explain what has disappeared
labels.py        which motion each point follows
start.py         the start of a discovery from all of these
"""

from gsjax.methods.parts.states.search import States, states_of
from gsjax.methods.parts.states.start import begin_with_states

__all__ = ["States", "begin_with_states", "states_of"]
