"""Forces: ``force(t, position, velocity, mass) -> (particle, dim)`` in N. A file for each kind."""

from jeuler.forces.air import Gust, Turbulence, Vortex, Wind, turbulence
from jeuler.forces.applied import AppliedForce
from jeuler.forces.attraction import PointAttractor
from jeuler.forces.drag import LinearDrag, QuadraticDrag
from jeuler.forces.fields import Gravity
from jeuler.forces.friction import DryFriction
from jeuler.forces.hair import StrandBending, StrandCore, strand_edges
from jeuler.forces.links import BreakableSprings, CubicSprings, Strings
from jeuler.forces.nearby import Flocking, Fluid, SoftRepulsion
from jeuler.forces.neighbours import Bending, Viscosity
from jeuler.forces.sheets import TriangleContact
from jeuler.forces.soft_body import ShapeMatching
from jeuler.forces.springs import Springs
from jeuler.forces.torsion import Torsion

__all__ = [
    "AppliedForce",
    "Bending",
    "BreakableSprings",
    "CubicSprings",
    "DryFriction",
    "Flocking",
    "Fluid",
    "Gravity",
    "Gust",
    "LinearDrag",
    "PointAttractor",
    "QuadraticDrag",
    "ShapeMatching",
    "SoftRepulsion",
    "Springs",
    "StrandBending",
    "StrandCore",
    "Strings",
    "Torsion",
    "TriangleContact",
    "Turbulence",
    "Viscosity",
    "Vortex",
    "Wind",
    "strand_edges",
    "turbulence",
]


def __dir__() -> list[str]:
    return __all__
