"""Measuring on a plant of a few modes, through the whole computer, against the plant's own D."""

from dataclasses import replace
from itertools import count

import numpy as np
import pytest

from pyrcal.rtc.identity import Identity, Reconstructor
from service.model.misregistration import Misregistration
from service.wire import (
    DitherKind,
    DitherRequest,
    DitherStop,
    Loop,
    LoopRequest,
    Manifest,
    MeasuredManifest,
    MeasureRequest,
    Pattern,
    decode,
    encode,
    layout_of,
)
from sim_rtc.assembly import build_telescope
from sim_rtc.computer.feed import OpenLoopBlock
from sim_rtc.computer.measure import MeasurementRules
from sim_rtc.computer.real_time_computer import RealTimeComputer
from sim_rtc.computer.strokes import (
    PushPull,
    frames_per_shape,
    hadamard_shapes,
    pokes,
    system_shapes,
)
from sim_rtc.computer.telemetry import LoopSettings
from sim_rtc.options import parse_options
from sim_rtc.telescope.linear import LinearOptics

N_MODES, N_SLOPES, N_ACTUATORS = 6, 16, 9
RNG = np.random.default_rng(3)
RESPONSE = (2e6 * RNG.standard_normal((N_SLOPES, N_MODES))).astype(np.float32)
MODE_TO_ACTUATOR = RNG.standard_normal((N_ACTUATORS, N_MODES))
CONTROLLED = 5
ALL = tuple(range(N_MODES))
HERE = Identity(system="small", basis_id="basis", config_id="sensor", double_pass=False)


def optics():
    return LinearOptics(
        alpha=Misregistration(),
        stuck_opd_m=np.zeros(3, dtype=np.float32),
        slopes_per_command=RESPONSE,
        opd_per_command=np.zeros((3, N_MODES), dtype=np.float32),
        images=np.ones((2, 1, 2, 1)) / 4,
    )


def sky(noise=0.0, trend=0.0, start=0.0):
    """Slopes without the mirror: noise, and a wavefront that changes at a constant rate."""
    rng, telescope = np.random.default_rng(5), optics()
    shape = np.random.default_rng(6).standard_normal(N_SLOPES)
    for first in count(0, 50):
        frames = np.arange(first, first + 50)
        slopes = noise * rng.standard_normal((50, N_SLOPES))
        slopes += (start + trend * frames[:, None]) * shape
        yield OpenLoopBlock(
            first_frame=first,
            optics=telescope,
            slopes=slopes.astype(np.float32),
            phases_m=np.zeros((5, 3), np.float32),
        )


def computer_on(blocks, **changes):
    matrix = np.linalg.pinv(RESPONSE[:, :CONTROLLED]).astype(np.float32)
    manifest = Manifest(
        id="first",
        layout=layout_of(matrix, 1000),
        alpha=None,
        sigma=None,
        im_id=None,
        parent=None,
        basis_id="basis",
        config_id="sensor",
        system="small",
        created_ns=1,
    )
    given = {"mode_to_actuator": MODE_TO_ACTUATOR} | changes
    return RealTimeComputer(
        blocks,
        identity=Identity(system="small", basis_id="basis", config_id="sensor"),
        settings=LoopSettings(
            frame_rate_hz=1000.0,
            delay_frames=2,
            gains=(0.4,) * N_MODES,
            leak=0.99,
            n_controlled_next=CONTROLLED,
        ),
        reconstructor=Reconstructor(manifest=manifest, matrix=matrix),
        optics=optics(),
        stroke_m=1e-5,
        **given,
    )


def push_pull(name="im-1", pattern=Pattern.PUSH_PULL_MODAL, modes=ALL, n_average=4, each_m=2e-8):
    return MeasureRequest(
        id=name,
        pattern=pattern,
        modes=modes,
        amplitude_m=(each_m,) * len(modes),
        n_average=n_average,
    )


