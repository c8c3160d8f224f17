"""Dependent nodes on the device, see `dependent_table`: their places, and the forces that they hand on."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import Count
from taisoft.backend.runtime import kernel
from taisoft.fem.model import Setup


@dataclass(frozen=True, eq=False)
class Dependents:
    """A `DependentTable` on the device, by dependent and by independent node."""

    n: Count
    node: Any  # (n) i32
    start: Any  # (n + 1) i32
    master: Any  # (s) i32
    weight: Any  # (s) f64
    number: Any  # (n_nodes) i32: place of a dependent node in `node`, -1 for others
    of_start: Any  # (n_nodes + 1) i32: first of each independent node in the next two
    of_node: Any  # (s) i32: dependent nodes
    of_weight: Any  # (s) f64


def model_fields(setup: Setup) -> dict[str, Any]:
    """Fields of Model: the dependent nodes, if there are any."""
    table, arena = setup.layout.dependents, setup.arena
    if table is None:
        return {}
    by_master, every = table.rows.tocsc(), np.arange(table.n_nodes)
    by_master.sort_indices()
    number = np.where(np.isin(every, table.node), np.searchsorted(table.node, every), -1)
    dependents = Dependents(
        n=len(table.node),
        node=arena.filled("dependent_node", ti.i32, table.node),
        start=arena.filled("dependent_start", ti.i32, table.start),
        master=arena.filled("dependent_master", ti.i32, table.master),
        weight=arena.filled("dependent_weight", ti.f64, table.weight),
        number=arena.filled("dependent_number", ti.i32, number),
        of_start=arena.filled("dependent_of_start", ti.i32, by_master.indptr),
        of_node=arena.filled("dependent_of_node", ti.i32, table.node[by_master.indices]),
        of_weight=arena.filled("dependent_of_weight", ti.f64, by_master.data),
    )
    return {"has_dependents": True, "most_masters": table.most_masters, "dependents": dependents}


@ti.func
def place(m: ti.template(), k):
    """Set x and v of dependent node number k."""
    x, v = ti.Vector([0.0, 0.0, 0.0], ti.f64), ti.Vector([0.0, 0.0, 0.0], ti.f64)
    for e in range(m.dependents.start[k], m.dependents.start[k + 1]):
        x += m.dependents.weight[e] * m.state.x[m.dependents.master[e]]
        v += m.dependents.weight[e] * m.state.v[m.dependents.master[e]]
    m.state.x[m.dependents.node[k]] = x
    m.state.v[m.dependents.node[k]] = v


@ti.func
def place_all(m: ti.template()):
    """Set x and v of the dependent nodes, as a top-level loop of a kernel."""
    if ti.static(m.has_dependents):
        ti.loop_config(serialize=m.serial)
        for k in range(m.dependents.n):
            place(m, k)


@kernel
def place_dependents(m: ti.template()):
    """Set x and v of the dependent nodes."""
    place_all(m)


@ti.func
def is_dependent(m: ti.template(), i):
    """Whether node i depends on others, which have its forces and its mass."""
    result = False
    if ti.static(m.has_dependents):
        result = m.dependents.number[i] >= 0
    return result


@ti.func
def force_with_dependents(m: ti.template(), term: ti.template(), i):
    """Force of a term on node i, and on the nodes that depend on it [N]."""
    f = term.force(m, i)
    if ti.static(m.has_dependents):
        for e in range(m.dependents.of_start[i], m.dependents.of_start[i + 1]):
            f += ti.cast(m.dependents.of_weight[e], m.real) * term.force(m, m.dependents.of_node[e])
    return f
