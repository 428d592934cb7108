"""Which instruments are simulated, and how those of a user's own are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from service.errors import ConfigurationError
from service.model.instrument import TabulatedModes
from service.model.kinds import BasisKind, Normalisation, SlopeOrder
from service.model.sensors.pyramid.description import FrameWindows
from service.model.slopes import Orientation, SlopeRecipe
from sim_rtc.assembly import check_supported
from sim_rtc.computer.reconstructors import identity_of
from sim_rtc.telescope.registration import random_registration


def test_an_instrument_of_the_conventions_is_played(small_instrument):
    check_supported(small_instrument)
    check_supported(replace(small_instrument, slopes=SlopeRecipe(orientation=Orientation())))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"slopes": SlopeRecipe(order=SlopeOrder.YX)}, 'slopes.order = "yx"'),
        ({"slopes": SlopeRecipe(orientation=Orientation(flip_x=True))}, "slopes.orientation"),
        ({"slopes": SlopeRecipe(normalisation=Normalisation.LOCAL)}, 'normalisation = "local"'),
        ({"frames": FrameWindows()}, 'wfs.input = "frames"'),
        (
            {
                "mirror": TabulatedModes(
                    cube=np.ones((1, 9, 9)), pitch_m=1.0, known=np.ones((9, 9), bool)
                )
            },
            "measured modes",
        ),
    ],
)
def test_what_is_not_simulated_is_refused_by_name(small_instrument, change, expected):
    with pytest.raises(ConfigurationError) as caught:
        check_supported(replace(small_instrument, **change))
    assert expected in str(caught.value)


def test_a_mirror_seen_from_behind_is_refused(small_instrument):
    mirror = replace(small_instrument.mirror, parity=-1)
    with pytest.raises(ConfigurationError, match="parity = -1"):
        check_supported(replace(small_instrument, mirror=mirror))


def test_a_random_registration_is_near_the_nominal_rotation():
    drawn = [random_registration(np.random.default_rng(s), np.deg2rad(64.5)) for s in range(30)]
    assert max(abs(np.rad2deg(a.rotation_rad) - 64.5) for a in drawn) <= 0.3


def test_a_basis_of_the_users_own_has_another_name(small_instrument):
    valid = np.ones((3, 3), bool)
    n_actuators = len(small_instrument.mirror.positions_m)
    mirrors = [
        small_instrument.mirror,
        replace(small_instrument.mirror, basis=BasisKind.ZONAL),
        replace(small_instrument.mirror, mode_to_actuator=np.ones((n_actuators, 2))),
        replace(small_instrument.mirror, mode_to_actuator=np.ones((n_actuators, 2)) * 2),
    ]
    names = [identity_of(replace(small_instrument, mirror=m), valid).basis_id for m in mirrors]
    assert len(set(names)) == 4
    assert names[0].startswith("kl-")
