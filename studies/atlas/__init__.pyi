from . import drawing, plots
from .attribution import effects, interaction, shapley
from .platform import platform_error, responses
from .subsets import Subsets, atlas_sweep, read_subsets
from .workspace import map_workspace, natural_modes_at

__all__ = [
    "Subsets",
    "atlas_sweep",
    "drawing",
    "effects",
    "interaction",
    "map_workspace",
    "natural_modes_at",
    "platform_error",
    "plots",
    "read_subsets",
    "responses",
    "shapley",
]