def sines(duration_s=2.0, modes=ALL, frequency_hz=None):
    lines = frequency_hz or tuple(40.0 + 60.0 * k for k in range(len(modes)))
    return MeasureRequest(
        id="im-sine",
        pattern=Pattern.SINE,
        modes=modes,
        amplitude_m=(2e-8,) * len(modes),
        frequency_hz=lines,
        duration_s=duration_s,
    )


def dither():
    return DitherRequest(
        id="d-start",
        kind=DitherKind.SINE,
        modes=(5,),
        amplitude_m=(1e-9,),
        frequency_hz=(100.0,),
        duration_s=1.0,
    )


def measured(computer, request):
    """Run one to its end; return manifest and matrix as they would be sent, and the batches."""
    reply = computer.execute(request)
    assert reply.accepted, reply.reason
    batches = []
    for _ in range(2000):
        batches.append(computer.next_batch())
        ended = computer.take_measured()
        if ended:
            return *ended[0].product(HERE, 7), batches
    raise AssertionError("the measurement never ended")


def relative(found, expected):
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


OPEN_LOOP = [Pattern.PUSH_PULL_MODAL, Pattern.PUSH_PULL_ZONAL, Pattern.HADAMARD]


@pytest.mark.parametrize("pattern", OPEN_LOOP)
def test_without_noise_the_plants_matrix_is_found(pattern):
    _, matrix, _ = measured(computer_on(sky()), push_pull(pattern=pattern))
    assert relative(matrix, RESPONSE) < 1e-5


@pytest.mark.parametrize("pattern", OPEN_LOOP)
def test_columns_follow_the_modes_that_were_asked_for(pattern):
    manifest, matrix, _ = measured(computer_on(sky()), push_pull(pattern=pattern, modes=(4, 1)))
    assert manifest.modes == (4, 1)
    assert relative(matrix, RESPONSE[:, [4, 1]]) < 1e-5


@pytest.mark.parametrize("pattern", OPEN_LOOP)
def test_a_wavefront_that_stands_or_drifts_meanwhile_cancels(pattern):
    """It is a hundred strokes strong and moves by one in ten frames."""
    stroke = 2e-8 * 2e6
    turbulence = sky(start=100 * stroke, trend=0.1 * stroke)
    _, matrix, _ = measured(computer_on(turbulence), push_pull(pattern=pattern))
    assert relative(matrix, RESPONSE) < 2e-3


def test_sines_find_the_matrix_with_the_loop_closed():
    computer = computer_on(sky())
    session = computer.session
    manifest, matrix, batches = measured(computer, sines())
    assert relative(matrix, RESPONSE) < 1e-4
    assert manifest.session == session, "nothing was opened"
    assert all(batch.closed for batch in batches)


def test_the_loops_answer_to_the_sines_does_not_bias_the_matrix():
    """At 40 Hz this loop takes away most of the tone: the dither alone would give a small D."""
    modes = (0,)
    computer = computer_on(sky(noise=0.01))
    _, matrix, _ = measured(computer, sines(modes=modes, frequency_hz=(40.0,)))
    assert relative(matrix, RESPONSE[:, modes]) < 0.02


@pytest.mark.parametrize("n_average", [2, 18])
def test_noise_falls_with_the_root_of_the_averages(n_average):
    """1 sigma of an element: sigma of a slope over the stroke times the root of 2 n."""
    noise, each_m = 0.02, 2e-8
    errors = []
    for seed in range(20):
        blocks = sky(noise=noise, start=float(seed))
        computer = computer_on(blocks)
        for _ in range(seed):
            computer.next_batch()
        _, matrix, _ = measured(computer, push_pull(n_average=n_average, each_m=each_m))
        errors.append(matrix - RESPONSE)
    expected = noise / (each_m * np.sqrt(2 * n_average))
    # 20 x 96 elements: the RMS is known to 2 %
    assert np.std(errors) == pytest.approx(expected, rel=0.08)


