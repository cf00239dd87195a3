"""Which tier a test belongs to, validation, slow, or else the unit tier, which is neither; and how tests run commands.

A whole file is named, or tests of a file by their names. A test is slow if all of its cases together took at least 3 s
where a core was shared by about three processes; a few are left in the unit tier as nothing else there guards the same.
"""

import gc
import math
import shutil
from importlib.util import find_spec

import numpy as np
import pytest
from matplotlib.image import imsave

from compiling_notice import without_compiling
from cortado.cli import main
from cortado.cli.subcommands import CORTADO
from short import is_long, with_each_value

WITHOUT_ENGINE = find_spec("cortado_reference") is None and shutil.which("c++") is None
collect_ignore = ["test_reference.py", "test_reference_projection.py", "test_study.py"]
collect_ignore += ["test_study_figures.py", "test_study_growth.py"]
collect_ignore = collect_ignore if WITHOUT_ENGINE else []


gc.set_threshold(100_000, 20, 20)
"""Launches make so many small objects that looking for those in circles takes a tenth of the tests' time otherwise."""


def pytest_report_header():
    return "There is no C++ compiler: nothing of the reference engine is tested." if WITHOUT_ENGINE else None


VALIDATION = {
    "test_containment",
    "test_plants",
    "test_study_figures",
    "test_study_growth",
    "test_surface_tension",
    "test_validation",
    "test_validation_mixture",
    "test_validation_projection",
    "test_validation_rayleigh_taylor",
    "test_validation_rheology",
    "test_validation_surface_tension",
    "test_validation_viscosity",
}
"""Files: physics against published data and closed forms, studies, walls that hold, and every plant."""
SLOW = {
    "test_browser",
    "test_docs",
    "test_examples",
    "test_held_water",
    "test_kernel_cache",
    "test_memory",
    "test_readme",
    "test_silence",
    "test_terminal",
}
"""Files: pages in a browser, processes that compile kernels, examples, documents' code, solids in water."""
SLOW_TESTS = {
    "test_certificate": {
        "test_a_sign_flipped_is_found_in_float32",
        "test_beyond_the_horizon_another_estimator_is_advised",
        "test_right_gradients_are_found_right",
        "test_right_gradients_are_found_right_in_float32",
    },
    "test_cli": {
        "test_a_changed_task_is_not_resumed",
        "test_a_cup_is_swung_until_it_looks_as_it_should",
        "test_a_finished_optimisation_goes_on",
        "test_a_killed_optimisation_resumes_bit_for_bit",
        "test_a_planted_error_fails_the_check",
        "test_a_process_of_its_own_says_no_more_than_the_sentence",
        "test_a_run_is_rendered_as_its_scene_asks",
        "test_a_run_on_a_full_disk_says_so",
        "test_a_run_that_diverges_says_where_and_keeps_its_frames",
        "test_a_search_on_a_full_disk_says_so_and_goes_on",
        "test_an_earlier_run_is_kept_unless_overwritten",
        "test_an_image_that_is_not_matched_fails_and_keeps_its_files",
        "test_an_interrupted_optimisation_resumes_bit_for_bit",
        "test_an_optimisation_of_images_resumes_bit_for_bit",
        "test_another_image_is_not_resumed",
        "test_another_precision_or_picture_is_not_resumed",
        "test_frames_stay_when_a_disk_fills_up",
        "test_other_parameters_are_optimised_and_drawn",
        "test_other_tasks_of_images",
        "test_places_are_found_for_a_picture",
        "test_run_writes_its_folder",
        "test_the_check_writes_a_figure",
    },
    "test_compiling": {
        "test_a_fork_while_headers_are_precompiled",
        "test_one_phase_loads_what_it_needs_and_no_more",
        "test_two_processes_start_cold_at_once",
    },
    "test_control": {
        "test_a_contender_stays_within_its_budget",
        "test_the_gradient_is_the_limit_of_differences",
        "test_the_known_solution_does_better_than_no_search",
        "test_what_is_done_is_not_repeated",
    },
    "test_driver": {"test_an_old_driver_is_told"},
    "test_environments": {
        "test_estimators_go_through_the_twin",
        "test_gymnasium_has_nothing_to_say_of_the_others",
        "test_sensors_are_observed_as_a_simulation_reads_them",
        "test_so_it_is_of_the_others",
        "test_the_twin_in_jax",
        "test_the_twin_in_torch",
    },
    "test_estimators": {
        "test_a_mistake_is_a_sentence",
        "test_a_viscosity_keeps_the_adjoint_of_a_long_run_from_growing",
        "test_gradients_equal_those_of_the_twin",
        "test_the_same_bits_twice_and_float32_is_near",
        "test_velocity_only_grows_at_most_linearly",
        "test_without_strength_an_estimator_is_exact_bit_for_bit",
    },
    "test_executors": {"test_each_process_has_one_gpu_also_when_it_is_started_again"},
    "test_extinction_schedule": {
        "test_thin_fluid_first_gathers_what_thick_fluid_leaves_behind",
    },
    "test_first_commands": {
        "test_a_new_scene_runs_at_once",
        "test_quiet_says_nothing_but_what_was_asked_for",
        "test_so_it_does_with_all_that_is_switched_off",
    },
    "test_free_bodies": {
        "test_a_body_and_fluid_in_free_space_keep_their_momentum",
        "test_a_box_floats_as_deep_as_it_should",
        "test_derivatives_of_bodies",
    },
    "test_fuzz": {
        "test_one_case_by_its_command",
    },
    "test_gradients": {
        "test_splash",
    },
    "test_image_loss": {
        "test_gradient_equals_tangent_and_differences",
        "test_the_whole_chain_from_gravity_to_the_picture",
    },
    "test_interruption": {"test_workers_that_begin_are_interrupted_in_one_sentence"},
    "test_jax_layer": {
        "test_a_map_is_a_batch_with_the_bits_of_single_evaluations",
        "test_both_modes_agree_for_every_field_of_a_state",
        "test_compiled_scanned_and_recomputed_segments_have_the_same_gradient",
        "test_jacobians_by_both_modes_agree_and_are_mapped",
        "test_optax_and_optimistix_search",
    },
    "test_lanes": {"test_kernels_for_lanes_compile_for_a_gpu_that_is_not_there"},
    "test_layers": {
        "test_the_discretisation_is_without_warp",
    },
    "test_leaderboard": {"test_the_standard_error_of_the_truth_is_right"},
    "test_meshes": {"test_two_hundred_thousand_triangles_are_read_sampled_and_asked_a_million_times"},
    "test_mixture": {
        "test_a_parameter_alone_has_the_gradient_that_it_has_among_all",
        "test_gradient_equals_tangent_and_differences",
    },
    "test_neighbours": {
        "test_random_clouds",
    },
    "test_optimise": {
        "test_interrupted_run_resumes_bit_for_bit",
        "test_killed_process_resumes_bit_for_bit",
        "test_rosenbrock_converges",
    },
    "test_packaging": {
        "test_whoever_wants_the_engine_without_a_compiler_is_told",
    },
    "test_packages": {
        "test_a_key_of_one_is_swept",
        "test_a_task_searches_for_a_parameter_of_one",
        "test_they_are_there_in_processes_of_their_own",
    },
    "test_physics": {
        "test_any_number_of_threads_gives_the_same_bits",
    },
    "test_public_face": {
        "test_types_are_checked_where_cortado_is_used",
    },
    "test_reference": {
        "test_a_mistake_gives_a_sentence",
        "test_derivatives_are_those_of_the_warp_engine",
        "test_float32_is_as_near_to_float64_as_the_warp_engine_is",
        "test_methods_agree_in_float128",
        "test_methods_agree_in_float64",
        "test_positions_are_those_of_the_warp_engine",
        "test_precisions_agree",
        "test_same_bits_with_any_number_of_threads",
        "test_the_adjoint_is_the_transpose_of_the_tangent",
        "test_the_tangent_is_the_limit_of_differences_in_float128",
        "test_where_it_is_not_installed_there_is_one_sentence",
    },
    "test_restart": {
        "test_a_restart_has_the_bits_of_a_run_that_did_not_stop",
    },
    "test_scene": {
        "test_any_change_loads_or_is_a_sentence",
    },
    "test_scene_points": {
        "test_positions_are_read_from_vtk",
    },
    "test_smoothing": {
        "test_the_pressure_iteration_converges_on_the_lattice",
    },
    "test_sweep": {
        "test_a_search_with_an_ensemble_has_the_same_bits_on_workers",
        "test_a_task_is_optimised_with_every_combination",
        "test_a_worker_that_is_killed_half_way_changes_nothing",
        "test_what_is_finished_is_not_repeated",
    },
    "test_threads": {
        "test_forks_after_use_and_while_others_compute",
    },
    "test_tilt": {
        "test_a_problem_takes_a_tilt_in_the_place_of_gravity",
    },
    "test_torch_layer": {
        "test_chained_segments_pass_the_check_of_gradients",
        "test_residuals_of_a_graph_go_with_it",
    },
    "test_walls": {
        "test_the_side_of_a_cup_stops_a_particle_alone",
        "test_water_that_fills_a_box_has_the_rest_density_everywhere",
        "test_water_that_fills_a_cup_starts_nowhere_compressed",
    },
}
"""Tests of files whose others are in the unit tier."""


