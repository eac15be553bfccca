"""Complete the labels along the geometry (paper section 3.4): KNN voting, eq. 7-9 as a front, Potts by mean
field with color and relief.
"""

from sc3d.geometry.graph import Graph, build_graph, similarity
from sc3d.propagation.potts import mean_field, potts_energy
from sc3d.propagation.propagate import Evidence, complete, propagate, tie_breakers
from sc3d.propagation.region_growing import grow, vote_nearest

__all__ = [
    "Evidence",
    "Graph",
    "build_graph",
    "complete",
    "grow",
    "mean_field",
    "potts_energy",
    "propagate",
    "similarity",
    "tie_breakers",
    "vote_nearest",
]
