"""Parts from two states: pictures of a scene before and after its parts moved, each state seen by cameras of
its own, with depth (the setting of PARIS). No motion is seen in between, so it is searched for.

found = states_of(before, after)  # frames of all cameras
found.labels, found.motions

surfaces.py      points with normals and colours, and what cameras say of points
registration.py  motions that may be, and the one that fits best near each
search.py        the motions that together explain what is gone
labels.py        which motion each point follows
start.py         the start of a discovery from all of these
"""

from gsjax.methods.parts.states.search import States, states_of
from gsjax.methods.parts.states.start import begin_with_states

__all__ = ["States", "begin_with_states", "states_of"]
