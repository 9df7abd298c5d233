"""The kernels of the Warp peer: springs add to their ends atomically, Warp differentiates them on its tape."""

import warp as wp


@wp.kernel
def spring_forces(
    x: wp.array(dtype=wp.vec3),
    v: wp.array(dtype=wp.vec3),
    edges: wp.array(dtype=wp.vec2i),
    rest: wp.array(dtype=float),
    ks: wp.array(dtype=float),
    kd: wp.array(dtype=float),
    f: wp.array(dtype=wp.vec3),
):
    e = wp.tid()
    i = edges[e][0]
    j = edges[e][1]
    d = x[i] - x[j]
    r = wp.length(d)
    u = d / r
    force = (ks[0] * (rest[e] - r) - kd[0] * wp.dot(v[i] - v[j], u)) * u
    wp.atomic_add(f, i, force)
    wp.atomic_sub(f, j, force)


@wp.kernel
def move(
    x: wp.array(dtype=wp.vec3),
    v: wp.array(dtype=wp.vec3),
    f: wp.array(dtype=wp.vec3),
    x_next: wp.array(dtype=wp.vec3),
    v_next: wp.array(dtype=wp.vec3),
    dt: float,
    gravity: float,
    drag: float,
):
    i = wp.tid()
    a = f[i] - wp.vec3(0.0, 0.0, gravity)
    if drag > 0.0:
        a = a - drag * wp.length(v[i]) * v[i]
    x_next[i] = x[i] + dt * v[i]
    v_next[i] = v[i] + dt * a


@wp.kernel
def sum_of_squares(x: wp.array(dtype=wp.vec3), total: wp.array(dtype=float)):
    wp.atomic_add(total, 0, wp.dot(x[wp.tid()], x[wp.tid()]))
