"""Energies and volume ratios of the present state."""

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.fem.chunks import chunk_entry, chunk_size, fold, total_by_team
from taisoft.fem.lanes import broadcast, mass_times
from taisoft.fem.mean_dilatation import find_dilatations
from taisoft.fem.state import ELASTIC, FIRST_SOFTENED, GRAVITY, KINETIC, LOADS, MIN_J, N_INVERTED
from taisoft.fem.terms import elasticity, gravity, springs
from taisoft.fem.terms.elasticity import HUGE

NO_TET = 2**31 - 1  # above any tet index
SCALARS = (ELASTIC, MIN_J, N_INVERTED, KINETIC, GRAVITY, LOADS, FIRST_SOFTENED)
LEAST = (MIN_J, FIRST_SOFTENED)  # of the partial values of these the least counts, of the others the sum


@ti.func
def _node_energies(m: ti.template(), i):
    """Kinetic energy of node i, and its parts of the potentials of gravity and of loads [J]."""
    kinetic, weight, loads = 0.5 * m.state.v[i].dot(mass_times(m, i, m.state.v)), gravity.energy(m, i), ti.cast(0.0, ti.f64)
    for term in ti.static(m.terms):
        if ti.static(term.LOAD and not term.ACCELERATION):
            loads += term.energy(m, i)
    return kinetic, weight, loads


@kernel
def measure_parts(m: ti.template(), tets: ti.types.ndarray(), nodes: ti.types.ndarray()):
    """Compute elastic energies by lane (n_blocks * lanes,), and those of `_node_energies` (n_nodes, 3) [J], in f64."""
    find_dilatations(m)
    for g in ti.static(m.groups):
        ti.loop_config(serialize=m.serial)
        for b in range(g.first, g.last):
            psi, _, _ = elasticity.element_energy(m, g, b)
            for q in ti.static(range(m.lanes)):
                tets[b * m.lanes + q] = psi[q]
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        nodes[i, 0], nodes[i, 1], nodes[i, 2] = _node_energies(m, i)


@kernel(cse=False)
def measure(m: ti.template()):
    """Compute energies and volume ratios of the present state, in f64 with sums in a fixed order.

    They are written to `State.scalars` at SCALARS; FIRST_SOFTENED is NO_TET if there is none.
    """
    find_dilatations(m)
    ti.loop_config(serialize=m.serial)
    for task in range(m.chunks * m.spread):
        if task % m.spread == 0:
            c = task // m.spread
            energy = broadcast(ti.cast(0.0, ti.f64), m.lanes)
            lowest = broadcast(ti.cast(HUGE, ti.f64), m.lanes)
            inverted = broadcast(ti.cast(0, ti.i32), m.lanes)
            no_tets = broadcast(ti.cast(NO_TET, ti.i32), m.lanes)
            softened = no_tets
            for g in ti.static(m.groups):
                for k in range(chunk_size(m, c, g.last - g.first)):
                    b = g.first + chunk_entry(m, c, k, g.last - g.first)
                    psi, J, soft = elasticity.element_energy(m, g, b)
                    energy += psi
                    lowest = ti.min(lowest, J)
                    inverted += elasticity.count_inverted(m, b, J)
                    tets = ti.Vector([b * m.lanes + q for q in ti.static(range(m.lanes))])
                    softened = ti.min(softened, ti.select(soft == 1, tets, no_tets))
            m.state.partial[c, ELASTIC] = energy.sum()
            m.state.partial[c, MIN_J] = lowest.min()
            m.state.partial[c, N_INVERTED] = ti.cast(inverted.sum(), ti.f64)
            kinetic, weight, loads = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
            for k in range(chunk_size(m, c, m.n_nodes)):
                i = chunk_entry(m, c, k, m.n_nodes)
                own = _node_energies(m, i)
                kinetic += own[0]
                weight += own[1]
                loads += own[2]
            m.state.partial[c, KINETIC], m.state.partial[c, GRAVITY], m.state.partial[c, LOADS] = kinetic, weight, loads
            m.state.partial[c, FIRST_SOFTENED] = ti.cast(softened.min(), ti.f64)
    fold(m, ELASTIC, LOADS, LEAST)
    ti.loop_config(serialize=m.team.alone, block_dim=m.team.threads)
    for t in range(m.team.threads):
        for k in ti.static(SCALARS):
            result = ti.cast(0.0, ti.f64)
            if ti.static(k in LEAST):
                least = m.state.partial[0, k]
                for j in range(m.team.share(t, m.sums)):
                    least = ti.min(least, m.state.partial[m.team.term(t, j), k])
                result = -m.team.largest(t, -least)
            else:
                result = total_by_team(m, t, k)
            if t == 0:
                m.state.scalars[k] = result
        if ti.static(m.has_springs):
            elastic, potential = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
            for j in range(m.team.share(t, m.springs.n_lines)):
                elastic += springs.elastic_energy(m, m.team.term(t, j))
                potential += springs.load_energy(m, m.team.term(t, j))
            elastic, potential = m.team.total(t, elastic), m.team.total(t, potential)
            if t == 0:
                m.state.scalars[ELASTIC] = m.state.scalars[ELASTIC] + elastic
                m.state.scalars[LOADS] = m.state.scalars[LOADS] + potential
