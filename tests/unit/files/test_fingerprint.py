from dataclasses import replace

import numpy as np

from service.files.fingerprint import instrument_sha256
from service.model.instrument import Stop
from tests.numerics import small_instrument


def test_the_same_instrument_has_the_same_number():
    assert instrument_sha256(small_instrument()) == instrument_sha256(small_instrument())


def test_every_change_of_an_instrument_changes_it():
    one = small_instrument()
    moved = one.mirror.positions_m.copy()
    moved[3, 1] += 1e-9
    others = [
        small_instrument(stop=Stop.TELESCOPE),
        replace(one, diameter_m=np.nextafter(8.0, 9.0)),
        replace(one, mirror=replace(one.mirror, positions_m=moved)),
    ]
    assert len({instrument_sha256(other) for other in (one, *others)}) == 4


def test_remarks_on_the_file_are_not_part_of_the_instrument():
    one = small_instrument()
    assert instrument_sha256(replace(one, remarks=("a.toml: odd",))) == instrument_sha256(one)
