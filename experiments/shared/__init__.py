"""What experiments share: `from experiments.shared.recordings import recorded`.

One module for each kind of experiment, and some for all:

    commands.py    commands of gsjax, each in its own process
    recordings.py  recordings by name, and the tracker on them
    fields.py      feature fields: scenes, teachers, scores
    discoveries.py parts: scenes and scores
    deforming.py   deforming scenes: frames, fits, scores
    deform_regions.py, deform_truth.py  ground truth of simulated tissue
    one_update.py  one update of the tracker
    panda.py       a robot arm and its cameras
    timing.py      run times of functions and loops
    plots.py       figures
"""