def tier(file: str, test: str) -> str:
    """Of a test by its name, without parameters, in a file by its name, without ending."""
    if file in VALIDATION:
        return "validation"
    return "slow" if file in SLOW or test in SLOW_TESTS.get(file, ()) else "unit"


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--short", action="store_true", help="as make test does: without what make test-all alone runs")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Marks tests by their tier, and leaves out with ``--short`` what only `make test-all` runs. Long files come first,
    so that no core ends with one while the others have nothing to do; ``--no-loadscope-reorder`` in pyproject.toml
    keeps this order."""
    items.sort(key=lambda item: (item.path.stem not in VALIDATION, item.path.stem not in {*SLOW, *SLOW_TESTS}))
    for item in items:
        found = tier(item.path.stem, getattr(item, "originalname", item.name))
        if found != "unit":
            item.add_marker(getattr(pytest.mark, found))
    if config.getoption("--short"):
        run = {id(item) for item in with_each_value([item for item in items if not is_long(item)])}
        config.hook.pytest_deselected(items=[item for item in items if id(item) not in run])
        items[:] = [item for item in items if id(item) in run]


@pytest.fixture
def cortado_command(capfd, monkeypatch):
    """Runs a command in this process: (exit code, stdout, stderr), with what C code writes. There are no lines of
    progress, however slow the machine is."""
    monkeypatch.setattr("cortado.files.progress.LINE_INTERVAL", math.inf)

    def run(*arguments, program=CORTADO):
        capfd.readouterr()
        try:
            main([str(argument) for argument in arguments], program)
            code = 0
        except SystemExit as end:
            code = end.code or 0
        out, err = capfd.readouterr()
        return code, out, without_compiling(err)

    return run


@pytest.fixture
def unrendered(request, monkeypatch):
    """Figures are made, but saved as a white square: to render them takes longer than all else that such tests are
    about, and is what tests/test_figures.py does. Tests that ask for `rendered` too have them as they are."""
    if "rendered" not in request.fixturenames:
        white = np.ones((4, 4, 3))
        monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda _, file, **options: imsave(file, white))


@pytest.fixture
def rendered():
    """Asks for figures as they are in a file whose tests have them `unrendered`."""
