"""What tests of several modules share of unit.runtime.test_remote_rows."""

from __future__ import annotations

from service.model.interaction import InteractionModel
from service.model.kinds import Stop
from service.model.misregistration import Misregistration
from tests.support.local import basis, many_actuators

FIRST = Misregistration(shift_x_subap=0.2, rotation_rad=0.01, magnification=1.003)


def model_of(stop=Stop.TELESCOPE, mapper=map, **settings):
    return InteractionModel(
        many_actuators(stop),
        basis(),
        pupil_sampling=2,
        detector_nodes=1,
        kept_bytes=0,
        mapper=mapper,
        **settings,
    )
