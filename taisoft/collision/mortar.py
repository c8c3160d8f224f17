"""Mortar contacts between two meshes: gaps in the mean around a node, which can carry any uniform pressure.

For a corner node j of the *slave* surface, which has the closer corner nodes, with hat function h_j,
    A_j = sum w h_j,   gap = n . sum w h_j (x_s - x_m) / A_j,   W_j = sum w h_j (N_s, -N_m) / A_j,
where the sums are integrals over the overlay of both surfaces (`overlay`) and N their shape functions, quadratic ones on faces
of second order. n is the mean normal. The impulses p A_j dt give the nodal forces of the pressure p on both sides. A mean does
not keep each point apart: contacts of vertices and edges remain as *guards*, at part of the contact offset.

A node has a contact for each master and each cluster of normals, unless the gap stays large in the step. Where hardly any of the
faces around a node is covered, its hat function passes to other nodes.

Source: Puso, Laursen 2004, A mortar segment-to-segment contact method (there with one averaged law and no guards).
"""

import taichi as ti

from taisoft.backend.lists import part_first
from taisoft.backend.runtime import kernel
from taisoft.collision.candidates import NEEDED, sum_parts, visit_near
from taisoft.collision.contacts import EDGE_EDGE, MORTAR, VERTEX_FACE, write_contact
from taisoft.collision.features import choose, unit
from taisoft.collision.overlay import face_vertex, n_face, on_face, shapes
from taisoft.collision.surface import dvec, ivec

LEAST_COVERED = 0.2  # of the faces around a node: where less is, contacts of several nodes would be nearly the same
SAME_CLUSTER = 0.9  # cosine between normals of points of one contact
FARTHEST = 0.2  # of the margin: mean gap beyond which there is no contact
MAX_CLUSTERS = 8  # contacts of one node; what exceeds them is left to the guards


@ti.func
def _list_face(s: ti.template(), overlay: ti.template(), out: ti.template(), t, places: ti.template(), first, n_before, end):
    """Find the vertices of the face of triangle t among entries `first` to n_before - 1 of the list, or add them without weight
    if they fit before `end`. Set their places, -1 for those that do not. Return the new end of the entries, or more."""
    n = n_before
    for node in range(n_face(overlay, t)):
        vertex = face_vertex(s, overlay, t, node)
        k = ti.min(n, end) - 1  # backwards, since neighbours share vertices
        while k >= first and out.vertex[ti.max(k, first)] != vertex:
            k -= 1
        if k < first:
            k = -1
            if n < end:
                k = n
                out.vertex[k], out.weight[k] = vertex, 0.0
            n += 1
        places[node] = k
    return n


@ti.func
def _face_at(s: ti.template(), overlay: ti.template(), t, i):
    """Number of corner node i in the face of triangle t, and the first and end of that face's triangles, none if t does not lie
    at that corner of a face."""
    corner, begin, n = -1, t - ti.max(overlay.quarter[t], 0), ti.select(overlay.quarter[t] < 0, 1, 4)
    for k in range(3):
        if s.triangle[t, k] == i and (overlay.quarter[t] < 0 or overlay.quarter[t] == k):
            corner = k
    return corner, begin, ti.select(corner < 0, begin, begin + n)


@ti.func
def _coverage(s: ti.template(), overlay: ti.template(), points: ti.template(), i):
    """Part of the faces around slave node i that is covered, those without any point left out."""
    covered, whole = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
    for r in range(s.ring_start[i], s.ring_start[i + 1]):
        j, begin, end = _face_at(s, overlay, s.ring[r], i)
        n, face = 0, ti.cast(0.0, ti.f64)
        for t in range(begin, end):
            n, face = n + overlay.count[t], face + s.area[t]
            for e in range(overlay.first[t], overlay.first[t] + overlay.count[t]):
                b = points.slave[e]
                covered += points.share[e] * points.area[e] * choose(j, b[0], b[1], b[2])
        if n > 0:
            whole += face / 6.0
    return covered / whole


@ti.func
def _hats(s: ti.template(), overlay: ti.template(), t, b):
    """Hat functions (3,) of the corners of the face of triangle t at barycentric coordinates b (3,). Those of corners that are
    hardly covered pass to the others, or all to the one that is covered most, so that their sum stays 1."""
    hats, total, most, best = dvec(0.0), ti.cast(0.0, ti.f64), ti.cast(-1.0, ti.f64), 0
    for k in ti.static(range(3)):
        coverage = overlay.coverage[face_vertex(s, overlay, t, k)]
        if coverage >= ti.cast(LEAST_COVERED, ti.f64):
            hats[k] = b[k]
            total += b[k]
        if coverage > most:
            best, most = k, coverage
    if most < ti.cast(LEAST_COVERED, ti.f64):
        total = 1.0
        for k in ti.static(range(3)):
            hats[k] = ti.cast(int(best == k), ti.f64)
    return hats / total


