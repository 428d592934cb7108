"""Which instruments the simulated telescope can be."""

from __future__ import annotations

from service.errors import ConfigurationError
from service.model.instrument import Instrument, TabulatedModes
from service.model.slopes import Normalisation, Orientation, SlopeOrder


def check_playable(instrument: Instrument) -> None:
    """Refuse an instrument whose mirror or telemetry is not simulated.

    Raises
    ------
    ConfigurationError
        If the modes are a table, the mirror is seen from behind, or the slopes are other than the
        conventions' own.
    """
    slopes = instrument.slopes
    found = {
        "measured modes (mirror.modes, mirror.influence_functions)": isinstance(
            instrument.mirror, TabulatedModes
        ),
        "mirror.parity = -1": instrument.mirror.y_sign < 0,
        'wfs.input = "frames"': instrument.frames is not None,
        f'slopes.order = "{slopes.order}"': slopes.order is not SlopeOrder.XY,
        "another slopes.orientation": slopes.assumed_orientation != Orientation(),
        f'slopes.normalisation = "{slopes.normalisation}"': (
            slopes.normalisation is not Normalisation.GLOBAL
        ),
    }
    for name, is_so in found.items():
        if is_so:
            raise ConfigurationError(
                f"{instrument.name}: found {name}; the simulated telescope has actuators, seen "
                "from the front, and sends slopes as conventions have them"
            )
