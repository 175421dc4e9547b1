"""The stages of an update, in the order in which a frame passes through them; see `track_step`.

Each is a pure function of the `UpdateContext` that all of them share, and of the results of earlier stages.

    context.py  what all stages share
    shown.py    what a scene shows in the cameras of a frame, and what the next frame needs of it
    follow.py   last_view         what the last scene shows of each group
                motion_hypotheses hypotheses of where each group has gone
                align_and_search  alignment with the images, wider searches, and relocation
                refine_motion     photometric refinement against rendered images, if configured
    settle.py   detect_lost       whether each group is where it is believed to be
                store_state       what the scene shows now, from which the next frame continues
"""
