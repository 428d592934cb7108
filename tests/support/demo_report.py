"""What tests of several modules share of unit.demo.test_report."""

from __future__ import annotations

TRUE = {"shift_x_subap": 0.1, "shift_y_subap": 0.0, "rotation_deg": 0.2, "magnification": 1.003}


SIGMA = {
    "shift_x_subap": 0.004,
    "shift_y_subap": 0.004,
    "rotation_deg": 0.006,
    "magnification": 0.0004,
}


def gate(radius):
    return {"worst_pole_radius": radius}


def shelf(**changes):
    """The RTC's own matrix, one for 400 modes, one for 500."""
    records = []
    for name, n_modes, parent, radius in (
        ("initial", 400, None, 0.93),
        ("cm-400", 400, "initial", 0.66),
        ("cm-500", 500, "cm-400", 0.67),
    ):
        records.append(
            {
                "id": name,
                "n_modes": n_modes,
                "parent": parent,
                "state": "applied",
                "gate": gate(radius),
                "published_ns_utc": None if parent is None else 5,
                "applied_frame_seq": None if parent is None else 100,
            }
            | changes.get(name.replace("-", "_"), {})
        )
    return records


def service_state(alarms=(), **error):
    alpha = {name: TRUE[name] + error.get(name, 0.0) for name in TRUE}
    return {
        "ready": True,
        "ready_reason": "ready",
        "waiting_for": [],
        "uptime_s": 70.0,
        "windows_accepted": 30,
        "windows_refused": 2,
        "link": {"frames_received": 50_000, "frames_lost": 0},
        "alarms": [{"name": name, "text": "found"} for name in alarms],
        "registration": {"alpha": alpha, "sigma": SIGMA, "floor": SIGMA},
    }


def waiting(name, party, text):
    return {"name": name, "responsible": party, "text": text, "blocks": True}
