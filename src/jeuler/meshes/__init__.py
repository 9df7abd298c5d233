"""Bodies from meshes: particles, springs, bending and masses; a cloth and a rope in one line; meshes as colliders."""

from jeuler.meshes.bodies import MeshBody, from_mesh, grid_cloth, rope
from jeuler.meshes.distance import mesh_collider

__all__ = ["MeshBody", "from_mesh", "grid_cloth", "mesh_collider", "rope"]


def __dir__() -> list[str]:
    return __all__
