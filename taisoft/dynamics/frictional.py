"""The frictional problem of a linearised stage on one thread: multipliers, linear solves and step lengths in one launch.

It is the loop of `newton.Newton` over such a stage, whose docstring says what it does; on threads and on CUDA that one drives the
same functions from the host. A launch does at most `budget` iterations of conjugate gradients, so that Ctrl-C is heard; where the
loop stands is kept in `loop`, and the next launch goes on.
"""

import taichi as ti

from taisoft.contact.problem import RESIDUAL
from taisoft.dynamics.contact_terms import press_contact, set_multiplier, sum_residual
from taisoft.dynamics.linearised import begin_contact, begin_node, go_along, pressed_residual, step_length
from taisoft.linear import pcg_serial
from taisoft.linear.pcg import NEGATIVE
from taisoft.linear.pcg import RUNNING as UNFINISHED
from taisoft.runtime import kernel

ROUNDING = 4.0  # times the floor: what rounding may leave, as strains grow (up to 2.8 times was seen, in a thin sheet)
PROGRESS = 0.3  # share of what a new multiplier left of |r| that the steps bring it down to
R_SCALE, SOFTEST, STIFFEST, MANY = 1.0, 0.3, 100.0, 5  # R over the r-factors at first and its bounds; steps that are many
RISEN_LAW, STEADY = 1.2, 4.0  # times the laws' residual of before: R is too large, unless it is below that
MAX_MULTIPLIERS = 200

# places in `loop`: |r|, that of the held axes, R over the r-factors, the laws' residual when multipliers were last renewed, what
# |r| is to come down to then, |r| before the last step, steps since; in all: linear solves, their iterations, multipliers;
# 1 where |r| is rounding, 1 within a linear solve, its iterations so far, how the loop stands
NORM, HELD, SCALE, LAW, GOAL, PREVIOUS, TAKEN, SOLVES, LINEAR, MULTIPLIERS, AT_ROUNDING, WITHIN, OWN, VERDICT = range(14)
RUNNING, SOLVED, GIVEN_UP, INDEFINITE = range(4)


@ti.func
def next_scale(scale, law, before, taken, stiffest):
    """R over the r-factors for new multipliers."""
    new = scale
    if law > RISEN_LAW * before and scale > STEADY:  # friction disks and normal impulses drive each other up
        new = 0.5 * scale
    elif taken <= 1:
        new = ti.min(stiffest, 2.0 * scale)
    elif taken >= MANY:
        new = ti.max(SOFTEST, 0.5 * scale)
    return new


@ti.func
def _norms(m: ti.template(), s: ti.template(), k: ti.template(), pcg: ti.template()):
    """(|r|^2 on the free axes, on the others), with the laws' residual."""
    sum_residual(k)
    free, held = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
    for i in range(m.n_nodes):
        own, other = pressed_residual(m, s, k, pcg, i)
        free += own
        held += other
    return free, held


@ti.func
def _advance(m: ti.template(), s: ti.template(), A: ti.template(), k: ti.template(), pcg: ti.template(), beta, r_scale):
    """As `linearised.advance`."""
    slope, curvature = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
    for i in range(m.n_nodes):
        own_slope, own_curvature = begin_node(m, s, A, k, pcg, i)
        slope += own_slope
        curvature += own_curvature
    at_rest = slope
    for c in range(k.problem.count[0]):
        at_rest += begin_contact(k, pcg, c, beta)
    a, _slope = step_length(k, at_rest, curvature, slope, r_scale)
    for i in range(m.n_nodes):
        go_along(m, s, k, pcg, i, a, beta)


@kernel
def solve_frictional(
    m: ti.template(), s: ti.template(), A: ti.template(), k: ti.template(), pcg: ti.template(), same_matrix: ti.i32,
    beta: ti.f64, dt: ti.f64, standoff: ti.f64, fast: ti.f64, slow: ti.f64, fastest: ti.f64, enough: ti.f64, lawful: ti.f64,
    floor: ti.f64, tolerance: ti.f64, stiffest: ti.f64, solves: ti.i32, longest: ti.i32,
    budget: ti.i32, loop: ti.types.ndarray(),
):  # fmt: skip
    """Go on from where `loop` stands.

    enough, floor: |r| [N s] that ends the loop, and what is rounding; lawful: the laws' residual that ends it, too.
    tolerance: of linear solves; stiffest: the largest R over the r-factors; solves: at most so many; longest: iterations of one
    at most. same_matrix: see `pcg.solve`.
    """
    (p,) = ti.static((k.problem,))
    ti.loop_config(serialize=True)
    for _ in range(1):
        r, held, scale, law_before = loop[NORM], loop[HELD], loop[SCALE], loop[LAW]
        goal, previous, taken, rounding = loop[GOAL], loop[PREVIOUS], loop[TAKEN], loop[AT_ROUNDING]
        work, verdict, same = 0, RUNNING, same_matrix
        while verdict == RUNNING and work < budget:
            if loop[WITHIN] == 0.0 and (r <= ti.max(enough, goal) or rounding == 1.0):
                law = p.state[RESIDUAL]
                low = r <= ti.max(enough, floor) or rounding == 1.0
                if low and law <= lawful:
                    verdict = SOLVED
                elif loop[MULTIPLIERS] >= MAX_MULTIPLIERS:
                    verdict = GIVEN_UP
                else:
                    scale = next_scale(scale, law, law_before, taken, stiffest)
                    law_before = law
                    for c in range(p.count[0]):
                        set_multiplier(s, k, c, beta, dt, standoff, fast, slow, fastest, False)
                        press_contact(m, k, c, beta, scale)
                    free, other = _norms(m, s, k, pcg)
                    r, held = ti.sqrt(free), ti.sqrt(other)
                    goal, previous, taken, rounding = PROGRESS * r, 0.0, 0.0, 0.0
                    loop[MULTIPLIERS] = loop[MULTIPLIERS] + 1.0
                work += 1
            elif loop[WITHIN] == 0.0 and loop[SOLVES] >= solves:
                verdict = GIVEN_UP
            else:
                if loop[WITHIN] == 0.0:
                    pcg_serial.start(m, A, k.coupling, pcg, same)
                    same = 1
                    loop[OWN] = 0.0
                n = ti.min(budget - work, longest - ti.cast(loop[OWN], ti.i32))
                count, stop = pcg_serial.iterations(m, A, k.coupling, pcg, n, tolerance)
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
                        _advance(m, s, A, k, pcg, beta, scale)
                        for c in range(p.count[0]):
                            press_contact(m, k, c, beta, scale)
                        free, other = _norms(m, s, k, pcg)
                        r, held = ti.sqrt(free), ti.sqrt(other)
                        rounding = 1.0 if r <= ROUNDING * floor and r > 0.5 * previous else 0.0
                        if not r < ti.math.inf:
                            verdict = GIVEN_UP
        loop[NORM], loop[HELD], loop[SCALE], loop[LAW] = r, held, scale, law_before
        loop[GOAL], loop[PREVIOUS], loop[TAKEN], loop[AT_ROUNDING], loop[VERDICT] = goal, previous, taken, rounding, verdict
