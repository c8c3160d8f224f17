"""Projections of the PROX formulation (report, section 2.4) and the contact frame.

An impulse is (normal, t1, t2). With u the relative velocity after the impulse and f the r-factors, the laws of Signorini and
Coulomb hold if r = prox(r - f u): the normal part is not negative, the tangential part lies in the disk of radius
friction * r_n. Both tangents must share one factor: with two, the fixed point satisfies another friction law.
"""

import taichi as ti

dvec = ti.types.vector(3, ti.f64)
OPEN, STICK, SLIP = range(3)  # states of a contact
ON_DISK = 1.0 - 1e-12  # of the disk's radius: a tangential impulse as large was projected onto it, or would be


@ti.func
def tangent(n):
    """A unit vector perpendicular to the unit vector n."""
    a = dvec(0.0)
    smallest = ti.abs(n).min()
    if ti.abs(n[0]) == smallest:
        a[0] = 1.0
    elif ti.abs(n[1]) == smallest:
        a[1] = 1.0
    else:
        a[2] = 1.0
    t = n.cross(a)
    return t / t.norm()


@ti.func
def into_disk(z, radius):
    """Impulse z with its tangential part projected onto the disk of the given radius [N s]."""
    size = ti.sqrt(z[1] * z[1] + z[2] * z[2])
    scale = ti.cast(1.0, ti.f64)
    if size > radius:
        scale = radius / size
    return dvec(z[0], scale * z[1], scale * z[2])


@ti.func
def prox(z, friction):
    """Project z to an admissible impulse: first the normal part, then the tangential part onto its friction disk."""
    normal = ti.max(z[0], 0.0)
    return into_disk(dvec(normal, z[1], z[2]), friction * normal)


@ti.func
def state_of(z, radius):
    """State of a contact by z = r - f u, u tangential, and the radius of its disk. Without a disk it slips, even at rest.

    An impulse r on the disk's boundary, or inside it by a solver's tolerance, slips if u carries z beyond.
    """
    state = OPEN
    if z[0] > 0.0:
        state = ti.select(ti.sqrt(z[1] * z[1] + z[2] * z[2]) >= ti.cast(ON_DISK, ti.f64) * radius, SLIP, STICK)
    return state


@ti.func
def scaled(factor, u):
    """Velocity u times the r-factors (normal, tangential): an impulse."""
    return dvec(factor[0] * u[0], factor[1] * u[1], factor[1] * u[2])
