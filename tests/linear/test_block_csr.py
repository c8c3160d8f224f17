"""The assembled stiffness of bodies of both orders, with regions, numbers by tet and a volume floor, is the oracle's, also
projected; the system adds mass, mass damping and stiffness damping.
"""

import numpy as np
import pytest

from taisoft.linear import block_csr
from tests.dynamics.scenes import built
from tests.fem.composition import composition


@pytest.fixture(scope="module", params=[1, 2])
def rig(request):
    with built(composition(request.param), "f64") as made:
        made.matrix = block_csr.build_block_csr(made.model, made.arena)
        made.dx, made.product = made.vectors("dx"), made.vectors("product")
        yield made


# each compiles long
@pytest.mark.parametrize("rig, projected", [(1, True), (2, False)], indirect=["rig"])
def test_the_stiffness_is_the_oracles(rig, projected):
    rng, m = np.random.default_rng(11), rig.model
    x = rig.oracle.rest * [0.6, 1.2, 0.7] + 0.12 * rng.standard_normal(rig.oracle.rest.shape)  # [m]
    expected, d = rig.oracle.stiffness(x, projected), rng.standard_normal(x.shape)
    m.state.x.from_numpy(x)
    rig.matrix.value.fill(np.nan)
    rig.matrix.diagonal.fill(np.nan)
    block_csr.assemble(m, rig.matrix, projected)
    K, size = block_csr.to_bsr(m, rig.matrix).toarray(), np.abs(expected).max()
    assert np.abs(K - expected).max() < 1e-12 * size and np.abs(K - K.T).max() < 1e-14 * size
    assert (np.linalg.eigvalsh(K)[0] > -1e-13 * size) == projected
    rig.dx.from_numpy(d)
    block_csr.multiply(m, rig.matrix, rig.dx, rig.product)
    assert np.abs(rig.product.to_numpy().reshape(-1) - K @ d.reshape(-1)).max() < 1e-13 * size
    assert np.array_equal(block_csr.to_bsr(m, rig.matrix).toarray(), K)


def test_the_system_adds_mass_and_damping(rig):
    """(c + beta a) M + beta^2 K + beta b K_d with each row's damping rates a and b."""
    c, beta, rng = 0.7, 30.0, np.random.default_rng(9)
    damper = block_csr.sibling(rig.matrix, rig.model, rig.arena, "damper")
    for field in (rig.matrix.value, rig.matrix.diagonal, damper.value, damper.diagonal):
        field.from_numpy(block_csr.packed(rng.standard_normal((*field.shape, 3, 3))))
    a, b = (np.repeat(rates, 3)[:, None] for rates in (rig.oracle.mass_damping, rig.oracle.stiffness_damping))
    assert 0.4 in a and 3e-3 in b
    K, K_d = (block_csr.to_bsr(rig.model, A).toarray() for A in (rig.matrix, damper))
    block_csr.to_system(rig.model, rig.matrix, damper, 0, c, beta)
    expected = (c + beta * a) * np.kron(rig.oracle.mass, np.eye(3)) + beta**2 * K + beta * b * K_d
    found = block_csr.to_bsr(rig.model, rig.matrix).toarray()
    assert np.abs(found - expected).max() < 1e-14 * np.abs(expected).max()
