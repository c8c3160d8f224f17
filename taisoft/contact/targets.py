"""Contact offsets, and the smallest gap that a contact may have at the end of a step: its target.

The target is the smallest gap that a contact may have at the end of a step. It is at most the contact offset, a distance that
keeps surfaces apart despite the error of linearising the motion. A gap above the offset may close to it. A gap below it opens
slowly, but in implicit steps at once to LEAST_GAP of it; a true penetration opens within a few steps. Neither is faster than
strains the softest body by one percent: bodies would fly apart otherwise. What touches without a load stays where it is: let w be
the velocity at which sides approach plus that at which the pair's last impulses moved its contacts. While w dt is below STILL of
the offset, gaps above minus the offset open no faster than PRESSED w. Contacts of a body with itself have SELF_CONTACT times the
contact offset and are corrected SELF_CONTACT times as fast. Where the surfaces meet within the step, restitution raises the
target (`restitution`). The impulse must satisfy
    u_n = (gap - target)/dt + n.(v_a - v_b) >= 0,
which counts motion once, since the gap is the one at the start of the step.
"""

import taichi as ti

from taisoft.backend.runtime import kernel

# Of the contact offset: in an implicit step a smaller gap opens to it at once, before surfaces that turn can cross. In the far
# shorter explicit steps that would be a hop.
LEAST_GAP = 0.1
STILL = 0.002  # of the contact offset: surfaces that approach less in a step are at rest
# Below 1, since a gap that opens causes impulses, too: without a load they must fall from step to step, also in a row of bodies
PRESSED = 0.1
GUARD = 0.5  # factor of the contact offset for contacts beside mortar contacts: room for what a mean leaves uneven
SELF_CONTACT = 5.0  # factor of contact offset and correction rate in contacts of a body with itself: folds turn as they meet


@ti.func
def _self_contact_factor(body):
    """SELF_CONTACT if a pair of colliders is one body, else 1."""
    return ti.select(body[0] == body[1], ti.cast(SELF_CONTACT, ti.f64), ti.cast(1.0, ti.f64))


@ti.func
def offset_between(body, is_guard, common):
    """Contact offset [m] of a contact between a pair of colliders; common: that between different bodies."""
    return _self_contact_factor(body) * ti.select(is_guard == 1, GUARD * common, common)


@ti.func
def contact_offset_of(p: ti.template(), c, common):
    """Contact offset of contact c [m]; common: that between different bodies."""
    return offset_between(p.body[c], p.guard[c], common)


@ti.func
def gap_minus_target(
    p: ti.template(), c, dt, common_offset, penetration_fraction, offset_fraction, max_speed, min_opening, least_gap
):
    """gap - target of contact c [m].

    common_offset: contact offset between different bodies [m]. penetration_fraction, offset_fraction: fractions of a penetration
    and of a missing contact offset that the step corrects, at most at max_speed [m/s]. min_opening: for restitution, or 0 [m].
    least_gap: part of the contact offset to which a smaller gap opens at once.
    Where offset_fraction is 1, every gap opens to the contact offset at once.
    """
    gap, own, contact_offset = p.gap[c], _self_contact_factor(p.body[c]), contact_offset_of(p, c, common_offset)
    whole = own * common_offset  # of a guard, too, where it says what rests
    target = contact_offset
    if gap < contact_offset and offset_fraction < 1.0:
        above = ti.max(gap, 0.0)
        opening = own * (offset_fraction * (contact_offset - above) + penetration_fraction * (above - gap))
        if gap >= 0.0:
            opening = ti.max(opening, least_gap * contact_offset - gap)
        pressed = dt * (p.load[c] + ti.max(-p.approach[c], 0.0))
        if gap > -whole and pressed < STILL * whole:
            opening = ti.min(opening, PRESSED * pressed)
        target = gap + ti.min(opening, max_speed * dt)
    if min_opening > 0.0:
        target = ti.max(target, gap + min_opening)
    return gap - target


@kernel
def set_targets(
    p: ti.template(), dt: ti.f64, common_offset: ti.f64, penetration_fraction: ti.f64, offset_fraction: ti.f64, max_speed: ti.f64
):
    """Set the targets of all contacts in an implicit step of dt [s], without restitution; the others as of `gap_minus_target`."""
    none, least = ti.cast(0.0, ti.f64), ti.cast(LEAST_GAP, ti.f64)
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        p.target[c] = p.gap[c] - gap_minus_target(
            p, c, dt, common_offset, penetration_fraction, offset_fraction, max_speed, none, least
        )
