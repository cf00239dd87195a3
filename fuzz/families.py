"""All families of cases, by name."""

from fuzz.cases import Family
from fuzz.environments import ENVIRONMENTS, run_in_environment
from fuzz.environments import prepare as prepare_environments
from fuzz.files import prepare as prepare_files
from fuzz.files import read_hostile
from fuzz.functions import compile_function
from fuzz.kills import kill_run, kill_search, prepare_runs, prepare_searches
from fuzz.parts import run_a_part
from fuzz.readings import place_a_sensor, read_a_moving_fluid
from fuzz.scenes import run_scene, search_task
from fuzz.tracks import read_tracks

FAMILIES = {
    "scenes": Family(1400, run_scene),
    "tasks": Family(600, search_task),
    "files": Family(300, read_hostile, prepare_files),
    "kills-run": Family(200, kill_run, prepare_runs),
    "kills-optimise": Family(200, kill_search, prepare_searches),
    "functions": Family(200, compile_function),
    "parts": Family(100, run_a_part),
    "readings": Family(100, read_a_moving_fluid),
    "sensors": Family(100, place_a_sensor),
    "tracks": Family(100, read_tracks),
    "environments": Family(2 * len(ENVIRONMENTS), run_in_environment, prepare_environments),
}
