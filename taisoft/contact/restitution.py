"""Restitution: how fast surfaces that meet within a step part again.

Newton's law, u+ = -e u-, is an event between two velocities at one place. A step sees the surfaces at its start, where a gap is
left that gravity still closes, and x moves with the velocity after the impact from there. Taken literally, the law then lifts the
bodies by what they did not fall: energy comes from nowhere. So

* explicit steps apply the law to the velocity of the time that x_n belongs to, and let what is left of the step's forces act on
  the velocity after it:
      u >= -e u_s + (u* - u_s),   u* the velocity that the step would reach without impulses.
  In velocity Verlet u_s = u_n. In symplectic Euler v_n belongs to t_n - dt/2 (it is the leapfrog scheme), so u_s = (u_n + u*)/2.
  With e = 1 the velocity turns round at x_n, which leaves the energy that the scheme keeps, even in v_s, as it is;
* implicit steps have an impact first (`taisoft.dynamics.impact`), that leaves contacts with the speed w,
      w^2 = e^2 (u_n^2 + L + 2 a room) - 2 a room,
  room the gap less the contact offset, a >= 0 the acceleration with which gravity closes it:
  e^2 of the energy that the surfaces would
  meet with, less what the room is worth, so that bodies rise to e^2 of the height of their fall. L = a^2 sum dt^2 over the steps
  of the flight is what implicit Euler took: it loses (a dt)^2 / 2 in each. Bodies are thrown back with that energy too, but with
  a dt more speed at most, which is what it takes in a flight up and down.

Weak: bodies turn round where the step begins, up to a step's way above the surface. L is exact for a body that neither touches
anything nor has fixed nodes; of others nothing is assumed to be lost. What the flight's rotation lost is not given back.
"""

import taichi as ti

from taisoft.contact.assemble import contact_offset_of
from taisoft.runtime import kernel

NEGLIGIBLE_RISE = 0.01  # of the contact offset: a rebound that opens less in a step is none


@ti.func
def explicit_rise(f: ti.template(), c, dt, common_offset, free, kicked):
    """How far contact c must open in an explicit step for its restitution [m], 0 without; free: u* along the normal [m/s].

    kicked: share of the step's change of the velocity, u* - u_n, that comes before the impact.
    """
    rise, u = ti.cast(0.0, ti.f64), (1.0 - kicked) * f.approach[c] + kicked * free
    if f.restitution[c] > 0.0 and u < 0.0 and f.gap[c] - contact_offset_of(f, c, common_offset) + dt * free < 0.0:
        rise = ti.max(0.0, dt * (free - u - f.restitution[c] * u))
    return rise


@kernel
def find_rebounds(
    f: ti.template(), gravity: ti.template(), flight: ti.types.ndarray(), dt: ti.f64, common_offset: ti.f64
) -> ti.i32:
    """Set `leave` and `rise` of every contact for an implicit step of dt. Returns how many contacts are thrown back.

    gravity: field of one 3-vector [m/s^2]. flight: (n_colliders) f64, sum of dt^2 over the steps of a collider's flight [s^2], 0
    where it is in none. Contacts that are not thrown back may close, or approach as fast as they part now, which takes no work.
    """
    (p,) = ti.static((f.problem,))
    found = 0
    ti.loop_config(serialize=True)
    for _ in range(1):
        for c in range(p.count[0]):
            u, e, contact_offset = f.approach[c], f.restitution[c], contact_offset_of(f, c, common_offset)
            room = ti.max(0.0, f.gap[c] - contact_offset)
            a, b = f.body[c][0], f.body[c][1]
            pull = p.normal[c].dot(ti.cast(gravity[0], ti.f64))
            fall = ti.max(0.0, -pull * (ti.cast(flight[a] > 0.0, ti.f64) - ti.cast(flight[b] > 0.0, ti.f64)))
            leave, rise = -ti.max(room / dt, u), ti.cast(0.0, ti.f64)
            if e > 0.0 and u < 0.0 and f.gap[c] - contact_offset + dt * (u - dt * fall) < 0.0:
                met = ti.min(dt * fall - u, ti.sqrt(u * u + ti.abs(flight[a] - flight[b]) * fall * fall))
                square = e * e * (met * met + 2.0 * fall * room) - 2.0 * fall * room
                w = ti.sqrt(ti.max(0.0, square))
                opens = dt * (w - dt * ti.abs(pull))
                if opens > NEGLIGIBLE_RISE * contact_offset:
                    leave, rise = w, opens
                    found += 1
            f.leave[c], f.rise[c] = leave, rise
    return found
