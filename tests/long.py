"""Tests that `make test` leaves to `make test-long`: variations of what stays, and runs of minutes.

By file, parts of the names after it. What stays of each file tests every path at least once: the other precision, a second
integrator, a second scene, or a coarser case of the same problem.
"""

LONG = {
    "test_arch": ("[cpu-",),
    "test_fuzz": ("[10000-",),
    "test_determinism": ("[cube_implicit]", "[cubes_"),
    "test_faults": (
        "test_a_disk_that_fails[others]",
        "test_killed_while_files_are_replaced[100]",
        "test_a_run_that_is_killed[20]",
        "[300000000",
        "[body-implicit_euler]",
        "[ground-",
        "[nothing-implicit_euler]",
        "test_a_buffer_that_grows",
    ),
    "test_references": (
        "patch_test-",
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
    "test_contact_stepping": ("test_rest[bdf2-", "test_rest[velocity_verlet-"),
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
    "test_bench_peers": ("test_peers_fall_alike", "test_newtons_explicit_steps", "test_explicit_steps_come_to_the_exact_path"),
    "test_bench_scaling": (
        "_kind[explicit, one",
        "_kind[implicit",
        "_kind[search]",
        "_kind[explicit contact]",
        "test_a_child_answers",
    ),
    "test_regression": ("test_as_stored_too",),
    "test_bench_hard": ("[dear-",),
    "test_bench_contact": ("test_every_solver_gets_the_same_problem_and_is_judged_rightly",),
    "test_bench_report": ("test_one_thread_is_one_thread", "does_what_the_search_does"),
    "test_collision_memory": ("test_nothing_is_out_of_bounds",),
    "test_single_precision": ("test_steps_match_the_oracle[symplectic_euler]",),
    "test_prescribed_nodes": ("test_rigid_flight[bdf2]", "test_second_order_with_a_led_end[bdf2-implicit_midpoint]"),
    "test_drag_spring": ("test_pulled_to_rest_and_back[bdf2-2]",),
    "test_detection_runs": ("test_sweeps",),
    "test_stability": ("test_steps_explode_above_the_limit[velocity_verlet-",),
    "test_newton": ("[1]",),
    "test_detection": ("test_a_thousandth_of_the_size", "TestZoo::test_all_kinds_are_there[f32]"),
    "test_bvh": ("[('f32', False)]",),
    "test_spatial_hash": ("[('f32', False)]",),
    "test_queries": ("[('f32', False)",),
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
    "test_crossings": ("test_all_pairs_by_separating_axes[f32-spatial_hash-False]",),
    "test_self_collision": ("test_folded_sheets_against_ipctk[f32]",),
}


def is_long(nodeid: str) -> bool:
    """nodeid: as pytest gives it, such as tests/test_static.py::test_equilibrium[1]."""
    path, _, name = nodeid.partition("::")
    return any(part in name for part in LONG.get(path.rsplit("/", 1)[-1].removesuffix(".py"), ()))
