"""Tests that `make test` leaves to `make test-long`: variations of what stays, and runs of minutes.

By file, parts of the names after it. What stays of each file tests every path at least once: the other precision, a second
integrator, a second scene, or a coarser case of the same problem.
"""

LONG = {
    "backend/test_arch": ("[cpu-",),
    "dynamics/test_attachments": (
        "test_joint_carries_the_weight[bdf2-f32]",
        "-orders2]",
        *(f"[{name}-orders1]" for name in ("symplectic_euler", "linearly_implicit_euler", "bdf2", "implicit_midpoint")),
    ),
    "backend/test_chunks": ("[mixed-linearly_implicit_euler", "[driven-implicit_midpoint"),
    "faults/test_fuzz": ("[10000-",),
    "dynamics/test_joint_forces": (
        "[damping1-",
        "[damping0-False-",
        "[damping0-True-2]",
        "test_a_joint_balances_momentum_in_every_step[2]",
        "test_contacts_of_attached_nodes_count[implicit_euler",
    ),
    "fem/test_pressure": (
        *(f"constant[{name}]" for name in ("velocity_verlet", "implicit_euler", "linearly_implicit_euler", "implicit_midpoint")),
        *(f"test_batches_and_contacts[{name}]" for name in ("velocity_verlet", "linearly_implicit_euler")),
        "test_a_cube_is_in_a_hydrostatic_state[st_venant_kirchhoff",
    ),
    "fem/test_regions": ("test_explicit_steps_match_the_oracle[velocity_verlet]",),
    "fem/test_mean_dilatation": ("test_stiffness_damping_is_the_projected_matrix[2]",),
    "collision/test_passages": ("[scroll-18]",),
    "cli/test_cli_warm": ("test_f64_demos_compile_nothing_after_warming[gripper]",),
    "benchmarks/test_contact_versions": ("test_drops", "test_steps_without_contacts"),
    "simulator/test_determinism": ("[cube_implicit]", "[cubes_"),
    "faults/test_faults": (
        "test_failing_calls[others]",
        "test_kills_while_files_are_replaced[100]",
        "test_kills_during_runs[20]",
    ),
    "faults/test_faults_memory": (
        "[300000000",
        "[body-implicit_euler]",
        "[ground-",
        "[nothing-implicit_euler]",
        "test_growing_buffers",
    ),
    "references/test_references": (
        "patch_test-",
        "locking-",
        "layered_beam-",
        "rigid_stack",
        "rigid_top-",
        "column_self_weight-",
        "beam_fall_semidiscrete-COR",
        "beam_fall_semidiscrete-SNH-11x2x2_bdf2",
        "beam_fall_semidiscrete-SNH-11x2x2_exact",
        "oscillator_amplification-SVK-one_tet_bdf2",
        "cook_membrane_3d-",
        "twist_bar_90deg-",
        "spin_block-SNH-4x3x2_implicit_midpoint",
        "mid_traction_beam-",
        "hanging_beam_E1e6-",
        "soft_sheet_self_weight-",
    ),
    "scenes/test_demos": ("test_demo[incline]", "[two_cubes_two_boxes]", "[hanging_beam_fine]"),
    "dynamics/test_stepping": (
        "test_implicit_steps_match_the_oracle[1-linearly",
        "test_parallel_kernels_match_the_oracle[velocity_verlet]",
        "test_explicit_steps_match_the_oracle[velocity_verlet]",
    ),
    "dynamics/test_contact_stepping": tuple(
        f"test_contact_forces_balance_weight_at_rest[{name}" for name in ("implicit", "linearly", "bdf2", "velocity_verlet")
    ),
    "simulator/test_simulator": ("[symplectic_euler-2]",),
    "dynamics/test_restitution": ("test_ten_seconds", "test_single_precision", "test_explicit_steps"),
    "simulator/test_rebuild": ("test_another_contact_solver",),
    "simulator/test_static": ("test_equilibrium[1]",),
    "simulator/test_checkpoint": (
        "contacts[bdf2-f32",
        "contacts[velocity_verlet-f64",
        "contacts[symplectic_euler-f64",
        "contacts[implicit_",
        "contacts[linearly_",
        "another_process[100]",
    ),
    "dynamics/test_contact_measures": ("[symplectic_euler-",),
    "benchmarks/test_collision": ("test_films_and_broad_phases",),
    "benchmarks/test_peers": (
        "test_peers_start_and_fall",
        "test_explicit_steps_of_newton",
        "test_explicit_steps_converge_to_the_exact_path",
    ),
    "benchmarks/test_scaling": (
        "_kind[explicit, one",
        "_kind[implicit",
        "_kind[search]",
        "_kind[explicit contact]",
        "test_a_child_answers",
    ),
    "benchmarks/test_regression": ("[slow-",),
    "benchmarks/test_hard": ("[dear-",),
    "benchmarks/test_contact": ("test_residuals_of_all_solvers_agree_with_the_oracle",),
    "benchmarks/test_report": ("test_one_thread_is_measured", "test_the_interpreted_loop_agrees"),
    "collision/test_collision_memory": ("test_nothing_is_out_of_bounds",),
    "dynamics/test_single_precision": ("test_steps_match_the_oracle[symplectic_euler]",),
    "dynamics/test_prescribed_nodes": ("prescribed_ends[bdf2]", "prescribed_end[implicit_midpoint]"),
    "dynamics/test_drag_spring": ("test_rests_at_the_static_equilibrium_and_returns[bdf2-2]",),
    "collision/test_detection_runs": ("test_sweeps",),
    "simulator/test_stability": ("test_steps_explode_above_the_limit[velocity_verlet-",),
    "dynamics/test_newton": ("[1]",),
    "collision/test_detection": ("TestZoo::test_all_kinds_of_contacts_are_found[f32]",),
    "collision/test_bvh": ("[('f32', False)]",),
    "collision/test_spatial_hash": ("[('f32', False)]",),
    "collision/test_near_triangles": ("[('f32', False)",),
    "fem/test_elasticity": ("test_forces[f32]", "test_force_differential[f32]", "test_assembled_stiffness[f32]"),
    "collision/test_reduction": ("f32",),
    "collision/test_frank_wolfe": ("[f32]",),
    "study/test_cli": ("test_interrupted_and_killed",),
    "study/test_cluster": ("test_a_study_on_a_cluster", "test_workers_use_separate_cores"),
    "study/test_runs": (
        "integrators[symplectic_euler-1]",
        "integrators[implicit_euler-1]",
        "integrators[bdf2-2]",
        "integrators[implicit_midpoint-2]",
        "test_free_flight",
        "test_failed_run",
    ),
    "collision/test_crossings": ("test_crossings_equal_those_of_all_pairs[f32-spatial_hash-False]",),
    "collision/test_self_collision": ("test_folded_sheets_against_ipctk[f32]",),
}


def is_long(nodeid: str) -> bool:
    """nodeid: as pytest gives it, such as tests/simulator/test_static.py::test_equilibrium[1]."""
    path, _, name = nodeid.partition("::")
    return any(part in name for part in LONG.get(path.removeprefix("tests/").removesuffix(".py"), ()))
