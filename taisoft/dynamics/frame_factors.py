"""r-factors of contacts with rigid bodies.

The diagonal of A would give factors too large by as much as the bodies are stiff, and the laws' residual with them. Those of a
contact with a rigid body come from J A_b^-1 J^T, with the block A_b (12, 12) of the body's four nodes.
"""

import numpy as np

from taisoft.backend.arrays import download, upload
from taisoft.contact.matrix_contacts import frames
from taisoft.contact.problem import ContactProblem, read_entries
from taisoft.fem.model import Model
from taisoft.linear.block_csr import BlockCsr, unpacked
from taisoft.scene.rigid import FRAME


def set_frame_factors(m: Model, A: BlockCsr, diagonal, p: ContactProblem) -> None:
    """Set the factors of the contacts with rigid bodies. diagonal: field of A's diagonal blocks without the contacts' terms."""
    contact, node, weight = read_entries(p)
    number = m.rigid_tets.number.to_numpy()[node]
    is_rigid = np.zeros(int(p.count[0]), dtype=bool)
    is_rigid[contact[number >= 0]] = True
    if not is_rigid.any():
        return
    own = is_rigid[contact]
    contact, node, number = contact[own], node[own], number[own]
    J = weight[own, None, None] * frames(p)[contact]  # (entries, axes of the contact, of the node)
    soft, compliance = number < 0, np.zeros((len(is_rigid), 3))  # the latter: the diagonal of W
    np.add.at(compliance, contact[soft], np.einsum("eij,ej,eij->ei", J[soft], p.inverse_mass.to_numpy()[node[soft]], J[soft]))
    try:
        inverse, free = _inverse_blocks(m, A, diagonal)
    except np.linalg.LinAlgError:  # those of the diagonal stay
        return
    body, corner = np.divmod(number[~soft], FRAME)
    sides, at = np.unique(contact[~soft] * len(inverse) + body, return_inverse=True)
    rows = np.zeros((len(sides) * FRAME, 3, 3))
    np.add.at(rows, at * FRAME + corner, J[~soft])
    contact, body = np.divmod(sides, len(inverse))
    rows = rows.reshape(-1, FRAME, 3, 3) * free[body][:, :, None, :]
    rows = rows.swapaxes(1, 2).reshape(-1, 3, 3 * FRAME)
    np.add.at(compliance, contact, ((rows @ inverse[body]) * rows).sum(axis=2))
    compliance = np.stack([compliance[:, 0], compliance[:, 1:].max(axis=1)], axis=1)
    factor = p.factor.to_numpy()
    np.divide(1.0, compliance, out=factor[: len(is_rigid)], where=is_rigid[:, None] & (compliance > 0.0))
    upload([(p.factor, factor)])


def _inverse_blocks(m: Model, A: BlockCsr, diagonal) -> tuple[np.ndarray, np.ndarray]:
    """A_b^-1 on the free axes (n, 12, 12), and the free axes (n, 4, 3), of all rigid bodies."""
    tets, axes = m.rigid_tets, 3 * FRAME
    node, pair = tets.node.to_numpy().reshape(-1, FRAME), tets.pair_at.to_numpy().reshape(-1, FRAME, FRAME)
    value, own, free = download([A.value, diagonal, m.free])
    blocks = unpacked(np.where((pair >= 0)[..., None], value[pair], own[node][:, :, None]).reshape(-1, value.shape[1]))
    blocks = blocks.reshape(-1, FRAME, FRAME, 3, 3).swapaxes(2, 3).reshape(-1, axes, axes)
    free = (free[node] > 0.0).astype(np.float64)
    mask = free.reshape(-1, axes)
    blocks = blocks * mask[:, :, None] * mask[:, None, :] + np.eye(axes) * (1.0 - mask)[:, None]
    return np.linalg.inv(blocks), free
