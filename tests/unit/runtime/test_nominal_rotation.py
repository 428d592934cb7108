"""A mirror mounted at an angle: the whole service starts from there, not from zero."""

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from pyrcal_studies.campaign.observatory import Observatory
from service.archive import Archive
from service.config import load_settings
from service.instrument import load_instrument
from service.model.misregistration import Misregistration
from service.records import events as ev
from service.records.operations import AcquisitionStage
from service.records.state import Mode
from service.rtc_bridge import Bridge, Endpoint
from service.runtime.actions import Actions, Publishing
from service.runtime.policy import policy_of
from service.runtime.supervisor import Supervisor
from service.runtime.worker import OpticsWorker, start_worker
from service.runtime.workers import WorkerPool
from tests.support.situations import POLICY, estimate, rtc
from tests.support.small import COMPUTE, INSTRUMENT, N_CONTROLLED
from tests.support.states import tracker_state
from tests.support.supervisor import running

NOMINAL_DEG = 65.08
"""As at the LBT."""


@pytest.fixture(scope="module")
def turned(tmp_path_factory):
    """The file of the small telescope, its mirror mounted at an angle."""
    text = INSTRUMENT.read_text(encoding="utf-8")
    mounted = text.replace("[mirror]\n", f"[mirror]\nnominal_rotation_deg = {NOMINAL_DEG}\n")
    path = tmp_path_factory.mktemp("turned") / "turned.toml"
    path.write_text(mounted, encoding="utf-8")
    return path


def test_alpha_is_tracked_and_no_healthy_loop_is_opened(turned):
    """Linear plant: what is tested is the start, not the accuracy."""
    words = [
        f"--instrument={turned}",
        "--plant=linear",
        "--imperfections=ideal",
        f"--n-controlled={N_CONTROLLED}",
        "--seed=1",
        f"--alpha=0.05,-0.03,{NOMINAL_DEG + 0.1},1.002",
    ]
    given = {"control.n_modes_target": N_CONTROLLED, "acquisition.auto": True}
    policy = policy_of(load_settings(None, {}, given))
    with threadpool_limits(1):
        bench = OpticsWorker(load_instrument(str(turned)), COMPUTE)
        night = Observatory(words, policy, Mode.AUTO, bench, with_poles=False)
        night.advance(10.0)
    assert night.state.operations.acquisition.stage is AcquisitionStage.IDLE
    registration = night.state.alpha.registration
    assert registration.n_windows >= 3
    error = registration.alpha.vector - night.dome.alpha.vector
    assert (np.abs(error) < 5.0 * registration.sigma).all()


@pytest.mark.timeout(60)
async def test_the_running_service_has_it_from_the_instrument_file(turned, tmp_path):
    instrument = load_instrument(str(turned))
    workers = WorkerPool(lambda: start_worker(instrument, COMPUTE))
    archive = Archive(tmp_path)
    archive.open()
    with archive, Bridge(Endpoint(system="small", listen=("tcp/127.0.0.1:0",))) as bridge:
        actions = Actions(
            bridge=bridge,
            workers=workers,
            archive=archive,
            instrument=instrument,
            publishing=Publishing(system="small", chunk_bytes=4096, pole_radius_bound=0.95),
            clock_ns=lambda: 5,
        )
        supervisor = Supervisor(
            state=tracker_state(system="small", mode=Mode.HOLD),
            policy=POLICY,
            bridge=bridge,
            workers=workers,
            archive=archive,
            actions=actions,
        )
        async with running(supervisor):
            supervisor._post(ev.SessionStarted(session="s1"))
            supervisor._post(rtc())
            near = Misregistration(rotation_rad=np.deg2rad(NOMINAL_DEG + 0.2))
            supervisor._post(ev.WindowFitted(estimate=estimate(near)))
            registration = supervisor.snapshot().tracker.alpha.registration
    workers.close()
    assert registration.alpha == near
