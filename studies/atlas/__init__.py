"""How the links of one machine couple, and which links benefit when one is controlled.

`subsets` runs every subset of controlled links and modes through the sweep engine, and
`attribution` turns their residuals into effects, interactions and Shapley shares. `workspace`
computes natural modes on a grid of poses, `platform` splits the platform's error and computes
frequency responses. `claims` checks the paper's statements against these results. `findings`
collects everything; `plots`, `drawing` and `figures` show it, `report` writes the report, and `run`
is `studies atlas`.
"""

from typing import TYPE_CHECKING

from studies.lazy import lazily

if TYPE_CHECKING:
    from studies.atlas.attribution import effects, interaction, shapley
    from studies.atlas.platform import platform_error, responses
    from studies.atlas.subsets import Subsets, atlas_sweep, read_subsets
    from studies.atlas.workspace import map_workspace, natural_modes_at

__all__ = [
    "Subsets",
    "atlas_sweep",
    "effects",
    "interaction",
    "map_workspace",
    "natural_modes_at",
    "platform_error",
    "read_subsets",
    "responses",
    "shapley",
]

__getattr__ = lazily(
    __name__,
    {
        "Subsets": "studies.atlas.subsets",
        "atlas_sweep": "studies.atlas.subsets",
        "effects": "studies.atlas.attribution",
        "interaction": "studies.atlas.attribution",
        "map_workspace": "studies.atlas.workspace",
        "natural_modes_at": "studies.atlas.workspace",
        "platform_error": "studies.atlas.platform",
        "read_subsets": "studies.atlas.subsets",
        "responses": "studies.atlas.platform",
        "shapley": "studies.atlas.attribution",
    },
)
