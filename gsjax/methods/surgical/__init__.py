"""Deforming scenes with meaning, from an endoscope say: SurstSplat (papers/003), GaussianClin (papers/004).

config      what can be set; the two papers' recipes
start       the first Gaussians, of depth over time
nodes       which places the deformation is asked about
graph       what the teacher says of nodes, and what it asks of their features
step        deform, draw colours and features, compare, descend
train       the host loop
query       which Gaussians a prompt means
"""

from gsjax.methods.surgical.config import (
    PRESETS,
    SurgicalConfig,
    SurgicalRatesConfig,
    SurgicalWeightsConfig,
)
from gsjax.methods.surgical.graph import FrameGraph, GraphConfig, frame_graphs, graph_loss, graph_nodes
from gsjax.methods.surgical.nodes import nodes_of
from gsjax.methods.surgical.query import prompt_probabilities
from gsjax.methods.surgical.start import Look, start_gaussians
from gsjax.methods.surgical.step import (
    Batch,
    DeformingScene,
    Moving,
    feature_loss,
    surgical_loss,
    surgical_step,
)
from gsjax.methods.surgical.train import (
    Advanced,
    SurgicalProblem,
    SurgicalState,
    begin_surgical,
    compiled_step,
    of_step,
    reconstruct,
    with_field,
)

__all__ = [
    "PRESETS",
    "Advanced",
    "Batch",
    "DeformingScene",
    "FrameGraph",
    "GraphConfig",
    "Look",
    "Moving",
    "SurgicalConfig",
    "SurgicalProblem",
    "SurgicalRatesConfig",
    "SurgicalState",
    "SurgicalWeightsConfig",
    "begin_surgical",
    "compiled_step",
    "feature_loss",
    "frame_graphs",
    "graph_loss",
    "graph_nodes",
    "nodes_of",
    "of_step",
    "prompt_probabilities",
    "reconstruct",
    "start_gaussians",
    "surgical_loss",
    "surgical_step",
    "with_field",
]
