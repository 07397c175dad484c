"""What is cached with a boundary follows changes of its tensors in place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gpe_pl.geometry.periodicity import NOWHERE
from gpe_pl.geometry.shapes import Box
from gpe_pl.graphs.contacts import convex_corners
from gpe_pl.trajectory.boundary import Boundary
from tests import scenes


@pytest.mark.parametrize("inference", [False, True])
def test_a_wall_that_is_moved_in_place_is_found_where_it_is(inference: bool) -> None:
    build, state = scenes.builder(("sand",)), scenes.state(40, low=0.02, high=0.3).to_torch()
    before = build.topology(state)
    with torch.inference_mode(inference):
        state.boundary.pos[:, 1] += 0.1
    fresh = scenes.state(40, low=0.02, high=0.3).to_torch()
    fresh.boundary.pos[:, 1] += 0.1
    relation = ("boundary", "radius", "sand")
    found, expected = (build.topology(s).edges[relation] for s in (state, fresh))
    assert torch.equal(found, expected) and found.shape != before.edges[relation].shape


def test_trees_and_corners_follow_changes_in_place() -> None:
    box = Boundary.sample((Box((0.4, 0.4), (0.6, 0.6), 0.3),), scenes.SPACING, 2)
    own = replace(scenes.state(), boundary=box).to_torch().boundary
    tree = own.tree(NOWHERE)
    assert own.tree(NOWHERE) is tree and len(convex_corners(own, scenes.SPACING)) == 4
    own.pos.mul_(10.0)  # nodes that are far apart are no corners
    assert own.tree(NOWHERE) is not tree and not len(convex_corners(own, scenes.SPACING))
    np.testing.assert_array_equal(own.tree(NOWHERE).data, own.pos.numpy())