@ti.func
def _cluster(seeds: ti.template(), n_seeds, other, n):
    """The first contact of a node with such a seed that a point with normal n (3,) on collider `other` belongs to; n_seeds if
    there is none."""
    first = n_seeds
    for z in range(n_seeds):
        along = n[0] * seeds[z, 0] + n[1] * seeds[z, 1] + n[2] * seeds[z, 2]
        if first == n_seeds and seeds[z, 3] == other and along > ti.cast(SAME_CLUSTER, ti.f64):
            first = z
    return first


@ti.func
def _node_contacts(
    s: ti.template(),
    overlay: ti.template(),
    points: ti.template(),
    move: ti.template(),
    i,
    out: ti.template(),
    start,
    end,
    begin,
    list_end,
):
    """Write the contacts of slave node i to out[start:end], and their vertices to the list from `begin` to list_end. Return both
    new counts."""
    at, last, k, n_seeds, is_complete = start, begin, 0, 0, False
    seeds = ti.Matrix.zero(ti.f64, MAX_CLUSTERS + 1, 4)  # a normal and the master of each contact
    places = ti.Vector.zero(ti.i32, 6)  # of the face listed last
    own = s.body[s.ring[s.ring_start[i]]]
    while k == n_seeds and k < MAX_CLUSTERS and not is_complete:
        is_complete = True
        other, opposite, first, n_first, is_near = -1, -1, last, 0, False
        area, total, nearest = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
        normal, apart, carried = dvec(0.0), dvec(0.0), dvec(0.0)
        for step in range(2):  # sums and vertices of a, then vertices of b
            step_first, listed = last, -1
            for r in range(s.ring_start[i], ti.select(step == 0 or is_near, s.ring_start[i + 1], 0)):
                j, face_begin, face_end = _face_at(s, overlay, s.ring[r], i)
                for t in range(face_begin, face_end):
                    for e in range(overlay.first[t], overlay.first[t] + overlay.count[t]):
                        u, n, hats = points.triangle[e], points.normal[e], points.hat[e]
                        hat = choose(j, hats[0], hats[1], hats[2])
                        w = points.share[e] * points.area[e] * hat
                        cluster = n_seeds
                        if w > 0.0:
                            cluster = _cluster(seeds, n_seeds, s.body[u], n)
                            is_complete = is_complete and (cluster < n_seeds or k == n_seeds)
                        if w > 0.0 and cluster == k:
                            if k == n_seeds:
                                other, opposite = s.body[u], s.triangle[u, 0]
                                seeds[k, 0], seeds[k, 1], seeds[k, 2], seeds[k, 3] = n[0], n[1], n[2], other
                                n_seeds += 1
                            if step == 0:
                                area, nearest = area + points.area[e] * hat, nearest + w * points.nearest[e]
                                total, normal, apart = total + w, normal + w * n, apart + w * points.apart[e]
                            is_master = (step == 0) == (own > other)
                            if is_master and s.node[opposite] < 0:
                                carried += w * on_face(s, overlay, u, shapes(overlay, u, points.master[e]), move)
                            else:
                                face, b = t, points.slave[e]
                                if is_master:
                                    face, b = u, points.master[e]
                                if face != listed:
                                    last = _list_face(s, overlay, out, face, places, step_first, last, list_end)
                                    listed = face
                                parts = w * shapes(overlay, face, b)
                                for node in range(n_face(overlay, face)):
                                    at_node = places[node]
                                    if at_node >= 0:  # not +=, which would be atomic
                                        out.weight[at_node] = out.weight[at_node] + parts[node]
            if step == 0:
                is_near = k < n_seeds and nearest <= ti.cast(FARTHEST, ti.f64) * total * s.margin[0]
                n_first = last - first
        if not is_near:
            last = first
        else:
            n, point, zero = unit(normal), dvec(0.0), dvec(0.0)
            for e in range(first, ti.min(last, list_end)):
                out.weight[e] = out.weight[e] / total
                if (e - first < n_first) == (own <= other):
                    point += out.weight[e] * s.x[out.vertex[e]]
            # a vertex of either side, without weight, says which collider it is
            one, far = ivec(i, -1, -1), ivec(ti.select(own == other, i, opposite), -1, -1)
            write_contact(out, at, end, own, other, ivec(MORTAR, i, other), point, n, apart.dot(n) / total, one, zero, far, zero)
            if at < end:
                out.entries[at], out.area[at], out.carried[at] = ivec(first, n_first, last - first), area, carried / total
            at += 1
        k += 1
    return at, last


