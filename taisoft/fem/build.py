"""Building a model: each feature brings its fields of `Model`.

A feature is a module with `model_fields(setup)`, which allocates and fills what it adds to the model, and returns nothing if the
plan has it off. To add one, write this function, list the module in FEATURES, and give its fields in Model a default. What needs
the pattern of the stiffness matrix, which follows from the other fields, has `matrix_fields(setup, graph)` instead.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend import parallel
from taisoft.backend.arrays import FieldArena
from taisoft.backend.paths import gpu_threads
from taisoft.backend.runtime import Runtime
from taisoft.backend.team import make_team
from taisoft.fem import dependents, elements, fibres, loads, masses, mean_dilatation, pressure, rigid_tets, springs, viscosity
from taisoft.fem.model import Group, Layout, Model, Setup
from taisoft.fem.pattern import model_graph
from taisoft.fem.state import N_COLUMNS, N_SCALARS, State
from taisoft.fem.terms import rayleigh_damping, terms_of
from taisoft.scene.scene import Scene

FEATURES = (masses, dependents, springs, loads, rigid_tets, rayleigh_damping, mean_dilatation, fibres, viscosity)
ON_PATTERN = {"consistent_mass": masses, "pressure": pressure}  # switch -> module
# Quadrature points from which loops on the CPU are divided into chunks; below, one thread is faster on every machine
CHUNKED_FROM = 20_000


def build_model(scene: Scene, runtime: Runtime, arena: FieldArena, on: dict[str, bool]) -> tuple[Model, Layout]:
    """Allocate and fill the model of a scene. on: the plan's switches; features that are off allocate nothing."""
    layout, kinds = elements.make_layout(scene, runtime.lanes, on)
    setup = Setup(scene, runtime, arena, layout, dict(on))
    fields = elements.model_fields(setup, kinds)
    for feature in FEATURES:
        fields |= feature.model_fields(setup)
    n_nodes, chunks = len(layout.rest), _chunks(runtime, fields["groups"])
    velocity = np.concatenate([np.broadcast_to(body.velocity, body.rest_positions.shape) for body in scene.bodies])
    state = State(
        x=arena.vectors("x", ti.f64, n_nodes, layout.rest),
        v=arena.vectors("v", ti.f64, n_nodes, velocity),
        element_force=arena.field("element_force", runtime.real, 3 * fields["nodes"].entries),
        scalars=arena.field("scalars", ti.f64, N_SCALARS),
        partial=arena.field("partial", ti.f64, (chunks["chunks"], N_COLUMNS)),
    )
    model = Model(
        **fields,
        **chunks,
        real=runtime.real,
        lanes=runtime.lanes,
        on_cpu=runtime.on_cpu,
        team=make_team(arena, "model"),
        n_nodes=n_nodes,
        state=state,
        terms=terms_of(setup.on),
        free=arena.vectors("free", runtime.real, n_nodes, np.ones((n_nodes, 3))),
        gravity=arena.vectors("gravity", runtime.real, 1, scene.gravity[None]),
    )
    late = [ON_PATTERN[switch] for switch in ON_PATTERN if on[switch]]
    graph = model_graph(model)[0] if late and on["assembled_stiffness"] else None
    for feature in late:
        model = replace(model, **feature.matrix_fields(setup, graph))
    return model, layout


def _chunks(runtime: Runtime, groups: tuple[Group, ...]) -> dict[str, Any]:
    """Into how many chunks loops over the model are divided, and whether one thread runs them all."""
    seconds = 3e-9  # of one thread per quadrature point, in the loops with least work
    work = sum((group.last - group.first) * runtime.lanes * group.n_points for group in groups)
    chunks = (1 if work < CHUNKED_FROM else 32) if runtime.on_cpu else gpu_threads(65_536)
    return {"chunks": chunks, "serial": runtime.on_cpu and (chunks == 1 or not parallel.pays(work * seconds))}