def test_hadamard_has_the_noise_of_many_more_pushes():
    def error(pattern):
        _, matrix, _ = measured(computer_on(sky(noise=0.02)), push_pull(pattern=pattern))
        return np.std(matrix - RESPONSE)

    # 8 shapes move every mode: root of 8 better
    assert error(Pattern.PUSH_PULL_MODAL) / error(Pattern.HADAMARD) == pytest.approx(
        np.sqrt(8), rel=0.2
    )


def test_the_loop_is_opened_for_it_and_closed_again():
    computer = computer_on(sky(noise=0.001))
    before = computer.status()
    for _ in range(3):
        computer.next_batch()
    reply = computer.execute(push_pull())
    during = computer.status()
    assert during.loop is Loop.OPEN
    assert during.session != before.session, "opening zeroes the integrator"
    batches = []
    while not computer.take_measured():
        batches.append(computer.next_batch())
    assert computer.status().loop is Loop.CLOSED
    assert computer.session == during.session
    assert computer.status().gains == before.gains
    commands = np.vstack([batch.commands_m for batch in batches])
    first = reply.start_seq - batches[0].seq0
    assert not commands[:first].any(), "nothing answers the slopes"
    stroke = np.float32(2e-8)
    np.testing.assert_array_equal(
        commands[first : first + 4, 0], [stroke, -stroke, -stroke, stroke]
    )
    assert all(batch.dither_m is None for batch in batches)


def test_a_loop_that_was_open_stays_open():
    computer = computer_on(sky())
    computer.execute(LoopRequest(id="open", loop=Loop.OPEN))
    session = computer.session
    manifest, _, _ = measured(computer, push_pull())
    assert computer.status().loop is Loop.OPEN
    assert manifest.session == session


def test_sines_need_a_closed_loop():
    computer = computer_on(sky())
    computer.execute(LoopRequest(id="open", loop=Loop.OPEN))
    assert computer.execute(sines()).reason.startswith("unsupported: sine while the loop is open")


def test_the_sines_travel_as_dither():
    _, _, batches = measured(computer_on(sky(noise=0.01)), sines(duration_s=0.5))
    dither = np.vstack([b.dither_m for b in batches if b.dither_m is not None])
    assert np.sqrt(2 * np.mean(dither[50:450] ** 2)) == pytest.approx(np.sqrt(2) * 2e-8, rel=0.05)


@pytest.mark.parametrize(
    ("request_", "reason"),
    [
        (push_pull(modes=(2, 6)), "range: mode 6, expected 0 to 5"),
        (push_pull(each_m=1e-6), "range: amplitude_m 1e-06, expected at most 2e-07"),
        (push_pull(n_average=10_000, modes=ALL), None),
        (sines(frequency_hz=(10.0, 20.0, 30.0, 40.0, 50.0, 500.0)), "range: frequency_hz 500"),
        (sines(frequency_hz=(10.0, 20.0, 30.0, 40.0, 41.0, 50.0)), "range: frequency_hz 1 Hz"),
    ],
)
def test_what_cannot_be_measured_is_refused_in_the_wires_words(request_, reason):
    reply = computer_on(sky()).execute(request_)
    assert reply.accepted is (reason is None)
    assert reply.reason.startswith(reason or "")


def test_a_measurement_of_hours_is_refused():
    bench = MeasurementRules(n_modes=6, n_slopes=16, frame_rate_hz=1000.0, longest_s=60.0)
    assert bench.refusal(push_pull(n_average=4999)) == ""
    assert bench.refusal(push_pull(n_average=5000)).startswith("range: this would take 60 s")


def test_actuators_that_are_not_known_or_of_several_strokes_are_not_poked():
    zonal = push_pull(pattern=Pattern.PUSH_PULL_ZONAL)
    reply = computer_on(sky(), mode_to_actuator=None).execute(zonal)
    assert reply.reason.startswith("unsupported")
    uneven = MeasureRequest(
        id="u",
        pattern=Pattern.PUSH_PULL_ZONAL,
        modes=(0, 1),
        amplitude_m=(1e-8, 2e-8),
        n_average=1,
    )
    assert computer_on(sky()).execute(uneven).reason.startswith("range: several values")


