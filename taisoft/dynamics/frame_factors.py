"""r-factors of contacts with rigid bodies.

The diagonal of A would give factors too large by as much as the bodies are stiff, and the laws' residual with them. Those of a
contact with a rigid body come from J A_b^-1 J^T, with the block A_b (12, 12) of the body's four nodes.
"""

import numpy as np
import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.contact.problem import ContactProblem, frame_of
from taisoft.contact.prox import dvec
from taisoft.fem.model import Model
from taisoft.linear.block_csr import BlockCsr, unpacked
from taisoft.scene.rigid import FRAME


def set_frame_factors(m: Model, A: BlockCsr, diagonal, p: ContactProblem) -> None:
    """Set the factors of the contacts with rigid bodies. diagonal: field of A's diagonal blocks without the contacts' terms."""
    try:
        m.rigid_tets.inverse.from_numpy(_inverse_blocks(m, A, diagonal).reshape(-1))
    except np.linalg.LinAlgError:  # those of the diagonal stay
        return
    _set_factors(m, p)


@ti.func
def _product(m: ti.template(), at, to, a, b):
    """a.B b with the block B of corners `at` and `to` of a body in its inverse."""
    found = ti.cast(0.0, ti.f64)
    for i in ti.static(range(3)):
        for j in ti.static(range(3)):
            found += a[i] * m.rigid_tets.inverse[3 * FRAME * (3 * at + i) + 3 * (to % FRAME) + j] * b[j]
    return found


@kernel
def _set_factors(m: ti.template(), p: ti.template()):
    """Set the factors of the contacts with rigid bodies, by the inverse of each body's block."""
    ti.loop_config(serialize=True)
    for c in range(p.count[0]):
        frame = frame_of(p, c)
        compliance, is_rigid = dvec(0.0), 0  # the former: the diagonal of W
        for e in range(p.first[c], p.first[c] + p.arity[c]):
            i, at = p.node[e], m.rigid_tets.number[p.node[e]]
            if at < 0:
                for axis in ti.static(range(3)):
                    row = p.weight[e] * frame[axis, :]
                    compliance[axis] += row.dot(p.inverse_mass[i] * row)
            else:
                is_rigid = 1
                for other in range(p.first[c], p.first[c] + p.arity[c]):
                    j, to = p.node[other], m.rigid_tets.number[p.node[other]]
                    if to >= 0 and to // FRAME == at // FRAME:
                        for axis in ti.static(range(3)):
                            a = p.weight[e] * frame[axis, :] * ti.cast(m.free[i], ti.f64)
                            b = p.weight[other] * frame[axis, :] * ti.cast(m.free[j], ti.f64)
                            compliance[axis] += _product(m, at, to, a, b)
        if is_rigid == 1:
            across = ti.max(compliance[1], compliance[2])
            p.factor[c][0] = ti.select(compliance[0] > 0.0, 1.0 / compliance[0], p.factor[c][0])
            p.factor[c][1] = ti.select(across > 0.0, 1.0 / across, p.factor[c][1])


def _inverse_blocks(m: Model, A: BlockCsr, diagonal) -> np.ndarray:
    """A_b^-1 on the free axes (n, 12, 12) of all rigid bodies; that of fixed ones is 1."""
    tets, axes = m.rigid_tets, 3 * FRAME
    node, pair, value = tets.node.host.reshape(-1, FRAME), tets.pair_at.host.reshape(-1, FRAME, FRAME), A.value.host
    blocks = unpacked(np.where((pair >= 0)[..., None], value[pair], diagonal.host[node][:, :, None]).reshape(-1, value.shape[1]))
    blocks = blocks.reshape(-1, FRAME, FRAME, 3, 3).swapaxes(2, 3).reshape(-1, axes, axes)
    mask = (m.free.host[node] > 0.0).astype(np.float64).reshape(-1, axes)
    return np.linalg.inv(blocks * mask[:, :, None] * mask[:, None, :] + np.eye(axes) * (1.0 - mask)[:, None])
