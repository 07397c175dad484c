"""Run the substeps of taichi's example ``mpm99`` on given particles: ``python mpm99_process.py FILE.npz``.

The file holds pos, vel [particle, 2], material and num_steps. Positions after the steps are written next to it with the suffix .npy. A separate process runs
it, because taichi and numba bring different LLVM versions, and both in one process crash. Importing the example opens no window; only its ``main`` does.
"""

import sys
from pathlib import Path

import numpy as np

if __name__ == "__main__":
    from taichi.examples.simulation import mpm99

    path = Path(sys.argv[1])
    given = np.load(path)
    count = len(given["pos"])
    mpm99.initialize()
    mpm99.x.from_numpy(given["pos"])
    mpm99.v.from_numpy(given["vel"])
    mpm99.C.from_numpy(np.zeros((count, 2, 2)))
    mpm99.material.from_numpy(np.full(count, given["material"], np.int32))
    for _ in range(int(given["num_steps"])):
        mpm99.substep()
    np.save(path.with_suffix(".npy"), mpm99.x.to_numpy())
