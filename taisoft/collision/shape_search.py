"""A search in scenes where only analytic obstacles can be touched, in one launch."""

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.collision.analytic import write_analytic
from taisoft.collision.candidates import NEEDED
from taisoft.collision.reduction import LEFT, reduce_all
from taisoft.collision.surface import NONFINITE, move_surface
from taisoft.fem.state import EVENT, GO


@kernel(cse=False)
def search_shapes(
    s: ti.template(),
    o: ti.template(),
    x: ti.template(),
    v: ti.template(),
    has_prescribed: ti.template(),
    prescribed: ti.template(),
    dt: ti.f64,
    reach: ti.f64,
    margin: ti.f64,
    out: ti.template(),
    reduction: ti.template(),
    inverse: ti.f64,
    tolerance: ti.f64,
    lowest_gap: ti.f64,
    room: ti.i32,
    event: ti.i32,
):
    """Do what `update_surface`, `find_analytic` and `run_reduction` do, one after the other.

    event: number of the event that ends a batch if positions are not finite, if `out` is too small, or if more than `room`
    contacts are kept; 0 outside of batches.
    """
    move_surface(s, x, v, has_prescribed, prescribed, dt, reach)
    write_analytic(s, o, margin, out, 0)
    reduce_all(reduction, out, inverse, tolerance, lowest_gap)
    ti.loop_config(serialize=True)
    for _ in range(1):
        if event != 0 and s.run[GO] == 1:
            if s.count[NONFINITE] > 0 or out.count[NEEDED] > out.part or reduction.count[LEFT] > room:
                s.run[GO], s.run[EVENT] = 0, event
