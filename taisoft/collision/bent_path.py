"""Bent paths: whether a motion close to the straight one is free, though the straight one passes through something.

What must be refused is going through, not cutting a corner within a step: what slides by D over a radius R cuts D^2 / 8R deep.
A bent path leads from the start to the end in a few straight legs. Between them all surfaces are shrunk: each vertex is displaced
inwards along its normal, by 4 t (1 - t) of a depth at the part t of the step. So bodies leave room for each other everywhere,
and do not push into third ones. Each leg passes the same check as a straight path, with all pairs: a bent path that is free is a
real motion without any passage, whatever the shrunk surfaces look like. They exist only in the check.
"""

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.collision.features import unit
from taisoft.collision.near_list import UNCOVERED, leaving
from taisoft.collision.surface import dvec

# legs, and depths over the margin, in the order in which they are tried
TRIALS = ((2, 1 / 64), (2, 1 / 16), (2, 1 / 4), (2, 0.9), (4, 1 / 4), (4, 0.9), (8, 0.9))


@ti.func
def _move_to(s: ti.template(), x: ti.template(), searched, i):
    """Displacement (3,) of vertex i to the positions x (n_nodes); along the searched path if it is an obstacle's, or if searched
    is 1 [m]."""
    move = s.move[i]
    if s.node[i] >= 0 and searched == 0:
        move = x[s.node[i]] - s.x[i]
    return move


@kernel
def find_inwards(s: ti.template(), x: ti.template(), searched: ti.i32, inwards: ti.template()):
    """Set unit vectors (n_verts) inwards from the bodies' surfaces, midway on their paths, see `_move_to`; 0 for obstacles."""
    ti.loop_config(serialize=s.serial_cheap)
    for i in range(s.n_verts):
        n = dvec(0.0)
        if s.node[i] >= 0:
            for r in range(s.ring_start[i], s.ring_start[i + 1]):
                t = s.ring[r]
                i0, i1, i2 = s.triangle[t, 0], s.triangle[t, 1], s.triangle[t, 2]
                a = s.x[i0] + 0.5 * _move_to(s, x, searched, i0)
                n -= (s.x[i1] + 0.5 * _move_to(s, x, searched, i1) - a).cross(s.x[i2] + 0.5 * _move_to(s, x, searched, i2) - a)
        inwards[i] = unit(n)


@kernel
def set_leg(
    s: ti.template(),
    leg: ti.template(),
    paths: ti.template(),
    x: ti.template(),
    searched: ti.i32,
    inwards: ti.template(),
    depth: ti.f64,
    begin: ti.f64,
    end: ti.f64,
    limit: ti.f64,
):
    """Set the positions of surface `leg` and `paths.path` to those of a leg between two parts of the step; depth [m]: by which
    surfaces are shrunk at most; limit [m]: of how far vertices may leave the searched paths, else `left` says UNCOVERED."""
    paths.left[UNCOVERED] = 0
    ti.loop_config(serialize=s.serial_cheap)
    for i in range(s.n_verts):
        move = _move_to(s, x, searched, i)
        first = begin * move + 4.0 * begin * (1.0 - begin) * depth * inwards[i]
        last = end * move + 4.0 * end * (1.0 - end) * depth * inwards[i]
        leg.x[i], paths.path[i] = s.x[i] + first, last - first
        if not leaving(last, s.move[i]).norm() <= limit:
            paths.left[UNCOVERED] = 1
