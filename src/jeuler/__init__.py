"""jeuler: differentiable Euler integration of springs, particles and ODEs in JAX.

The verbs stand here: `solve`, `simulate`, `fit`, `fit_springs`, `advise_step`, `advise_method`, `work_precision`,
`stability_limit`, `diagnose`. The catalogues have a namespace each: `jeuler.forces`, `jeuler.effects`,
`jeuler.contact`, `jeuler.samplers`, `jeuler.steps`; bodies from meshes are in `jeuler.meshes`, figures
in `jeuler.plotting`, scenes in `jeuler.scenes`.
"""

import importlib
from typing import TYPE_CHECKING, Any

from jeuler import contact as contact
from jeuler import effects as effects
from jeuler import forces as forces
from jeuler import samplers as samplers
from jeuler import steps as steps
from jeuler.contact import Box, Collisions, GridDistance, PenaltyContact, Plane, Sphere
from jeuler.effects import (
    Breaking,
    Death,
    DeathOnContact,
    DeathOutside,
    DistanceLinks,
    Emitter,
    Lifetime,
    Neighbours,
    OverLife,
    PrescribedMotion,
    SampledPath,
    SpeedLimit,
    SubEmitter,
    Trail,
)
from jeuler.forces import (
    AppliedForce,
    Bending,
    BreakableSprings,
    CubicSprings,
    DryFriction,
    Flocking,
    Fluid,
    Gravity,
    Gust,
    LinearDrag,
    PointAttractor,
    QuadraticDrag,
    ShapeMatching,
    SoftRepulsion,
    Springs,
    StrandBending,
    StrandCore,
    Strings,
    Torsion,
    TriangleContact,
    Turbulence,
    Viscosity,
    Vortex,
    Wind,
    strand_edges,
    turbulence,
)
from jeuler.particles import Division, ParticleState, Scene, divide, empty_pool, export, simulate, uses
from jeuler.samplers import Choice, Cone, FromDisc, FromLine, FromSphere, FromSurface, Normal, Uniform
from jeuler.solving import AdaptiveSolution, Ensemble, Moments, Quantiles, Solution, ensemble, solve, solve_adaptive
from jeuler.steps import (
    StabilityLimit,
    cap_cotangent,
    euler_step,
    extrapolated_euler,
    heun_step,
    implicit_euler,
    implicit_euler_step,
    implicit_midpoint_step,
    linearly_implicit_euler,
    linearly_implicit_euler_step,
    rk4_step,
    stability_limit,
    symplectic_euler_step,
)

if TYPE_CHECKING:
    from jeuler.accuracy import (
        Compensated,
        Method,
        MethodAdvice,
        RankedMethod,
        StepAdvice,
        WorkPrecision,
        advise_method,
        advise_step,
        work_precision,
    )
    from jeuler.diagnosis import Diagnosis, diagnose
    from jeuler.fitting import (
        Comparison,
        Fit,
        FoundSprings,
        Identifiability,
        Recording,
        ShootingFit,
        SpringFit,
        Trajectory,
        compare_fits,
        find_springs,
        fit,
        fit_springs,
        identifiability,
        multiple_shooting,
        read_trajectory,
    )
    from jeuler.meshes import MeshBody, from_mesh, grid_cloth, mesh_collider, rope

__version__ = "0.2.0"

__all__ = [
    "AdaptiveSolution",
    "AppliedForce",
    "Bending",
    "Box",
    "BreakableSprings",
    "Breaking",
    "Choice",
    "Collisions",
    "Comparison",
    "Compensated",
    "Cone",
    "CubicSprings",
    "Death",
    "DeathOnContact",
    "DeathOutside",
    "Diagnosis",
    "DistanceLinks",
    "Division",
    "DryFriction",
    "Emitter",
    "Ensemble",
    "Fit",
    "Flocking",
    "Fluid",
    "FoundSprings",
    "FromDisc",
    "FromLine",
    "FromSphere",
    "FromSurface",
    "Gravity",
    "GridDistance",
    "Gust",
    "Identifiability",
    "Lifetime",
    "LinearDrag",
    "MeshBody",
    "Method",
    "MethodAdvice",
    "Moments",
    "Neighbours",
    "Normal",
    "OverLife",
    "ParticleState",
    "PenaltyContact",
    "Plane",
    "PointAttractor",
    "PrescribedMotion",
    "QuadraticDrag",
    "Quantiles",
    "RankedMethod",
    "Recording",
    "SampledPath",
    "Scene",
    "ShapeMatching",
    "ShootingFit",
    "SoftRepulsion",
    "Solution",
    "SpeedLimit",
    "Sphere",
    "SpringFit",
    "Springs",
    "StabilityLimit",
    "StepAdvice",
    "StrandBending",
    "StrandCore",
    "Strings",
    "SubEmitter",
    "Torsion",
    "Trail",
    "Trajectory",
    "TriangleContact",
    "Turbulence",
    "Uniform",
    "Viscosity",
    "Vortex",
    "Wind",
    "WorkPrecision",
    "advise_method",
    "advise_step",
    "cap_cotangent",
    "compare_fits",
    "diagnose",
    "divide",
    "empty_pool",
    "ensemble",
    "euler_step",
    "export",
    "extrapolated_euler",
    "find_springs",
    "fit",
    "fit_springs",
    "from_mesh",
    "grid_cloth",
    "heun_step",
    "identifiability",
    "implicit_euler",
    "implicit_euler_step",
    "implicit_midpoint_step",
    "linearly_implicit_euler",
    "linearly_implicit_euler_step",
    "mesh_collider",
    "multiple_shooting",
    "read_trajectory",
    "rk4_step",
    "rope",
    "simulate",
    "solve",
    "solve_adaptive",
    "stability_limit",
    "strand_edges",
    "symplectic_euler_step",
    "turbulence",
    "uses",
    "work_precision",
]

_ON_DEMAND = {  # packages that are imported at the first use of a name of theirs: half of the time of an import
    "accuracy": (
        "Compensated",
        "Method",
        "MethodAdvice",
        "RankedMethod",
        "StepAdvice",
        "WorkPrecision",
        "advise_method",
        "advise_step",
        "work_precision",
    ),
    "diagnosis": ("Diagnosis", "diagnose"),
    "meshes": ("MeshBody", "from_mesh", "grid_cloth", "mesh_collider", "rope"),
    "observing": (),
    "plotting": (),
    "scenes": (),
    "fitting": (
        "Comparison",
        "Fit",
        "FoundSprings",
        "Identifiability",
        "Recording",
        "ShootingFit",
        "SpringFit",
        "Trajectory",
        "compare_fits",
        "find_springs",
        "fit",
        "fit_springs",
        "identifiability",
        "multiple_shooting",
        "read_trajectory",
    ),
}


def __getattr__(name: str) -> Any:
    for package, names in _ON_DEMAND.items():
        if name == package or name in names:
            module = importlib.import_module(f"jeuler.{package}")
            globals().update({each: getattr(module, each) for each in names})
            return module if name == package else getattr(module, name)
    raise AttributeError(f"module 'jeuler' has no attribute {name!r}")


def __dir__() -> list[str]:
    catalogues = {"contact", "effects", "forces", "samplers", "steps"}
    return sorted({*__all__, *_ON_DEMAND, *catalogues, *(name for name in globals() if name.startswith("__"))})
