import numpy as np
import pytest

from service.runtime import translate
from service.tracking import events as ev
from service.tracking.loop import DitherView, Pointing
from service.tracking.products import MatrixState
from service.tracking.state import Mode
from service.wire import (
    Acknowledgement,
    AckState,
    DitherKind,
    DitherRequest,
    DitherStatus,
    Loop,
    PointingStatus,
    Status,
    layout_of,
)
from tests.unit.tracking.situations import ALPHA, Story, foreign, record, rtc


def status(**changes):
    values = {
        "session": "s1",
        "seq": 5,
        "t_ns": 7,
        "loop": Loop.CLOSED,
        "frame_rate_hz": 1000.0,
        "delay_frames": 2.0,
        "gains": (0.4, 0.0),
        "leak": 0.99,
        "n_slopes": 6,
        "n_modes": 2,
        "n_controlled": 1,
        "cm_id": None,
        "basis_id": "kl",
        "config_id": "mask",
        "dither": None,
        "max_dither_m": 2e-8,
        "max_dither_modes": 8,
        "magnitude": 8.0,
        "flux": None,
    }
    return Status(**(values | changes))


def test_a_status_becomes_the_view_of_the_rtc():
    event = translate.event_of(status(cm_id="cm-1"))
    assert isinstance(event, ev.StatusSeen)
    assert (event.rtc.loop, event.rtc.cm_id, event.rtc.n_slopes) == ("closed", "cm-1", 6)
    assert event.rtc.dither_id is None


def test_where_the_telescope_looks_is_taken_over_when_the_rtc_knows():
    assert translate.rtc_view(status()).pointing is None
    looking = status(pointing=PointingStatus(elevation_deg=61.5, azimuth_deg=-20.0))
    assert translate.rtc_view(looking).pointing == Pointing(elevation_deg=61.5, azimuth_deg=-20.0)


def test_a_running_dither_is_known_by_its_id():
    request = DitherRequest(
        id="dither-5",
        kind=DitherKind.SINE,
        modes=(1,),
        amplitude_m=(1e-9,),
        frequency_hz=(250.0,),
        duration_s=1.0,
    )
    running = DitherStatus(request=request, start_seq=3)
    assert translate.rtc_view(status(dither=running)).dither_id == "dither-5"


def test_a_random_dither_is_known_by_its_seed():
    request = DitherRequest(
        id="dither-6",
        kind=DitherKind.BINARY,
        modes=(1, 4),
        amplitude_m=(1e-9, 2e-9),
        duration_s=30.0,
        seed=17,
    )
    view = translate.rtc_view(status(dither=DitherStatus(request=request, start_seq=3)))
    assert view.dither == DitherView(
        id="dither-6",
        kind=DitherKind.BINARY,
        modes=(1, 4),
        amplitude_m=(1e-9, 2e-9),
        frequency_hz=(),
        seed=17,
        duration_s=30.0,
        start_seq=3,
        asked_ns_utc=0,
    )


@pytest.mark.parametrize(
    ("state", "expected"),
    [
        (AckState.STAGED, MatrixState.STAGED),
        (AckState.APPLIED, MatrixState.APPLIED),
        (AckState.REJECTED, MatrixState.REJECTED),
    ],
)
def test_an_acknowledgement_keeps_its_word(state, expected):
    acknowledgement = Acknowledgement(
        session="s1", id="cm-1", sha256="0" * 64, state=state, reason="why", frame_seq=9
    )
    event = translate.event_of(acknowledgement)
    assert event == ev.Acknowledged(
        id="cm-1", sha256="0" * 64, session="s1", state=expected, reason="why", frame_seq=9
    )


@pytest.mark.parametrize("said", [ev.SessionStarted(session="s2"), ev.RtcVanished()])
def test_what_means_the_same_to_the_tracker_is_handed_on(said):
    assert translate.event_of(said) is said


def test_a_manifest_carries_the_registration_in_boundary_units():
    matrix = np.zeros((400, 6), np.float32)
    manifest = translate.manifest_of(record("cm-1"), layout_of(matrix, 4096), rtc(), "flao")
    assert manifest.alpha["rotation_deg"] == pytest.approx(0.2)
    assert manifest.sigma["rotation_deg"] == pytest.approx(np.rad2deg(9e-5))
    assert (manifest.basis_id, manifest.system, manifest.parent) == ("kl-594", "flao", "initial")


def test_a_matrix_of_the_rtc_is_for_no_registration_we_can_vouch_for():
    matrix = np.zeros((3, 6), np.float32)
    sent = translate.manifest_of(record("cm-1"), layout_of(matrix, 4096), rtc(), "flao")
    brought = translate.record_of(sent)
    assert (brought.alpha, brought.parent, brought.n_modes) == (None, None, 3)
    assert brought.state is MatrixState.APPLIED
    manifest = translate.manifest_of(foreign(), layout_of(matrix, 4096), rtc(), "flao")
    assert (manifest.alpha, manifest.sigma) == (None, None)


def test_the_state_on_the_network_is_short_and_in_boundary_units():
    story = Story(Mode.HOLD).meet()
    nothing = translate.state_message(story.state, 5)
    assert nothing.alpha is nothing.validity is None
    story.see()
    message = translate.state_message(story.state, 5)
    assert message.validity == story.state.registration.standing.validity
    assert (message.mode, message.in_use, message.t_ns) == ("hold", "initial", 5)
    assert message.alpha == pytest.approx(ALPHA.to_boundary())
    assert message.sigma["shift_x_subap"] == pytest.approx(np.hypot(0.002, 0.003))
