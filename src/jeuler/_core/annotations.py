"""Types of the fields of components: a field is given one thing and holds another.

``Springs(edges, ks=[10.0, 20.0], ...)`` takes a list, and ``springs.ks`` is a floating array. To a type checker these
types are descriptors: what ``__set__`` takes is what the constructor takes, what ``__get__`` returns is what the field
holds. At run time they are `Any`, and fields are plain attributes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from jax import Array
from numpy.typing import ArrayLike

FunctionOfTime = Callable[[Any], Any]  # f(t) -> array
SamplerLike = ArrayLike | Callable[[Array, int], Array]  # a value, or sampler(key, count) -> (count, ...)
AirLike = ArrayLike | Callable[[Any, Array], Array] | Sequence[Callable[[Any, Array], Array]] | None
ColliderLike = Callable[[Any, Array], Array]  # collider(t, point) -> signed distance


def default(value: Any) -> Any:
    """The value of a field that is not given, of a type that the field's own need not be."""
    return value


if TYPE_CHECKING:

    class Parameter:
        """Takes a number, list or array, holds a floating array."""

        def __get__(self, component: Any, owner: Any = None) -> Array: ...
        def __set__(self, component: Any, value: ArrayLike) -> None: ...

    class OptionalParameter:
        """Takes a number, list, array or None, holds an array or None."""

        def __get__(self, component: Any, owner: Any = None) -> Any: ...
        def __set__(self, component: Any, value: ArrayLike | None) -> None: ...

    class MovingParameter:
        """Takes a number, list, array or a function of time, holds an array or a component that is called with t."""

        def __get__(self, component: Any, owner: Any = None) -> Any: ...
        def __set__(self, component: Any, value: ArrayLike | FunctionOfTime) -> None: ...

    class ParticleIndices:
        """Takes integers, holds an `Indices`."""

        def __get__(self, component: Any, owner: Any = None) -> Any: ...
        def __set__(self, component: Any, value: ArrayLike) -> None: ...

    class SampledParameter:
        """Takes a value or a sampler, holds an array or a component that is called with a key and a count."""

        def __get__(self, component: Any, owner: Any = None) -> Any: ...
        def __set__(self, component: Any, value: SamplerLike | None) -> None: ...

    class AirParameter:
        """Takes a velocity, a field of velocities, several that add up, or None; holds a tuple of fields."""

        def __get__(self, component: Any, owner: Any = None) -> tuple[Any, ...]: ...
        def __set__(self, component: Any, value: AirLike) -> None: ...

    class ColliderParameter:
        """Takes a signed distance, holds a component that is called with t and a point."""

        def __get__(self, component: Any, owner: Any = None) -> Any: ...
        def __set__(self, component: Any, value: ColliderLike) -> None: ...

    class OptionalCollider:
        """Takes a signed distance or None, holds a component that is called with t and a point, or None."""

        def __get__(self, component: Any, owner: Any = None) -> Any: ...
        def __set__(self, component: Any, value: ColliderLike | None) -> None: ...

else:
    Parameter = OptionalParameter = MovingParameter = ParticleIndices = Any
    SampledParameter = AirParameter = ColliderParameter = OptionalCollider = Any
