"""Rims of the contact below the mesh's cells: its response at the nodes, and waves of two nodes around sharp objects."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from raytac.gel.surface import make_grid
from raytac.physics.bonded_layer import layer_compliance
from raytac.physics.soft.correction.cosine_series import CosineSeries, nodal_compliance
from raytac.physics.soft.correction.mesh_compliance import coat_compliance
from raytac.physics.soft.mesh import PadLevel, pad_mesh
from raytac.specs import load_sensor
from tests.physics.soft.oracles.coat_surface import CoatSurface
from tests.physics.soft.oracles.normal import ContactSampler, NormalCorrection

MINI = load_sensor("gelsight_mini").gelpad
GELPAD = replace(MINI, size=(6e-3, 5e-3))
MESH = pad_mesh(GELPAD, PadLevel(1e-3, 3, 1.5, 1.5, 5e-5))
PITCH = 0.0625e-3
_COMPLIANCE = [coat_compliance(MESH, GELPAD, rollers=rollers)[0, 2] for rollers in (False, True)]


def waves(field: np.ndarray) -> float:
    """95th percentile of the fourth differences along both axes, over 16, as of ``experiments/rims.py``."""
    return float(np.percentile(np.concatenate([np.abs(np.diff(field, 4, axis=axis)).ravel() for axis in (0, 1)]), 95)) / 16.0


def response(finer: int) -> np.ndarray:
    """Dent at the nodes of a wide grid under 1 Pa on one of them, with the same hat of pressure on ``finer`` times as many nodes."""
    nodes = [np.linspace(-0.5 * size, 0.5 * size, cells * finer + 1) for size, cells in ((6e-3, 24), (5e-3, 20))]
    x, y = (CosineSeries(line) for line in nodes)
    hat_x, hat_y = (np.maximum(1.0 - np.abs(line) / 0.25e-3, 0.0) for line in nodes)
    waves_of = y.analysis @ np.outer(hat_y, hat_x) @ x.analysis.T
    dent = y.synthesis(nodes[1]) @ (nodal_compliance(x, y, GELPAD) * waves_of) @ x.synthesis(nodes[0]).T
    return dent[::finer, ::finer]


def test_a_hat_of_pressure_has_the_same_dent_on_every_grid():
    """Nodes of the wide grid: what its own waves leave out is counted there."""
    wide, finer = response(1), response(6)
    assert np.abs(wide - finer).max() < 0.004 * finer.max()


def test_a_dent_does_not_ring():
    """Away from the node that is pressed the dent only falls; with the resolved waves alone it would not."""
    along = response(1)[10, 12:20]
    assert (np.diff(along) < 0.0).all() and (np.diff(along, 2) > 0.0).all()
    nodes = np.linspace(-3e-3, 3e-3, 25)
    x, y = CosineSeries(nodes), CosineSeries(np.linspace(-2.5e-3, 2.5e-3, 21))
    (k_x, hat_x), (k_y, hat_y) = x.hats(np.arange(25)), y.hats(np.arange(21))
    resolved = layer_compliance(np.hypot(k_x[None, :], k_y[:, None]), GELPAD) * (hat_y[:, None] * hat_x)
    pressure = np.zeros((21, 25))
    pressure[10, 12] = 1.0
    ringing = (y.synthesis(np.zeros(1)) @ (resolved * (y.analysis @ pressure @ x.analysis.T)) @ x.synthesis(nodes).T)[0, 12:20]
    assert (np.diff(ringing, 2) < 0.0).any()


def height(shape: str, pitch: float, shown: float | None = None) -> tuple[np.ndarray, float]:
    """The coat under a sharp object on nodes of ``shown`` [m], with contact on nodes of ``pitch`` [m], and the residual [m]."""
    fine, grid = make_grid(GELPAD, pitch), make_grid(GELPAD, shown or pitch)
    surface = CoatSurface(MESH.coat, GELPAD)
    normal = NormalCorrection(surface, GELPAD, fine.x, fine.y, *_COMPLIANCE)
    load = np.zeros(len(MESH.coat.rest))
    load[np.hypot(*MESH.coat.rest[:, :2].T).argmin()] = 0.1
    moved = np.zeros((len(load), 3))
    moved[:, 2] = -_COMPLIANCE[0] @ load
    contact = normal.solve(surface.places(np.zeros_like(moved)), moved[:, 2], load, underside(shape, fine.x, fine.y) - fine.rest)
    sampler = ContactSampler(normal, grid.x, grid.y)
    return sampler.lay(grid.rest + sampler.rise(contact), contact, underside(shape, grid.x, grid.y))[0], contact.residual


def underside(shape: str, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A flat pin off the middle, or a ring of beads on a plate, 0.3 mm deep."""
    x, y = x[None, :] - 0.113e-3, y[:, None] + 0.071e-3
    rho, turn = np.hypot(x, y), np.arctan2(y, x)
    if shape == "pin":
        return np.where(rho < 0.83e-3, -0.3e-3, np.inf)
    folded = np.mod(turn, math.pi / 4.0) - math.pi / 8.0
    bead = np.hypot(rho * np.cos(folded) - 1.4e-3, rho * np.sin(folded)) - 0.2e-3
    flank = np.clip(bead / 0.25e-3, 0.0, 1.0)  # as a coin's
    return -0.3e-3 + 0.2e-3 * flank**2 * (3.0 - 2.0 * flank) + np.where(rho < 2e-3, 0.0, np.inf)


@pytest.mark.parametrize("shape", ["pin", "beads"])
def test_rims_are_as_those_of_a_contact_three_times_finer(shape):
    """Waves of two nodes that the object does not have: below 0.3 µm, as on the rigid pad; and the search for the pressure ends."""
    (own, residual), (finer, _) = (height(shape, PITCH / k) for k in (1, 3))
    assert residual < 1e-6 and own.min() == pytest.approx(-0.3e-3, abs=1e-6)
    ragged = 1e6 * (own.astype(float) - finer[::3, ::3])
    assert waves(ragged) < 0.3
    assert np.sqrt(np.square(ragged).mean()) < 6.0  # most of it within one node of the rim


def test_a_surface_finer_than_its_contact_is_a_spline_between_the_nodes():
    """Same heights at the nodes of both, and no waves in between."""
    (own, _), (between, _) = height("pin", PITCH), height("pin", PITCH, 0.5 * PITCH)
    grid = make_grid(GELPAD, PITCH)
    free = ~np.isfinite(underside("pin", grid.x, grid.y))
    assert np.abs(own - between[::2, ::2])[free].max() < 1e-7
    assert waves(1e6 * between.astype(float)) < 0.1
