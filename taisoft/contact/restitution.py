"""Restitution: the speed at which surfaces that meet within a step separate.

Newton's law, u+ = -e u-, relates two velocities at one place. A step sees the surfaces at its start, with a gap that gravity has
yet to close, and moves x from there with the velocity after the impact. Applied literally, the law lifts the bodies by the height
that they did not fall, which creates energy. Therefore

* explicit steps apply the law to the velocity at the time of x_n and add the rest of the step's velocity change afterwards:
      u >= -e u_s + (u* - u_s),   u* the velocity that the step would reach without impulses.
  In velocity Verlet u_s = u_n. In symplectic Euler v_n belongs to t_n - dt/2 (it is the leapfrog scheme), so u_s = (u_n + u*)/2.
  With e = 1 the velocity is reversed at x_n. This preserves the energy that the scheme conserves, which is even in v_s;
* implicit steps begin with an impact (`taisoft.dynamics.impact`), after which contacts separate at the speed w,
      w^2 = e^2 (u_n^2 + L + 2 a d) - 2 a d,
  d the gap less the contact offset, a >= 0 the acceleration with which gravity closes it: e^2 times the energy at which the
  surfaces would meet, less the potential energy of d, so that bodies rise to e^2 of the height of their fall.
  L = a^2 sum dt^2 over the steps of the flight is the energy that implicit Euler lost, (a dt)^2 / 2 in each. It is restored, but
  raises the speed of meeting by at most a dt, the speed that implicit Euler loses in a flight up and down.

Weak: bodies reverse where the step begins, up to a step's displacement above the surface. L is exact for a body that touches
nothing and has no fixed nodes; for others no loss is assumed. The loss of the flight's rotation is not restored.
"""

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.contact.targets import contact_offset_of

NEGLIGIBLE_OPENING = 0.01  # of the contact offset: a rebound that opens the gap less in a step is ignored


@ti.func
def explicit_opening(p: ti.template(), c, dt, common_offset, free, kick_fraction):
    """Least opening of contact c in an explicit step due to restitution [m], 0 without; free: u* along the normal [m/s].

    kick_fraction: fraction of the step's velocity change u* - u_n that precedes the impact.
    """
    opening, u = ti.cast(0.0, ti.f64), (1.0 - kick_fraction) * p.approach[c] + kick_fraction * free
    if p.restitution[c] > 0.0 and u < 0.0 and p.gap[c] - contact_offset_of(p, c, common_offset) + dt * free < 0.0:
        opening = ti.max(0.0, dt * (free - u - p.restitution[c] * u))
    return opening


@kernel
def find_rebounds(p: ti.template(), gravity: ti.template(), flight: ti.template(), dt: ti.f64, common_offset: ti.f64) -> ti.i32:
    """Set `min_velocity` and `min_opening` of every contact for an implicit step of dt. Return the number of rebounds.

    gravity: field of one 3-vector [m/s^2]. flight: (n_colliders) f64, sum of dt^2 over the steps of a collider's flight [s^2], 0
    if it is not in flight. A contact without a rebound may close, or approach as fast as it separates now, which takes no work.
    """
    rebounds = 0
    ti.loop_config(serialize=p.on_cpu)
    for c in range(p.count[0]):
        u, e, contact_offset = p.approach[c], p.restitution[c], contact_offset_of(p, c, common_offset)
        distance = ti.max(0.0, p.gap[c] - contact_offset)
        a, b = p.body[c][0], p.body[c][1]
        gravity_n = p.normal[c].dot(ti.cast(gravity[0], ti.f64))
        closing = ti.max(0.0, -gravity_n * (ti.cast(flight[a] > 0.0, ti.f64) - ti.cast(flight[b] > 0.0, ti.f64)))
        velocity, opening = -ti.max(distance / dt, u), ti.cast(0.0, ti.f64)
        if e > 0.0 and u < 0.0 and p.gap[c] - contact_offset + dt * (u - dt * closing) < 0.0:
            impact_speed = ti.min(dt * closing - u, ti.sqrt(u * u + ti.abs(flight[a] - flight[b]) * closing * closing))
            w_squared = e * e * (impact_speed * impact_speed + 2.0 * closing * distance) - 2.0 * closing * distance
            w = ti.sqrt(ti.max(0.0, w_squared))
            opened = dt * (w - dt * ti.abs(gravity_n))
            if opened > NEGLIGIBLE_OPENING * contact_offset:
                velocity, opening = w, opened
                rebounds += 1
        p.min_velocity[c], p.min_opening[c] = velocity, opening
    return rebounds
