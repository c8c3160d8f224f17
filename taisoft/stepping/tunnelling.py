"""How far contacts close in a step, against how far they may before things could pass each other unseen."""

import taichi as ti

from taisoft.collision.surface import dvec
from taisoft.contact.assemble import carried
from taisoft.runtime import kernel

CLOSEST = 0.5  # of the thinner side's thickness: how far a contact may close in one step
DEPTH, HASTE, SPEED, WHICH, SINKING = range(5)  # places in what `survey` tells


@kernel
def survey(
    s: ti.template(), o: ti.template(), found: ti.template(), kept: ti.template(), n: ti.i32, dt: ti.f64,
    told: ti.types.ndarray(),
):  # fmt: skip
    """told (5,): deepest penetration [m]; the most that a contact closes in the coming step, over what it may; the speed of
    that [m/s]; its number among the kept; the deepest penetration over the finer side's mean surface edge."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        depth, haste, speed, which = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64), -1
        sinking = ti.cast(0.0, ti.f64)
        for c in range(n):
            at = kept[c]
            depth = ti.max(depth, -found.gap[at])
            a, b = found.body[at][0], found.body[at][1]
            sinking = ti.max(sinking, -found.gap[at] / ti.min(s.edge[a], s.edge[b]))
            way = dvec(0.0)
            if ti.static(o.count > 0):
                if found.nodes_b[at][0] < 0:
                    way -= carried(o, b, found.point[at])
            for j in ti.static(range(3)):
                if found.nodes_a[at][j] >= 0:
                    way += found.weights_a[at][j] * s.move[found.nodes_a[at][j]]
                if found.nodes_b[at][j] >= 0:
                    way -= found.weights_b[at][j] * s.move[found.nodes_b[at][j]]
            closing = -way.dot(found.normal[at])
            allowed = CLOSEST * ti.min(s.thickness[a], s.thickness[b])
            if s.thickness[b] < ti.math.inf and closing > haste * allowed:
                haste, speed, which = closing / allowed, closing / dt, c
        told[0], told[1], told[2], told[3], told[4] = depth, haste, speed, which, sinking


@kernel
def find_way(m: ti.template(), s: ti.template(), x_start: ti.template(), way: ti.template()) -> ti.f64:
    """way (n_nodes) [m] since x_start; returns by how much a vertex of the surface left the straight way that was searched."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        way[i] = m.x[i] - x_start[i]
    most = ti.cast(0.0, ti.f64)
    ti.loop_config(serialize=True)
    for _ in range(1):
        for k in range(s.n_verts):
            if s.node[k] >= 0:
                d, known = way[s.node[k]], s.move[k]
                square = known.dot(known)
                share = ti.cast(0.0, ti.f64)
                if square > 0.0:
                    share = ti.min(ti.max(d.dot(known) / square, 0.0), 1.0)
                most = ti.max(most, (d - share * known).norm())
    return most
