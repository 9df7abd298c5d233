"""Forces: ``force(t, position, velocity, mass) -> (particle, dim)`` in N. One file a family."""

from jeuler.forces.contact import PenaltyContact
from jeuler.forces.drag import QuadraticDrag
from jeuler.forces.fields import Gravity
from jeuler.forces.springs import Springs

__all__ = ["Gravity", "PenaltyContact", "QuadraticDrag", "Springs"]
