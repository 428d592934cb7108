"""What the worker asks of an instrument before it works with it."""

from __future__ import annotations

from service.control.gate import Outer
from service.errors import ModelError
from service.model.instrument import Influence, Instrument, Mirror
from service.model.interaction import RtcInteractionModel
from service.model.modes import ModalBasis
from service.telemetry.health import Actuators


def actuators_of(model: RtcInteractionModel) -> Actuators | None:
    """Return the mirror's actuators; None where the modes are measured surfaces."""
    basis, mirror = model.basis, model.instrument.mirror
    if not isinstance(basis, ModalBasis) or not isinstance(mirror, Mirror):
        return None
    return Actuators(positions=mirror.positions_m, strokes=basis.mode_to_actuator)


def outer_of(model: RtcInteractionModel) -> Outer | None:
    """Return the outermost ring where a stroke is the height of the surface in metres."""
    actuators, mirror = actuators_of(model), model.instrument.mirror
    if actuators is None or not isinstance(mirror, Mirror):
        return None
    if mirror.influence is not Influence.THIN_PLATE or not mirror.stroke_known:
        return None
    return Outer(actuators=actuators.strokes[actuators.outer])


def check_controllable(instrument: Instrument) -> None:
    """Refuse what can be fitted offline, but not controlled with.

    Raises
    ------
    ModelError
        If the stroke is unknown, or the RTC delivers frames.
    """
    if not instrument.mirror.stroke_known:
        raise ModelError(
            f"{instrument.name}: found mirror.stroke = unknown; expected a known one: a "
            "reconstructor gives metres (pyrcal fit needs none)"
        )
    if instrument.frames is not None:
        raise ModelError(
            f"{instrument.name}: found wfs.input = frames; expected slopes, which is what an RTC "
            "sends (pyrcal fit takes frames)"
        )
