"""The frictional problem of a linearised stage on one thread: multipliers, linear solves and step lengths in one launch.

It is the loop of `newton.Newton` over such a stage, whose docstring says what it does; on threads and on CUDA that one drives the
same functions from the host. A launch does no more than so many iterations of conjugate gradients, so that Ctrl-C is heard; where
the loop stands is kept in `loop`, and the next launch goes on.
"""

import taichi as ti

from taisoft.contact.problem import RESIDUAL
from taisoft.dynamics.contact_terms import PAST, press_contact, set_multiplier, sum_residual
from taisoft.dynamics.linearised import begin_contact, begin_node, go_along, pressed_residual, step_length
from taisoft.dynamics.multipliers import FINER, MAX_MULTIPLIERS, R_EXTRAPOLATED, extrapolate, next_scale
from taisoft.linear import pcg_serial
from taisoft.linear.pcg import NEGATIVE
from taisoft.linear.pcg import RUNNING as UNFINISHED
from taisoft.runtime import kernel

ROUNDING = 4.0  # times the floor: what rounding may leave, as strains grow (up to 2.8 times was seen, in a thin sheet)
PROGRESS = 0.3  # share of what a new multiplier left of |r| that the steps bring it down to

# places in `loop`: |r|, R over the r-factors, the laws' residual when multipliers were last renewed, what |r| is to come down to
# then, |r| before the last step, steps since; in all: linear solves, their iterations, multipliers; 1 where |r| is rounding, 1
# within a linear solve, its iterations so far, 1 where the matrix is that of the last solve, how the loop stands, renewals of
# multipliers that are remembered
NORM, SCALE, LAW, GOAL, PREVIOUS, TAKEN, SOLVES, LINEAR, MULTIPLIERS, AT_ROUNDING, WITHIN, OWN, SAME, VERDICT, KNOWN = range(15)
RUNNING, SOLVED, GIVEN_UP, INDEFINITE = range(4)
# places in `limits`: |r| [N s] that ends the loop, that ends the steps under one multiplier, that is rounding; the laws' residual
# that ends the loop, too, tolerance of linear solves; how many of these, iterations of one, those in a launch, multipliers before
# they are extrapolated; least tolerance of later solves
ENOUGH, ENOUGH_OF_ONE, FLOOR, LAWFUL, TOLERANCE, MOST_SOLVES, LONGEST, BUDGET, PLAIN, LATER = range(10)


@ti.func
def _press(m: ti.template(), s: ti.template(), k: ti.template(), beta, r_scale):
    """Impulses and blocks at the present x, the laws' residual; returns |r| on the free axes."""
    for c in range(k.problem.count[0]):
        press_contact(m, k, c, beta, r_scale)
    sum_residual(k)
    square = ti.cast(0.0, ti.f64)
    for i in range(m.n_nodes):
        square += pressed_residual(m, s, k, i)
    return ti.sqrt(square)


@ti.func
def _advance(m: ti.template(), s: ti.template(), A: ti.template(), k: ti.template(), beta, r_scale):
    """Go where the slope vanishes, as `linearised.advance`."""
    slope, curvature = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
    for i in range(m.n_nodes):
        own_slope, own_curvature = begin_node(m, s, A, k, i)
        slope += own_slope
        curvature += own_curvature
    at_rest = slope
    for c in range(k.problem.count[0]):
        at_rest += begin_contact(s, k, c, beta)
    a = step_length(k, at_rest, curvature, slope, r_scale)
    for i in range(m.n_nodes):
        go_along(m, s, k, i, a, beta)


@kernel
def solve_frictional(
    m: ti.template(), s: ti.template(), A: ti.template(), k: ti.template(), beta: ti.f64, limits: ti.types.ndarray(),
    loop: ti.types.ndarray(),
):  # fmt: skip
    """Go on from where `loop` stands; limits (10,)."""
    (p,) = ti.static((k.problem,))
    ti.loop_config(serialize=True)
    for _ in range(1):
        r, scale, law_before, enough, floor = loop[NORM], loop[SCALE], loop[LAW], limits[ENOUGH], limits[FLOOR]
        goal, previous, taken, rounding = loop[GOAL], loop[PREVIOUS], loop[TAKEN], loop[AT_ROUNDING]
        work, budget, longest, verdict = 0, ti.cast(limits[BUDGET], ti.i32), ti.cast(limits[LONGEST], ti.i32), RUNNING
        while verdict == RUNNING and work < budget:
            renewed, moved = False, False
            law = p.state[RESIDUAL]
            extrapolating = loop[MULTIPLIERS] >= limits[PLAIN]
            enough_of_one = limits[ENOUGH_OF_ONE] * (FINER if extrapolating else 1.0)
            lawful, near = law <= limits[LAWFUL], r <= ti.max(enough_of_one, goal) or rounding == 1.0
            if loop[WITHIN] == 0.0 and (near or (lawful and r <= enough)):
                if lawful and (r <= ti.max(enough, floor) or rounding == 1.0):
                    verdict = SOLVED
                elif loop[MULTIPLIERS] >= MAX_MULTIPLIERS:
                    verdict = GIVEN_UP
                else:
                    if extrapolating:
                        extrapolate(k, ti.cast(loop[KNOWN], ti.i32))
                        scale, loop[KNOWN] = R_EXTRAPOLATED, ti.min(loop[KNOWN] + 1.0, PAST)
                    else:
                        scale = next_scale(scale, law, law_before, taken)
                        for c in range(p.count[0]):
                            set_multiplier(k, c)
                    law_before = law
                    previous, taken, renewed = 0.0, 0.0, True
                    loop[MULTIPLIERS] = loop[MULTIPLIERS] + 1.0
                work += 1
            elif loop[WITHIN] == 0.0 and loop[SOLVES] >= limits[MOST_SOLVES]:
                verdict = GIVEN_UP
            else:
                if loop[WITHIN] == 0.0:
                    pcg_serial.start(m, A, k.coupling, s.pcg, ti.cast(loop[SAME], ti.i32))
                    loop[SAME] = 1.0
                    loop[OWN] = 0.0
                n = ti.min(budget - work, longest - ti.cast(loop[OWN], ti.i32))
                tolerance = limits[TOLERANCE]
                if loop[SOLVES] > 0.0:
                    tolerance = ti.max(tolerance, limits[LATER])
                count, stop = pcg_serial.iterations(m, A, k.coupling, s.pcg, n, tolerance)
                loop[OWN] = loop[OWN] + count
                loop[LINEAR] = loop[LINEAR] + count
                work += count + 1
                loop[WITHIN] = 0.0
                if stop == UNFINISHED and loop[OWN] < longest:
                    loop[WITHIN] = 1.0
                else:
                    loop[SOLVES] = loop[SOLVES] + 1.0
                    taken += 1.0
                    previous = r
                    if stop == NEGATIVE:
                        verdict = INDEFINITE
                    else:
                        _advance(m, s, A, k, beta, scale)
                        moved = True
            if renewed or moved:
                r = _press(m, s, k, beta, scale)
                rounding = 1.0 if moved and r <= ROUNDING * floor and r > 0.5 * previous else 0.0
                if renewed:
                    goal = PROGRESS * r
                elif not r < ti.math.inf:
                    verdict = GIVEN_UP
        loop[NORM], loop[SCALE], loop[LAW] = r, scale, law_before
        loop[GOAL], loop[PREVIOUS], loop[TAKEN], loop[AT_ROUNDING], loop[VERDICT] = goal, previous, taken, rounding, verdict
