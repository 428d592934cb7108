from pyrcal import rtc


def describe(computer: rtc.Computer) -> None:
    """Print what the link asks of any RTC; BasicComputer is one."""
    status = computer.status()
    print(computer.session, status.loop, status.n_controlled)
