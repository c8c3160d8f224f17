"""The registry of material laws by name. To add one, add a file like the others here and list it below.

A law has NAME, SOFTENS_BELOW (the compressive stretch below which it softens, 0 for none), POINT_SECONDS (approximate time of a
quadrature point in an explicit step, which sizes launches), `constants(mu, lam)` (on the host, four numbers per body) and the
lane functions `psi`, `pk1`, `prepare`, `dpk1`, `block` (the same differential along e_k (x) g_a, times g_b, for assembly) and
`hessian_eigen`. Tests over the registry check them against each other by finite differences.
"""

from taisoft.fem.laws import corotational, st_venant_kirchhoff, stable_neo_hookean

LAWS = {law.NAME: law for law in (st_venant_kirchhoff, corotational, stable_neo_hookean)}
