"""Constants of laws in lanes, from the model's table."""

import taichi as ti


@ti.func
def table_constants(m: ti.template(), b, first: ti.template(), n: ti.template(), real: ti.template()):
    """Constants first to first + n - 1 of the tets of block b [Pa and pure numbers]: their own, or their body's in every lane."""
    if ti.static(m.elasticity_by_tet):
        return [
            ti.Vector([ti.cast(m.law_constants[b, first + k, q], real) for q in ti.static(range(m.lanes))])
            for k in ti.static(range(n))
        ]
    else:
        body = m.block_body[b]
        values = [ti.cast(m.law_constants[body, first + k], real) for k in ti.static(range(n))]
        return [ti.Vector([values[k] for q in ti.static(range(m.lanes))]) for k in ti.static(range(n))]
