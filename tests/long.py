"""Tests that `make test` leaves to `make test-long`: variations of what stays, and runs of minutes.

By file, parts of the names after it. What stays of each file tests every path at least once: the other precision, a second
integrator, a second scene, or a coarser case of the same problem.
"""

LONG = {
    "test_arch": ("[cpu-",),
    "test_attachments": (
        "test_joint_carries_the_weight[bdf2-f32]",
        "-orders2]",
        *(f"[{name}-orders1]" for name in ("symplectic_euler", "linearly_implicit_euler", "bdf2", "implicit_midpoint")),
    ),
    "test_chunks": ("[mixed-linearly_implicit_euler", "[driven-implicit_midpoint"),
    "test_fuzz": ("[10000-",),
    "test_joint_forces": (
        "[damping1-",
        "[damping0-False-",
        "[damping0-True-2]",
        "test_a_joint_balances_momentum_in_every_step[2]",
        "test_contacts_of_attached_nodes_count[implicit_euler",
    ),
    "test_pressure": (
        *(f"constant[{name}]" for name in ("velocity_verlet", "implicit_euler", "linearly_implicit_euler", "implicit_midpoint")),
        *(f"test_batches_and_contacts[{name}]" for name in ("velocity_verlet", "linearly_implicit_euler")),
        "test_a_cube_is_in_a_hydrostatic_state[st_venant_kirchhoff",
    ),
    "test_regions": ("test_explicit_steps_match_the_oracle[velocity_verlet]",),
    "test_mean_dilatation": ("test_stiffness_damping_is_the_projected_matrix[2]",),
    "test_passages": ("[scroll-18]",),
    "test_cli_warm": ("test_f64_demos_compile_nothing_after_warming[gripper]",),
    "test_bench_contact_versions": ("test_drops", "test_steps_without_contacts"),
    "test_determinism": ("[cube_implicit]", "[cubes_"),
    "test_faults": ("test_failing_calls[others]", "test_kills_while_files_are_replaced[100]", "test_kills_during_runs[20]"),
    "test_faults_memory": ("[300000000", "[body-implicit_euler]", "[ground-", "[nothing-implicit_euler]", "test_growing_buffers"),
    "test_references": (
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
    "test_demos": ("test_demo[incline]", "[two_cubes_two_boxes]", "[hanging_beam_fine]"),
    "test_stepping": (
        "test_implicit_steps_match_the_oracle[1-linearly",
        "test_parallel_kernels_match_the_oracle[velocity_verlet]",
        "test_explicit_steps_match_the_oracle[velocity_verlet]",
    ),
    "test_contact_stepping": tuple(
        f"test_contact_forces_balance_weight_at_rest[{name}" for name in ("implicit", "linearly", "bdf2", "velocity_verlet")
    ),
    "test_simulator": ("[symplectic_euler-2]",),
    "test_restitution": ("test_ten_seconds", "test_single_precision", "test_explicit_steps"),
    "test_rebuild": ("test_another_contact_solver",),
    "test_static": ("test_equilibrium[1]",),
    "test_checkpoint": (
        "contacts[bdf2-f32",
        "contacts[velocity_verlet-f64",
        "contacts[symplectic_euler-f64",
        "contacts[implicit_",
        "contacts[linearly_",
        "another_process[100]",
    ),
    "test_contact_measures": ("[symplectic_euler-",),
    "test_bench_collision": ("test_films_and_broad_phases",),
    "test_bench_peers": (
        "test_peers_start_and_fall",
        "test_explicit_steps_of_newton",
        "test_explicit_steps_converge_to_the_exact_path",
    ),
    "test_bench_scaling": (
        "_kind[explicit, one",
        "_kind[implicit",
        "_kind[search]",
        "_kind[explicit contact]",
        "test_a_child_answers",
    ),
    "test_regression": ("[slow-",),
    "test_bench_hard": ("[dear-",),
    "test_bench_contact": ("test_residuals_of_all_solvers_agree_with_the_oracle",),
    "test_bench_report": ("test_one_thread_is_measured", "test_the_interpreted_loop_agrees"),
    "test_collision_memory": ("test_nothing_is_out_of_bounds",),
    "test_single_precision": ("test_steps_match_the_oracle[symplectic_euler]",),
    "test_prescribed_nodes": ("prescribed_ends[bdf2]", "prescribed_end[implicit_midpoint]"),
    "test_drag_spring": ("test_rests_at_the_static_equilibrium_and_returns[bdf2-2]",),
    "test_detection_runs": ("test_sweeps",),
    "test_stability": ("test_steps_explode_above_the_limit[velocity_verlet-",),
    "test_newton": ("[1]",),
    "test_detection": ("TestZoo::test_all_kinds_of_contacts_are_found[f32]",),
    "test_bvh": ("[('f32', False)]",),
    "test_spatial_hash": ("[('f32', False)]",),
    "test_near_triangles": ("[('f32', False)",),
    "test_elasticity": ("test_forces[f32]", "test_force_differential[f32]", "test_assembled_stiffness[f32]"),
    "test_reduction": ("f32",),
    "test_frank_wolfe": ("[f32]",),
    "test_study_cli": ("test_interrupted_and_killed",),
    "test_study_cluster": ("test_a_study_on_a_cluster", "test_workers_use_separate_cores"),
    "test_study_runs": (
        "integrators[symplectic_euler-1]",
        "integrators[implicit_euler-1]",
        "integrators[bdf2-2]",
        "integrators[implicit_midpoint-2]",
        "test_free_flight",
        "test_failed_run",
    ),
    "test_crossings": ("test_crossings_equal_those_of_all_pairs[f32-spatial_hash-False]",),
    "test_self_collision": ("test_folded_sheets_against_ipctk[f32]",),
}


def is_long(nodeid: str) -> bool:
    """nodeid: as pytest gives it, such as tests/test_static.py::test_equilibrium[1]."""
    path, _, name = nodeid.partition("::")
    return any(part in name for part in LONG.get(path.rsplit("/", 1)[-1].removesuffix(".py"), ()))
