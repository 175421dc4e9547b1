"""What experiments share: `from experiments.shared.recordings import recorded`.

One module for each kind of experiment, and some for all:

    commands.py    commands of gsjax, each in a process of its own
    recordings.py  recordings by their names, and the tracker on them
    fields.py      feature fields: scenes, teachers, scores
    discoveries.py parts: scenes and scores
    deforming.py   deforming scenes: frames, fits, scores
    deform_regions.py, deform_truth.py  what is true of simulated tissue
    one_update.py  one update of the tracker
    panda.py       a robot arm and its cameras
    timing.py      how long a function takes
    plots.py       figures
"""