def test_one_thing_at_a_time():
    computer = computer_on(sky())
    assert computer.execute(dither()).accepted
    assert computer.execute(push_pull()).reason.startswith("busy: dither d-start is on until frame")
    assert computer.status().loop is Loop.CLOSED, "a refused command changes nothing"
    assert computer.execute(DitherStop(id="d-stop")).accepted
    assert computer.execute(push_pull()).accepted
    assert computer.execute(push_pull("im-2")).reason.startswith("busy: matrix im-1")
    assert computer.execute(dither()).reason.startswith("busy: matrix im-1 is being measured")
    closing = LoopRequest(id="close", loop=Loop.CLOSED)
    assert computer.execute(closing).reason.startswith("busy: matrix im-1")


def test_a_frame_of_nan_is_left_out():
    bench = MeasurementRules(n_modes=N_MODES, n_slopes=N_SLOPES, frame_rate_hz=1000.0)
    measurement = bench.measurement(push_pull())
    commands = measurement.commands(0, measurement.stop_seq)
    slopes = commands @ RESPONSE.T
    slopes[5, 3] = np.nan
    measurement.take(0, slopes, commands)
    assert relative(measurement.matrix(), RESPONSE) < 1e-5


def test_the_manifest_says_how_it_was_measured_and_survives_the_wire():
    manifest, matrix, _ = measured(computer_on(sky()), push_pull(n_average=3))
    assert decode(MeasuredManifest, encode(manifest)) == manifest
    assert manifest.layout.shape == matrix.shape == (N_SLOPES, N_MODES)
    assert (manifest.id, manifest.n_average) == ("im-1", 3)
    assert manifest.pattern is Pattern.PUSH_PULL_MODAL
    assert manifest.reason is None


def test_a_measurement_that_determines_nothing_says_why():
    def blind():
        for block in sky():
            block.slopes[:] = np.nan
            yield block

    manifest, matrix, _ = measured(computer_on(blind()), push_pull())
    assert matrix is None
    assert manifest.layout.n_chunks == 0
    assert manifest.reason
    assert decode(MeasuredManifest, encode(manifest)) == manifest


def test_a_restart_ends_the_measurement_and_says_so():
    computer = computer_on(sky())
    computer.execute(push_pull())
    session = computer.session
    computer.next_batch()
    computer.restart()
    (ended,) = computer.take_measured()
    manifest, matrix = ended.product(HERE, 7)
    assert matrix is None
    assert manifest.reason == "the loop started over during the measurement"
    assert manifest.session == session
    assert computer.status().loop is Loop.CLOSED
    assert not computer.next_batch().commands_m[:2].any()


def test_pushes_and_pulls_balance_for_constants_and_trends():
    shapes = np.array([[1e-8, 0.0], [0.0, 3e-8]], dtype=np.float32)
    strokes = PushPull(shapes_m=shapes, n_average=4)
    assert strokes.n_frames == 2 * frames_per_shape(4)
    frame = np.arange(strokes.n_frames)
    played = strokes.commands(frame)
    np.testing.assert_allclose(played.sum(axis=0), 0.0, atol=1e-14)
    np.testing.assert_allclose(frame @ played, 0.0, atol=1e-13)
    np.testing.assert_array_equal(np.count_nonzero(played, axis=0), [8, 8])


def test_hadamard_shapes_move_every_mode_by_its_own_amplitude():
    shapes = hadamard_shapes((0, 2, 5), (1e-8, 2e-8, 3e-8), N_MODES)
    np.testing.assert_allclose(np.abs(shapes[:, [0, 2, 5]]), [[1e-8, 2e-8, 3e-8]] * 4, rtol=1e-6)
    assert not shapes[:, [1, 3, 4]].any()
    gram = shapes.T.astype(float) @ shapes
    np.testing.assert_allclose(gram - np.diag(np.diag(gram)), 0.0, atol=1e-20)


