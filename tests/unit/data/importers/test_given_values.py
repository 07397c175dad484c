"""Values that a command gives, and that no trajectory needs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests import sources
from tests.sources import motion
from tests.unit.data.importers.test_formats import imported
from tests.unit.data.importers.test_own_arrays import write_arrays


def test_parameters_without_effect_are_named(tmp_path: Path) -> None:
    for seed in range(3):
        write_arrays(tmp_path / "raw", seed)
    report, stored = imported(tmp_path, tmp_path / "raw", "arrays", parameters={"fluid": 1e-2, "sand": 45.0})
    assert (stored["train"][0].material_params == 30.0).all()
    assert "parameters={fluid: …} has no effect: no node is fluid, materials are sand" in report.warnings
    assert "friction_angle of sand is that of the source; parameters={sand: …} counts only where the source has none" in report.notes


def test_node_types_and_parameters_without_effect_are_named(tmp_path: Path) -> None:
    pos = motion()
    sources.gns_metadata(tmp_path / "raw", pos)
    sources.gns_npz(tmp_path / "raw" / "train.npz", [(pos, np.full(20, 6), np.tan(0.5))])
    report, stored = imported(
        tmp_path, tmp_path / "raw", "gns", materials={6: "sand", 7: "fluid"}, parameters={"sand": 45.0}, allow_pickle=True, holdout=0.0
    )
    np.testing.assert_allclose(stored["train"][0].material_params, np.degrees(0.5), rtol=1e-5)
    assert "materials={7: fluid} has no effect: no node has type 7, types are 6" in report.warnings
    assert "friction_angle of sand is that of the source; parameters={sand: …} counts only where the source has none" in report.notes
