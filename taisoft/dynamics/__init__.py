"""Time integration of a scene: integrators, contacts of a step, constraints."""