def test_system_modes_are_apart_in_slopes_and_in_modes():
    inverse = np.linalg.pinv(RESPONSE[:, :CONTROLLED]).astype(np.float32)
    shapes = system_shapes(inverse, tuple(range(CONTROLLED)), 2e-8, N_MODES).astype(float)
    np.testing.assert_allclose(np.linalg.norm(shapes, axis=1), 2e-8, rtol=1e-6)
    assert not shapes[:, CONTROLLED:].any()
    for seen in (shapes, shapes @ RESPONSE.T):
        gram = seen @ seen.T
        assert np.abs(gram - np.diag(np.diag(gram))).max() < 1e-5 * np.abs(gram).max()


def test_system_modes_measure_the_columns_that_were_asked_for():
    request = push_pull(pattern=Pattern.SYSTEM_MODES, modes=(3, 0, 2))
    manifest, matrix, batches = measured(computer_on(sky(noise=0.002)), request)
    assert manifest.pattern is Pattern.SYSTEM_MODES
    np.testing.assert_allclose(matrix, RESPONSE[:, [3, 0, 2]], atol=0.05 * np.abs(RESPONSE).max())
    exact = measured(computer_on(sky()), request)[1]
    np.testing.assert_allclose(exact, RESPONSE[:, [3, 0, 2]], rtol=1e-4)
    played = np.concatenate([b.commands_m for b in batches])
    assert not played[:, [1, 4, 5]].any()


@pytest.mark.parametrize(
    ("modes", "amplitude_m", "reason"),
    [
        ((0, CONTROLLED), (2e-8,) * 2, "range: mode 5 has no row in the reconstructor in use"),
        ((0, 1), (2e-8, 1e-8), "range: several values in amplitude_m, expected the same for every"),
    ],
)
def test_system_modes_that_cannot_be_are_refused(modes, amplitude_m, reason):
    request = replace(push_pull(pattern=Pattern.SYSTEM_MODES, modes=modes), amplitude_m=amplitude_m)
    reply = computer_on(sky()).execute(request)
    assert not reply.accepted
    assert reply.reason.startswith(reason)


def test_pokes_are_the_nearest_the_modes_can_come_to_single_actuators():
    shapes = pokes(MODE_TO_ACTUATOR, 2e-8).astype(float)
    np.testing.assert_allclose(np.linalg.norm(shapes, axis=1), 2e-8, rtol=1e-6)
    reached = shapes @ MODE_TO_ACTUATOR.T
    projector = MODE_TO_ACTUATOR @ np.linalg.pinv(MODE_TO_ACTUATOR)
    for actuator, poke in enumerate(reached):
        wanted = projector[:, actuator]
        assert poke @ wanted / np.linalg.norm(poke) / np.linalg.norm(wanted) == pytest.approx(1.0)


@pytest.mark.parametrize(("scene", "factor"), [("onsky", 1.0), ("daytime", 2.0)])
def test_by_day_the_light_meets_the_mirror_twice_and_the_manifest_says_so(
    small_instrument, scene, factor
):
    words = ["--n-controlled=30", "--seed=1", "--alpha=0,0,0,1", "--mag=0", "--vibration=none"]
    telescope = build_telescope(parse_options([*words, f"--scene={scene}"]), small_instrument)
    computer = telescope.computer(telescope.feed.blocks())
    modes = (3, 8, 20)
    request = push_pull(modes=modes, n_average=20)
    assert computer.execute(request).accepted
    while not (ended := computer.take_measured()):
        computer.next_batch()
    _, matrix = ended[0].product(HERE, 7)
    single = build_telescope(parse_options(words), small_instrument).optics.at(0.0)
    expected = factor * single.slopes_per_command[:, list(modes)]
    assert relative(matrix, expected) < 0.03
    assert computer.identity.double_pass is (factor == 2.0)