@ti.func
def _write_contacts(
    s: ti.template(), overlay: ti.template(), points: ti.template(), move: ti.template(), lists: ti.template(), out: ti.template()
):
    """Append the contacts of all slave nodes to the buffer. A top-level loop of a kernel."""
    ti.loop_config(serialize=s.serial)
    for task in range(s.chunks * s.spread):
        if task % s.spread == 0:
            c = task // s.spread
            at, end = c * out.part + out.used[c], (c + 1) * out.part
            last, list_end = c * lists.part, (c + 1) * lists.part
            if points.count[NEEDED] <= points.part:  # else the search is repeated
                for i in range(part_first(c, s.n_verts, s.chunks), part_first(c + 1, s.n_verts, s.chunks)):
                    if overlay.is_slave[i] == 1:
                        before = at
                        at, last = _node_contacts(s, overlay, points.data, move, i, out.data, at, end, last, list_end)
                        overlay.contacts[i] = ti.Vector([before, at - before], ti.i32)
            out.used[c], lists.used[c] = at - c * out.part, last - c * lists.part


@ti.func
def _is_beside(s: ti.template(), overlay: ti.template(), out: ti.template(), nodes, other):
    """Whether a corner node of the faces at one of three vertices (-1 for none) has a mortar contact with collider `other`."""
    found = False
    for k in ti.static(range(3)):
        if nodes[k] >= 0:
            t = s.ring[s.ring_start[nodes[k]]]
            for j in range(ti.select(overlay.quarter[t] < 0, 1, 3)):
                i = nodes[k]
                if overlay.quarter[t] >= 0:
                    i = face_vertex(s, overlay, t, j)
                for row in range(overlay.contacts[i][0], overlay.contacts[i][0] + overlay.contacts[i][1]):
                    found = found or out.feature[row][2] == other
    return found


@kernel(cse=False)
def find_mortar(
    surface: ti.template(),
    near: ti.template(),
    row: ti.template(),
    overlay: ti.template(),
    points: ti.template(),
    move: ti.template(),
    lists: ti.template(),
    out: ti.template(),
):
    """Append the mortar contacts to those by proximity in `out`, and mark which of these are guards.

    near, row: as for `visit_near`; overlay: an Overlay; points: its buffer; move: displacements of vertices in the step [m], of
    which those of obstacles are read; lists: buffer of the vertices of `out`.
    """
    ti.loop_config(serialize=surface.serial_cheap)
    for t in range(surface.n_triangles):
        overlay.count[t] = 0
    ti.loop_config(serialize=surface.serial_cheap)
    for i in range(surface.n_verts):
        overlay.is_near[i], overlay.is_slave[i], overlay.contacts[i] = 0, 0, ti.Vector([0, 0], ti.i32)
    ti.loop_config(serialize=surface.serial_cheap)
    for c in range(out.chunks):
        points.used[c] = 0
        for at in range(c * out.part, c * out.part + ti.min(out.used[c], out.part)):
            for k in ti.static(range(3)):
                for v in ti.static((out.data.nodes_a, out.data.nodes_b)):
                    if v[at][k] >= 0:
                        overlay.is_near[v[at][k]] = 1
    visit_near(surface, near, row, overlay, points, 1)  # keeps what the search by proximity needs of `row`
    sum_parts(surface.team, points)
    ti.loop_config(serialize=surface.serial_cheap)
    for i in range(surface.n_verts):
        if overlay.is_slave[i] == 1 and points.count[NEEDED] <= points.part:
            overlay.coverage[i] = _coverage(surface, overlay, points.data, i)
    ti.loop_config(serialize=surface.serial_cheap)
    for t in range(surface.n_triangles):
        if overlay.count[t] > 0 and points.count[NEEDED] <= points.part:
            for e in range(overlay.first[t], overlay.first[t] + overlay.count[t]):
                points.data.hat[e] = _hats(surface, overlay, t, points.data.slave[e])
    _write_contacts(surface, overlay, points, move, lists, out)
    ti.loop_config(serialize=surface.serial_cheap)
    for task in range(out.chunks * surface.cheap_spread):
        if task % surface.cheap_spread == 0:
            c = task // surface.cheap_spread
            for at in range(c * out.part, c * out.part + ti.min(out.used[c], out.part)):
                kind, body = out.data.feature[at][0], out.data.body[at]
                if kind == VERTEX_FACE or kind == EDGE_EDGE:
                    of_a = _is_beside(surface, overlay, out.data, out.data.nodes_a[at], body[1])
                    of_b = _is_beside(surface, overlay, out.data, out.data.nodes_b[at], body[0])
                    out.data.guard[at] = int(of_a or of_b)
    sum_parts(surface.team, lists)
    sum_parts(surface.team, out)
    sum_parts(surface.team, row)
