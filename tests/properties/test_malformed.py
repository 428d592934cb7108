"""Malformed input of every kind costs a refusal and nothing else; by the million: make fuzz."""

import random
from contextlib import suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.errors import MatrixError, PyrcalError
from service.files.container import opened
from tests import malformed, malformed_commands
from tests.support.forged import TWO_BY_THREE, fits_bytes

OF_BYTES = [kind for kind in malformed.KINDS if kind.name != "rest"]
N_EXAMPLES = {"messages": 300, "frames": 150, "npy": 60, "hdf5": 30, "fits": 30, "toml": 15}
"""About a second each."""


@pytest.mark.parametrize("kind", OF_BYTES, ids=lambda kind: kind.name)
def test_whatever_is_wrong_with_a_seed_is_refused_or_read(kind):
    seeds = kind.seeds()

    @settings(max_examples=N_EXAMPLES[kind.name], derandomize=True)
    @given(seed=st.integers(0, 2**32), which=st.integers(0, len(seeds) - 1))
    def wrong(seed, which):
        data = malformed.mutated(seeds[which], random.Random(seed), seeds)
        with suppress(PyrcalError):
            kind.read(data)

    wrong()


@pytest.mark.parametrize("kind", OF_BYTES, ids=lambda kind: kind.name)
def test_so_are_any_bytes_at_all(kind):
    @settings(max_examples=50, derandomize=True)
    @given(data=st.binary(max_size=3000))
    def any_bytes(data):
        with suppress(PyrcalError):
            kind.read(data)

    any_bytes()


def test_no_request_is_answered_with_a_fault_of_the_service():
    with malformed.rest() as read:
        kind = malformed.Kind("rest", 0, malformed.requests, read)
        found = malformed.tried(kind, 150, random.Random(3))
    assert (found.n_inputs, dict(found.findings)) == (150, {})
    assert found.n_refused > 50


def refusal(tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(MatrixError) as caught, opened(path):
        pass
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_what_the_millions_found_stays_mended(tmp_path):
    """A header of NumPy that Python's parser refuses; a card of FITS that astropy cannot read."""
    for shape in (b"(False, (4, 3)", b"False, 'shape': (2, 99999999999999999999999)"):
        header = (b"{'descr': '<f8', 'fortran_order': " + shape + b", }").ljust(117) + b"\n"
        content = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
        assert "damaged NumPy file" in refusal(tmp_path, "a.npy", content)
    card = fits_bytes(TWO_BY_THREE).replace(
        b"SIMPLE  =                    T", b"SIMPLE  = \xff T" + b" " * 17
    )
    assert "damaged FITS file" in refusal(tmp_path, "a.fits", card)


@pytest.mark.parametrize("reader", malformed_commands.READERS, ids=lambda reader: reader.name)
def test_a_command_on_a_mutated_file_ends_as_it_documents(reader):
    found = malformed_commands.tried(reader, 2, seed=7)
    assert dict(found.findings) == {}
