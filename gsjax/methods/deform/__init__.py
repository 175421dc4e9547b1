"""Deforming scenes with meaning, from an endoscope say: SurstSplat (papers/003), GaussianClin (papers/004).

config      what can be set; the two papers' recipes
start       the first Gaussians, of depth over time
poses       where cameras stood, where that is refined
nodes       which places the deformation is asked about
graph       what the teacher says of nodes, and what it asks of their features
step        deform, draw colours and features, compare, descend
train       the host loop
query       which Gaussians a prompt means
facts       what can be said of a scene in numbers
questions   what is asked in plain English
answers     what is said to it, from facts
"""

from gsjax.methods.deform.answers import Answer, PromptedAnswerer, TemplatedAnswerer, question_prompt
from gsjax.methods.deform.config import (
    PRESETS,
    DeformConfig,
    DeformRatesConfig,
    DeformWeightsConfig,
)
from gsjax.methods.deform.facts import SceneFacts, Sight, facts_of_sights, scene_facts
from gsjax.methods.deform.graph import (
    FrameGraph,
    GraphConfig,
    frame_graphs,
    graph_loss,
    graph_nodes,
    graph_of,
    seen_ids,
)
from gsjax.methods.deform.method import (
    Advanced,
    DeformProblem,
    DeformState,
    begin_deform,
    compiled_step,
    counted_ids,
    of_step,
    reconstruct,
    with_field,
)
from gsjax.methods.deform.nodes import nodes_of
from gsjax.methods.deform.poses import refined_viewmats
from gsjax.methods.deform.query import prompt_probabilities
from gsjax.methods.deform.questions import QUESTIONS, Question, QuestionType, parse_question, rows_of
from gsjax.methods.deform.start import Look, begins, start_gaussians
from gsjax.methods.deform.update import (
    Batch,
    DeformingScene,
    Moving,
    deform_loss,
    deform_step,
    feature_loss,
    on_grid,
)

__all__ = [
    "PRESETS",
    "QUESTIONS",
    "Advanced",
    "Answer",
    "Batch",
    "DeformConfig",
    "DeformProblem",
    "DeformRatesConfig",
    "DeformState",
    "DeformWeightsConfig",
    "DeformingScene",
    "FrameGraph",
    "GraphConfig",
    "Look",
    "Moving",
    "PromptedAnswerer",
    "Question",
    "QuestionType",
    "SceneFacts",
    "Sight",
    "TemplatedAnswerer",
    "begin_deform",
    "begins",
    "compiled_step",
    "counted_ids",
    "deform_loss",
    "deform_step",
    "facts_of_sights",
    "feature_loss",
    "frame_graphs",
    "graph_loss",
    "graph_nodes",
    "graph_of",
    "nodes_of",
    "of_step",
    "on_grid",
    "parse_question",
    "prompt_probabilities",
    "question_prompt",
    "reconstruct",
    "refined_viewmats",
    "rows_of",
    "scene_facts",
    "seen_ids",
    "start_gaussians",
    "with_field",
]
