"""The tets of rigid bodies, for their damping in implicit steps; see `terms.rigid_damping`."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import Count, upload
from taisoft.backend.runtime import kernel
from taisoft.fem import reference
from taisoft.fem.model import Setup
from taisoft.fem.node_graph import NodeGraph
from taisoft.scene.rigid import FRAME

# Relaxation time of a strain, times the lowest angular frequency w of the tet. A body that hits the ground rebounds by
# 1/(w times the time)^2 of its speed, even if dt is short.
RELAXATION = 30.0


@dataclass(frozen=True, eq=False)
class RigidTets:
    """Tets of n rigid bodies: those whose nodes depend on no others."""

    n: Count
    node: Any  # (4 n) i32
    gradient: Any  # (4 n) 3-vectors f64 [1/m]: of the shape functions at rest
    viscosity: Any  # (n) f64 [J s]: stress over strain rate, times volume
    number: Any  # (n_nodes) i32: place of a node in `node`, -1 for others
    pair_at: Any  # (16 n) i32: of each pair of nodes, its block in the stiffness matrix, -1 on the diagonal
    strain: Any  # (n) 9-vectors f64: E_hat
    rate: Any  # (1) f64: 1/beta of the stage [1/s], 0 before the first
    force: Any  # (4 n) 3-vectors f64 [N]: scratch
    inverse: Any  # (144 n) f64: of each body's block of the system's matrix, see `frame_factors`


def model_fields(setup: Setup) -> dict[str, Any]:
    """Fields of Model: the tets of the scene's rigid bodies, to be damped, or moved as rigid bodies.

    If all of them depend on other nodes there are none, and their damping is switched off.
    """
    if not (setup.on["rigid_damping"] or setup.on["rigid_motion"]):
        return {}
    scene, layout, arena = setup.scene, setup.layout, setup.arena
    nodes, gradients, viscosities, independent = [], [], [], layout.dependents.matrix.diagonal() != 0.0
    for k, body in enumerate(scene.bodies):
        own = layout.node_start[k] + body.nodes.elements[0]
        if body not in scene.rigid_bodies or not independent[own].all():
            continue
        shape_gradients, volumes = reference.shape_gradients(body)
        nodes.append(own)
        gradients.append(shape_gradients[0, 0])
        viscosities.append(RELAXATION / body.lowest_frequency * body.young * body.mass / body.density)
    if not nodes:
        setup.on["rigid_damping"] = False
        return {}
    n, node = len(nodes), np.concatenate(nodes)
    number = np.full(len(independent), -1, dtype=np.int32)
    number[node] = np.arange(len(node))
    tets = RigidTets(
        n=n,
        node=arena.filled("rigid_node", ti.i32, node),
        gradient=arena.vectors("rigid_gradient", ti.f64, len(node), np.concatenate(gradients)),
        viscosity=arena.filled("rigid_viscosity", ti.f64, np.array(viscosities)),
        number=arena.filled("rigid_number", ti.i32, number),
        pair_at=arena.field("rigid_pair_at", ti.i32, FRAME * len(node)),
        strain=arena.vectors("rigid_strain", ti.f64, n, n=9),
        rate=arena.field("rigid_rate", ti.f64, 1),
        force=arena.vectors("rigid_force", ti.f64, len(node)),
        inverse=arena.field("rigid_inverse", ti.f64, 36 * len(node)),
    )
    return {"has_rigid_tets": True, "rigid_tets": tets}


def set_pair_entries(tets: RigidTets, graph: NodeGraph) -> None:
    """Set `pair_at` for a matrix with this pattern."""
    node = tets.node.to_numpy().astype(np.int64).reshape(-1, FRAME)
    rows, columns = (a.reshape(-1) for a in np.broadcast_arrays(node[:, :, None], node[:, None, :]))
    upload([(tets.pair_at, np.where(rows == columns, -1, graph.entries(rows, columns)))])


@ti.func
def gradient_of(m: ti.template(), x: ti.template(), k):
    """F (3,3) of tet k at the positions x (n_nodes)."""
    F = ti.Matrix.zero(ti.f64, 3, 3)
    for a in range(FRAME):
        i = m.rigid_tets.node[FRAME * k + a]
        F += (x[i] - x[m.rigid_tets.node[FRAME * k]]).outer_product(m.rigid_tets.gradient[FRAME * k + a])
    return F


@ti.func
def green_strain(F):
    """E = (F^T F - I) / 2."""
    return 0.5 * (F.transpose() @ F - ti.Matrix.identity(ti.f64, 3))


@kernel
def begin_rigid_stage(m: ti.template(), h: ti.template(), multistep: ti.template(), now: ti.f64, before: ti.f64, beta: ti.f64):
    """Set E_hat = now E(x_n) - before E(x_(n-1)) and 1/beta of a stage. h: history."""
    ti.loop_config(serialize=m.on_cpu)
    for k in range(m.rigid_tets.n):
        E = now * green_strain(gradient_of(m, h.x_now, k))
        if ti.static(multistep):
            E -= before * green_strain(gradient_of(m, h.x_before, k))
        for r in ti.static(range(3)):
            for c in ti.static(range(3)):
                m.rigid_tets.strain[k][3 * r + c] = E[r, c]
    m.rigid_tets.rate[0] = 1.0 / beta
