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


@wp.kernel
def soft_repulsion_step(
    grid: wp.uint64,
    x: wp.array(dtype=wp.vec3),
    v: wp.array(dtype=wp.vec3),
    x_next: wp.array(dtype=wp.vec3),
    v_next: wp.array(dtype=wp.vec3),
    diameter: float,
    ks: float,
    box: float,
    dt_over_mass: float,
    dt: float,
):
    i = wp.tid()
    f = wp.vec3(0.0, 0.0, 0.0)
    near = wp.hash_grid_query(grid, x[i], diameter)
    j = int(0)  # noqa: UP018, RUF046 (a variable of the kernel; a literal would be a constant)
    while wp.hash_grid_query_next(near, j):
        d = x[i] - x[j]
        d = d - box * wp.vec3(wp.round(d[0] / box), wp.round(d[1] / box), wp.round(d[2] / box))
        r = wp.length(d)
        if j != i and r < diameter and r > 0.0:
            f = f + ks * (diameter - r) / r * d
    v_next[i] = v[i] + dt_over_mass * f
    x_next[i] = x[i] + dt * v_next[i]
