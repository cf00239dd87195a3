"""Open a data set in LagrangeBench, and print what its reader, its search and its case make of it, as JSON.

It runs in a Python that has LagrangeBench, which wants an older JAX: ``python lagrangebench_reader.py FOLDER``.
"""

import json
import sys
from typing import Any

import jax
import numpy as np
from lagrangebench import case_builder
from lagrangebench.data import H5Dataset

FRAMES, BACKENDS = 2, ("jaxmd_vmap", "jaxmd_scan", "matscipy")
"""Frames of a window before its target; LagrangeBench's searches for neighbours."""


def near_pairs(positions: np.ndarray, particles: int, case: Any, radius: float) -> set[tuple[int, int]]:
    """Return all pairs within a radius, themselves too, by the distances of each particle to each other one."""
    shown = positions[:particles].astype(np.float32)
    off = jax.vmap(jax.vmap(case.displacement, (0, None)), (None, 0))(shown, shown)
    return set(zip(*np.nonzero(np.linalg.norm(off, axis=2) < radius), strict=True))


def read(folder: str) -> dict[str, Any]:
    """Return the windows, the pairs that each search misses or has too many, the moments of normalised velocities and
    accelerations of fluid, and how far a step of LagrangeBench's integrator by its target ends from the next frame."""
    found: dict[str, Any] = {"windows": {}, "types": [], "wrong_pairs": {}}
    for purpose in ("train", "valid", "test"):
        one = H5Dataset(purpose, folder, "cortado", FRAMES, extra_seq_length=int(purpose != "train"))
        found["windows"][purpose] = len(one)
    targets: dict[str, list[np.ndarray]] = {"vel": [], "acc": []}
    key, off = jax.random.PRNGKey(0), 0.0
    for backend in BACKENDS:
        train = H5Dataset("train", folder, "cortado", FRAMES, nl_backend=backend)
        metadata, ends = train.metadata, np.array(train.metadata["bounds"])
        case = case_builder(
            ends[:, 1] - ends[:, 0], metadata, FRAMES, {"backend": backend}, noise_std=0.0, dtype="float32"
        )
        wrong = 0
        for k in range(len(train)):
            positions, kinds = train[k]
            particles = int((kinds != -1).sum())
            _, features, target, _ = case.allocate(key, (positions, kinds))
            pairs = (np.asarray(features[name]) for name in ("receivers", "senders"))
            real = {pair for pair in zip(*pairs, strict=True) if max(pair) < particles}
            radius = metadata["default_connectivity_radius"]
            wrong += len(real ^ near_pairs(positions[:, FRAMES - 1], particles, case, radius))
            fluid = kinds == 0
            targets["acc"].append(np.asarray(target["acc"])[fluid])
            targets["vel"].append(np.asarray(features["vel_hist"])[fluid])
            if (k + 1) % (train.sequence_length - FRAMES) == 0:  # the last window of a run
                targets["vel"].append(np.asarray(target["vel"])[fluid])
            step = case.integrate({"acc": target["acc"]}, positions[:, :FRAMES])
            miss = jax.vmap(case.displacement)(step, positions[:, FRAMES])
            off = float(np.maximum(off, np.abs(np.asarray(miss))[fluid].max()))  # NaN stays
            found["types"] = sorted({*found["types"], *kinds[kinds != -1].tolist()})
        found["wrong_pairs"][backend] = wrong
    for name, own in targets.items():
        rows = np.concatenate(own)
        found[name] = {"mean": rows.mean(axis=0).tolist(), "std": rows.std(axis=0).tolist()}
    return {**found, "step_off": off}


if __name__ == "__main__":
    print(json.dumps(read(sys.argv[1])))
