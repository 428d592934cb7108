from dataclasses import replace

import numpy as np
import pytest

from pyrcal.fitting.matrix import fit_matrix
from service.estimation.reference import Reference
from service.model.instrument import TabulatedModes
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis
from tests.numerics import small_basis
from tests.unit.estimation.bench import error, instrument, matrix

FAR = Misregistration(
    shift_x_subap=0.55, shift_y_subap=-0.3, rotation_rad=np.deg2rad(1.0), magnification=0.995
)

STEP_SUBAP = 0.25


@pytest.mark.parametrize("half_subap", [6.0, 7.5])
def test_a_table_that_ends_at_the_pupil_costs_slopes_and_no_accuracy(half_subap):
    line = np.arange(-7.5, 7.51, STEP_SUBAP)
    x, y = np.meshgrid(line, line)
    shapes = small_basis().render(np.column_stack([x.ravel(), y.ravel()]))
    known = np.hypot(x, y) <= half_subap
    cube = np.where(known, shapes.T.reshape(-1, *x.shape), 0.0)
    about = instrument()
    table = TabulatedModes(cube=cube, pitch_m=STEP_SUBAP * about.subaperture_m, known=known)
    about = replace(about, mirror=table)
    found = fit_matrix(about, Reference(matrix=matrix(FAR)), basis=modal_basis(about))
    assert found.accepted
    # 0.06 % of a subaperture was seen with every filling of the unknown part
    assert np.all(np.abs(error(found, FAR)[:2]) < 2e-3)
    assert bool(found.left_out) == (half_subap < 7.0)


def test_single_actuators_are_a_basis_too():
    strokes = small_basis().mode_to_actuator
    poked = small_basis().combined(np.linalg.pinv(strokes)[:, ::3])
    found = fit_matrix(instrument(None), Reference(matrix=matrix(FAR, basis=poked)), basis=poked)
    assert found.accepted
    assert np.all(np.abs(error(found, FAR)[:2]) < 2e-3)
