"""Projections of the PROX formulation (report, section 2.4) and the friction cone's frame.

An impulse is (normal, t1, t2). With u the relative velocity that it leaves behind and f the r-factors, the laws of Signorini and
Coulomb hold where r = prox(r - f u): the normal part is not negative, the tangential part lies in the disk of radius
friction * r_n. Both tangents must share one factor: with two, the fixed point is another friction law.
"""

import taichi as ti

dvec = ti.types.vector(3, ti.f64)


@ti.func
def tangents(n):
    """Two unit vectors that make a right-handed frame with the unit vector n."""
    a = dvec(0.0)
    least = ti.abs(n).min()
    if ti.abs(n[0]) == least:
        a[0] = 1.0
    elif ti.abs(n[1]) == least:
        a[1] = 1.0
    else:
        a[2] = 1.0
    t = n.cross(a)
    t1 = t / t.norm()
    return t1, n.cross(t1)


@ti.func
def into_disk(z, radius):
    """The impulse z with its tangential part brought into the disk of that radius [N s]."""
    size = ti.sqrt(z[1] * z[1] + z[2] * z[2])
    share = ti.cast(1.0, ti.f64)
    if size > radius:
        share = radius / size
    return dvec(z[0], share * z[1], share * z[2])


@ti.func
def prox(z, friction):
    """Nearest admissible impulse: first the normal part, then the tangential one in the disk that it opens."""
    normal = ti.max(z[0], 0.0)
    return into_disk(dvec(normal, z[1], z[2]), friction * normal)


@ti.func
def scaled(factor, u):
    """Velocity u times the r-factors (normal, tangential): an impulse."""
    return dvec(factor[0] * u[0], factor[1] * u[1], factor[1] * u[2])
