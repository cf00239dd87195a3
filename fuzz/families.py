"""All families of cases, by name."""

from fuzz.cases import Family
from fuzz.environments import ENVIRONMENTS, run_in_environment
from fuzz.environments import prepare as prepare_environments
from fuzz.files import prepare as prepare_files
from fuzz.files import read_hostile
from fuzz.kills import kill_run, kill_search, prepare_runs, prepare_searches
from fuzz.scenes import run_scene, search_task

FAMILIES = {
    "scenes": Family(1400, run_scene),
    "tasks": Family(600, search_task),
    "files": Family(300, read_hostile, prepare_files),
    "kills-run": Family(200, kill_run, prepare_runs),
    "kills-optimise": Family(200, kill_search, prepare_searches),
    "environments": Family(2 * len(ENVIRONMENTS), run_in_environment, prepare_environments),
}
