"""The fuzz tier: scenes, tasks, files, kills and environments that nobody would write, and what must hold for them.

Every case is drawn from a seed, runs in a process of its own, and is judged: a command ends with the exit code 0, 1 or
2, at most one sentence on stderr, within 20 s and 2 GB; every trajectory opens and holds the fluid that the container
should hold; every search resumes with the same bits. `make fuzz` runs all of it, ``python -m fuzz --help`` a part.
"""
