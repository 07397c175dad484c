"""Forward times of the models of a sweep, for a column of its table."""

from __future__ import annotations

from pathlib import Path

import torch

from gpe_pl.files import sealed
from gpe_pl.graphs.lattice import lattice_graph
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.nn.fused import unfused
from gpe_pl.reports.domain_table import compares_models
from gpe_pl.reports.finished_runs import Run, distinct_runs, run_name
from gpe_pl.reports.sweep_table import FORWARD_TIMES, network_digest, networks_in, variants_of
from gpe_pl.system.timing import paired_ratio, paired_times

NUM_NODES, NUM_EDGES = 600, 6000
"""Size of the graph, a 2D lattice of sand."""


def measure_forward_times(folder: Path, runs: list[Run], num_rounds: int = 30) -> None:
    """Write the forward time of each variant, divided by that of the first variant.

    One model per variant is timed on the same lattice, in one thread. The value is the median of paired ratios.

    Only PyTorch's operations are used, because fused passes exist for some variants only. Nothing is measured in these cases: the runs have several models or
    domains, there are fewer than two variants, a model is not for 2D sand alone, or the variants were measured before.

    Args:
        folder: folder of the sweep, where ``forward_times.json`` is written.
        runs: runs of the sweep, all finished.
        num_rounds: number of rounds of the measurement.

    Raises:
        SealError: ``forward_times.json`` is damaged.
    """
    runs = distinct_runs(runs)
    path = folder / FORWARD_TIMES
    first_runs = [members[0] for members in variants_of(runs)[1].values()] if runs else []
    names = [run_name(run, folder) for run in first_runs]
    networks = {name: network_digest(run) for name, run in zip(names, first_runs, strict=True)}
    if (
        len(names) < 2
        or compares_models(runs)
        or (path.exists() and networks_in(sealed.read(path, "delete it to measure again")) == networks)
    ):
        return
    alternatives = {}
    for name, run in zip(names, first_runs, strict=True):
        simulator = LearnedSimulator.from_checkpoint(run.folder / "checkpoints" / "best.ckpt")
        if simulator.builder.spec.materials != ("sand",) or simulator.builder.spec.dim != 2:
            return
        _, graph = lattice_graph(NUM_NODES, NUM_EDGES, simulator.builder.config)
        alternatives[name] = unfused()(torch.inference_mode()(lambda s=simulator, g=graph: s(g)))
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    times = paired_times(alternatives, num_rounds)
    torch.set_num_threads(threads)
    sealed.write(path, {name: {"ratio": paired_ratio(times, name, names[0]), "network": networks[name]} for name in names})
