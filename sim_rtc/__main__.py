"""``python -m sim_rtc``: run the simulated RTC."""

from __future__ import annotations

from service.program import leave, leave_when_asked


def main() -> int:
    """Run the simulated RTC as the command line says; return the exit status.

    The simulator takes long to import. SIGINT and SIGTERM end the process meanwhile.
    """
    leave_when_asked(0)
    from sim_rtc.simulator import simulate

    return simulate()


if __name__ == "__main__":
    leave(main())
