"""Deforming scenes with semantic features, as seen by an endoscope: SurstSplat and GaussianClin.

method = Deform(config)
problem, run = method.start(frames, lesson)
for now in drive(method, problem, run): ...
now.result.at(0.5)

config.py     configuration, the recipes of the two papers, and one for a camera around an object
method.py     the method of the drive loop
start.py      initial Gaussians, from the depth of all frames or on a plane
hull.py       initial Gaussians within the visual hull of a scene that the camera goes around
poses.py      refined camera poses
nodes.py      the nodes at which the field is evaluated
graph.py      the teacher's features at nodes, and the losses on their edges
update.py     the losses, and one optimisation step
result.py     the scene at any time, its cameras, and queries
meaning.py    the vocabulary of the features, and prompts
query.py      probabilities of prompts
facts.py      measurements of a scene
questions.py  questions in plain English
answers.py    their answers, from facts
"""

from gsjax.methods.deform.answers import Answer, PromptedAnswerer, TemplatedAnswerer, question_prompt
from gsjax.methods.deform.config import (
    PRESETS,
    DeformConfig,
    DeformRatesConfig,
    DeformWeightsConfig,
)
from gsjax.methods.deform.facts import LabelledView, SceneFacts, facts_of_views, scene_facts
from gsjax.methods.deform.graph import (
    FrameGraph,
    GraphConfig,
    frame_graphs,
    graph_loss,
    graph_of,
    seen_ids,
)
from gsjax.methods.deform.hull import goes_around, hull_gaussians
from gsjax.methods.deform.meaning import Lesson, Meaning, counted_ids, feature_prompt, text_prompt
from gsjax.methods.deform.method import Deform, Kept, Problem, batch_of, with_field
from gsjax.methods.deform.nodes import nodes_of
from gsjax.methods.deform.poses import refined_viewmats, times_of
from gsjax.methods.deform.query import prompt_probabilities
from gsjax.methods.deform.questions import QUESTIONS, Question, QuestionType, parse_question, rows_of
from gsjax.methods.deform.result import DeformResult, Timeline
from gsjax.methods.deform.start import can_start_from, start_gaussians
from gsjax.methods.deform.update import (
    Batch,
    DeformingScene,
    Moving,
    SceneAtTime,
    deform_loss,
    feature_loss,
    on_grid,
)
from gsjax.methods.deform.update import deform_step as step

__all__ = [
    "PRESETS",
    "QUESTIONS",
    "Answer",
    "Batch",
    "Deform",
    "DeformConfig",
    "DeformRatesConfig",
    "DeformResult",
    "DeformWeightsConfig",
    "DeformingScene",
    "FrameGraph",
    "GraphConfig",
    "Kept",
    "LabelledView",
    "Lesson",
    "Meaning",
    "Moving",
    "Problem",
    "PromptedAnswerer",
    "Question",
    "QuestionType",
    "SceneAtTime",
    "SceneFacts",
    "TemplatedAnswerer",
    "Timeline",
    "batch_of",
    "can_start_from",
    "counted_ids",
    "deform_loss",
    "facts_of_views",
    "feature_loss",
    "feature_prompt",
    "frame_graphs",
    "goes_around",
    "graph_loss",
    "graph_of",
    "hull_gaussians",
    "nodes_of",
    "on_grid",
    "parse_question",
    "prompt_probabilities",
    "question_prompt",
    "refined_viewmats",
    "rows_of",
    "scene_facts",
    "seen_ids",
    "start_gaussians",
    "step",
    "text_prompt",
    "times_of",
    "with_field",
]
