"""The material laws by name. Adding one: a file like the others here, and its line below.

A law has NAME, SOFTENS_BELOW (the stretch in compression below which it softens, 0 for none), POINT_SECONDS (roughly what a
quadrature point takes in an explicit step, which sizes launches), `constants(mu, lam)` (host, four numbers kept per body) and
the lane functions `psi`, `pk1`, `prepare`, `dpk1`, `block` (the same differential along e_k (x) g_a, times g_b, as the assembly
wants it) and `hessian_eigen`; tests over the registry check each against the others by finite differences.
"""

from taisoft.materials import corotational, st_venant_kirchhoff, stable_neo_hookean

LAWS = {law.NAME: law for law in (st_venant_kirchhoff, corotational, stable_neo_hookean)}
