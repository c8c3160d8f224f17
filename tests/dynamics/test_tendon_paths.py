"""Tendons along random paths pull nodes of a soft block over each other and onto each other: every step converges in few Newton
iterations, or ends at the bound and names what is out of balance.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics.newton_budget import NewtonBudget
from taisoft.dynamics.schemes import IMPLICIT
from taisoft.fem.laws import LAWS
from tests.dynamics.companion import add_companion, simulator

TOUCHING = {"newton_tolerance": 1e-8, "linear_tolerance": None}


def random_scene(seed: int, law: str, contact: bool = False) -> ts.Scene:
    """A block of 20 kPa on a fixed side, and a tendon of 1 to 80 N through two to six of its nodes. contact: with itself."""
    rng, scene = np.random.default_rng(seed), ts.Scene()
    scene.contact_forces = contact
    material = ts.Material(law=law, young=2e4, poisson=0.4)
    block = scene.add_body(ts.box_mesh((2, 2, 2), (0.06, 0.06, 0.06)), material, name="block")
    block.fix(lambda X: X[:, 2] < -0.0299)
    path = rng.choice(block.n_nodes, int(rng.integers(2, 7)), replace=False)
    scene.add_tendon([("block", int(node)) for node in path], float(rng.uniform(1.0, 80.0)), name="line")
    return scene


def reports_of(sim: ts.Simulator, steps: int) -> list[ts.StepReport]:
    """Take steps, none above the bound; every one that does not converge names a term and a node."""
    reports = [sim.step() for _ in range(steps)]
    for report in reports:
        text = " ".join(report.problems)
        assert report.converged or ("least balanced is node " in text and " of body 'block', between " in text)
        assert report.newton_iterations <= NewtonBudget.limit
    return reports


@pytest.mark.parametrize("seed", [0, 24, 132])
def test_a_tendon_that_pulls_points_together_takes_few_iterations(seed):
    """Without smooth lengths each of these takes thousands in the first step."""
    with simulator(add_companion(random_scene(seed, "stable_neo_hookean"), True), "implicit_euler", 0.01, **TOUCHING) as sim:
        assert all(report.converged and report.newton_iterations < 50 for report in reports_of(sim, 3))


@pytest.mark.long
@pytest.mark.parametrize("seed", range(200))
def test_no_path_of_a_tendon_takes_more_iterations_than_the_bound(seed):
    law, integrator, contact = list(LAWS)[seed % 3], IMPLICIT[seed // 3 % 4], seed % 5 == 4
    contact &= integrator != "implicit_midpoint"
    with simulator(random_scene(seed, law, contact), integrator, 0.01, self_collision=contact, **TOUCHING) as sim:
        reports_of(sim, 6)
