"""Other settings that were tried for the works, with their results; a table of the page.

Single manual runs with the versions of `VERSIONS`, without times. Errors and depths are defined as on the page.
"""

VERSIONS = "mujoco 4.0.0 where no other is named, pybullet 3.2.7, newton 1.8.0, warp-lang 1.19.0, November 2026"
TRIED = {  # by program: (work or "all", setting, result)
    "MuJoCo": (
        ("W1", "discrete with the solver Newton in place of CG", "the same path: without rows neither solver runs"),
        ("all", "integrator implicit", "refused in the same words as implicitfast"),
        (
            "all",
            "Newton beside CG to 1e-15 on the same states of piles, chains and flexes, sparse; releases 3.17.0, 4.0.0, 4.0.1",
            "equal costs, but in 4.0.0, on chains with elliptic cones, Newton's is 15 times CG's after 200 iterations",
        ),
        (
            "all",
            "releases 4.0.0 and 4.0.1: W1 12x3x3 by discrete, the rows of W2, and those of W3 and W4 with the solver Newton",
            "the same bits (W2 to W4 over 0.4 s)",
        ),
        (
            "W2",
            "passive contact with Euler",
            "refused: passive flex contact requires an integrator with the effective metric: set integrator='discrete'",
        ),
        (
            "W4",
            "stable neo-Hookean (elastic3d) with Euler",
            "refused: stable Neo-Hookean elasticity requires integrator='discrete'",
        ),
        ("W2", "passive, SNH13, 2.5 ms, tolerance 1e-4, 1e-6 and 1e-8", "errors of 10.4, 10.3 and 10.3 %"),
        ("W2", "rows, SNH13, 5 ms, the solver Newton in place of CG", "the same error (11.5 %), four times the time"),
        ("W2", "rows, SNH13, 5 ms, pyramidal in place of elliptic cones", "an error of 12.0 in place of 11.5 %"),
        (
            "W2",
            "rows, SNH13, 2.5 ms: solref 0.1 ms, the same with refsafe off, solimp 0.99 0.9999 0.0001, condim 1",
            "errors of 9.0 to 9.7 %",
        ),
        (
            "W2",
            "rows, SVK, Euler of 1 ms with solimp 0.99 0.9999 0.0001, also CG, also a damping ratio of 2",
            "errors of 8.8 to 9.0 %",
        ),
        ("W4", "passive, SNH13, 2.5 ms, radius 0.1, 0.5 and 1 mm", "5 to 7 mm deep: does not stand; 2.5 mm does"),
        ("W4", "passive, SNH13, radius 5 mm, 3.3, 5 and 10 ms", "8 to 9 mm deep; at 10 ms it diverges"),
        (
            "W4",
            "passive, SNH13, 2.5 ms, 100 iterations in place of 400",
            "a third of the steps end before the tolerance: MuJoCo warns of a singular inertia",
        ),
        ("W4", "passive, SNH13, 2.5 ms, tolerance 1e-3 in place of 1e-4", "stands too, no faster by 5 %"),
        ("W4", "rows, SNH13, 2.5 ms, solimp 0.99 0.9999 0.0001", "diverges before t = 0.5 s"),
        ("W3", "passive, SNH13, 1.67 ms with a radius of 1 mm", "2.8 mm deep: does not stand"),
        ("W3", "passive, SNH13, 1 ms, radius 0.1 mm, and tolerance 1e-3", "stand too, no faster"),
        (
            "all",
            "trilinear and quadratic flexes, edge equality constraints",
            "left out: other unknowns or another material than everyone's nodes and tets",
        ),
    ),
    "PyBullet": (
        ("all", "a newer version", "3.2.7 is the newest on PyPI; no other solver of tets than the one used"),
        ("W3", "5 steps in 10 ms", "180 mm deep: does not stand"),
        ("W4", "10, 14 and 17 steps in 10 ms", "diverges at once"),
    ),
    "Newton": (
        ("all", "a newer version", "1.8.0 is the newest on PyPI"),
        (
            "all",
            "launches from Python in place of a captured graph",
            "the same path; 1.3 times the time in W4, up to 4 times in W1",
        ),
        (
            "W2",
            "semi_implicit: stiffness and damping for steps of 2.5 to 0.3 ms, radius 0.1 to 3 mm, 33 settings",
            "the best are among the rows; stiffer contact than the lightest node bears at a dt diverges",
        ),
        ("W3, W4", "vbd, stiffness 1e5 and 1e6, gap 1 mm, 1 to 20 sweeps", "bodies hang in the air: steps are cut"),
        ("W4", "vbd, 4 times 5 sweeps in 10 ms, gap 15 mm", "does as with 10 ms, not faster"),
        ("W2", "vbd, 4 times 5 sweeps in 10 ms, stiffness 1e6", "an error of 9.3 %"),
    ),
    "ppf-contact-solver": (
        (
            "all",
            "pip index versions and pip download of ppf-contact-solver and of ppf-cts",
            "no matching distribution: it is not on PyPI, so it is left out",
        ),
    ),
}
