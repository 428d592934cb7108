"""What every look at telemetry says, and what the model adds to its error."""

from __future__ import annotations

import numpy as np
import pytest

from service.estimation.estimate import MODEL_ERROR_VARIANCE_RATIO, model_error


def test_the_model_errs_as_much_as_it_leaves_unexplained():
    covariance = np.diag([1.0, 4.0, 9.0, 16.0])
    np.testing.assert_allclose(
        model_error(covariance, 2.0),
        np.sqrt(MODEL_ERROR_VARIANCE_RATIO) * np.array([1.0, 2.0, 3.0, 4.0]),
    )


@pytest.mark.parametrize("misfit", [0.7, 1.0])
def test_a_model_that_explains_the_data_adds_nothing(misfit):
    np.testing.assert_array_equal(model_error(np.eye(4), misfit), np.zeros(4))
