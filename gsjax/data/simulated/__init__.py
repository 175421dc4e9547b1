"""Built-in scenes: ray-cast, textured and shadowed solids that move rigidly, twist and bend.

They are generated from a seed and need no download. Since they are not made of Gaussians, no reconstruction
fits them by construction.
"""

from gsjax.data.simulated.articulated import articulated
from gsjax.data.simulated.bar import bar
from gsjax.data.simulated.cabinet import cabinet
from gsjax.data.simulated.hard_parts import hard_parts
from gsjax.data.simulated.primitives import Primitive
from gsjax.data.simulated.raycaster import Light, Scene
from gsjax.data.simulated.simulation import simulated_sequence
from gsjax.data.simulated.tabletop import tabletop
from gsjax.data.simulated.textures import Texture
from gsjax.data.simulated.tissue import tissue

__all__ = [
    "Light",
    "Primitive",
    "Scene",
    "Texture",
    "articulated",
    "bar",
    "cabinet",
    "hard_parts",
    "simulated_sequence",
    "tabletop",
    "tissue",
]
